"""Cameras and pose sources behind one protocol."""
