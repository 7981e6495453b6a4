"""Stereo pairs that give both images side by side, such as UVC stereo webcams: rectified, matched, a depth camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

from semantic_mapper.drivers.stereo.config import Config
from semantic_mapper.drivers.stereo.listing import list_devices

if TYPE_CHECKING:
    from semantic_mapper.drivers.base import Camera

__all__ = ["Config", "list_devices", "open_camera"]


def open_camera(config: Config, camera_id: str) -> Camera:
    """The camera of a config; see ``drivers/registry.py``.

    Raises:
        CameraError: no device or no calibration is named.
        ConfigError: the calibration cannot be read, or a setting of the device is unknown.
    """
    from semantic_mapper.drivers.stereo.camera import StereoCamera  # loads OpenCV

    return StereoCamera(config, camera_id)
