"""Posed camera frames in, live semantic 3D map out."""

__version__ = "0.1.0"
