"""RealSense cameras through Intel's SDK (``pyrealsense2``, extra ``realsense``): colour, and depth aligned to it."""

from semantic_mapper.drivers.realsense.camera import open_camera
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import list_devices

__all__ = ["Config", "list_devices", "open_camera"]
