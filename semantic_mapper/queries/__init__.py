"""Asking a map: where things are, what is free, what a ray meets."""
