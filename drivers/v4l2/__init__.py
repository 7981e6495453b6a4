"""Cameras of the Linux kernel: USB webcams, capture cards, whatever is a /dev/video*."""

from semantic_mapper.drivers.v4l2.camera import open_camera
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.devices import list_devices

__all__ = ["Config", "list_devices", "open_camera"]
