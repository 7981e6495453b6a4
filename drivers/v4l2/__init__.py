"""Cameras of the Linux kernel: USB webcams, capture cards, whatever is a /dev/video*."""
