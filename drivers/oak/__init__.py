"""OAK cameras through DepthAI v3: colour, stereo depth aligned to it, and odometry, over USB and PoE."""

from semantic_mapper.drivers.oak.camera import open_camera
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.devices import list_devices

__all__ = ["Config", "list_devices", "open_camera"]
