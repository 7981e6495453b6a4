"""RealSense cameras through Intel's SDK (``pyrealsense2``, extra ``realsense``): colour, and depth aligned to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import list_devices

if TYPE_CHECKING:
    from semantic_mapper.drivers.base import Camera

__all__ = ["Config", "list_devices", "open_camera"]


def open_camera(config: Config, camera_id: str) -> Camera:
    """The camera of a config; its device is opened by ``with``.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
    """
    from semantic_mapper.drivers.realsense.camera import RealSenseCamera  # loads OpenCV

    return RealSenseCamera(config, camera_id)
