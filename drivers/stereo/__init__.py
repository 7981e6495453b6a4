"""Stereo pairs that give both images side by side, such as UVC stereo webcams: rectified, matched, a depth camera."""

from semantic_mapper.drivers.stereo.camera import open_camera
from semantic_mapper.drivers.stereo.config import Config
from semantic_mapper.drivers.v4l2.devices import list_stereo as list_devices

__all__ = ["Config", "list_devices", "open_camera"]
