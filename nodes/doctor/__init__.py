"""Checks of the machine and of launch files."""
