"""Calibration of lenses and rigs from the command line."""
