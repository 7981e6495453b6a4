"""OAK cameras through DepthAI v3: colour, stereo depth aligned to it, and odometry, over USB and PoE."""

from __future__ import annotations

from typing import TYPE_CHECKING

from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.devices import list_devices

if TYPE_CHECKING:
    from semantic_mapper.drivers.base import Camera

__all__ = ["Config", "list_devices", "open_camera"]


def open_camera(config: Config, camera_id: str) -> Camera:
    """The camera of a config; its device is opened by ``with``.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
    """
    from semantic_mapper.drivers.oak.camera import OakCamera  # loads OpenCV and SciPy

    return OakCamera(config, camera_id)
