"""Calibration of cameras and rigs from images of a printed board."""
