"""A video file or a stream as a ``Camera``."""

from __future__ import annotations

from functools import partial

from drivers.base import Camera
from drivers.calibration import require_calibration
from drivers.live import LiveCamera
from drivers.opencv.config import Config
from drivers.opencv.file import VideoFile
from drivers.opencv.stream import StreamDevice
from drivers.urls import hide_password
from semantic_mapper.errors import CameraError


def open_camera(config: Config, camera_id: str = "camera") -> Camera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``.

    Raises:
        CameraError: no source or no calibration is named.
        ConfigError: the calibration cannot be read.
    """
    if not config.source:
        raise CameraError(f'camera \'{camera_id}\': no video is named; give source = "FILE" or source = "rtsp://..."')
    shown = hide_password(config.source)
    measured = require_calibration(config.calibration, config.uncalibrated, f"video {shown}")
    if "://" not in config.source:
        return VideoFile(config, camera_id, measured)
    metadata = {"driver": "opencv", "url": shown, "stamps": config.stamps}
    return LiveCamera(camera_id, partial(StreamDevice, config), measured, config.stall_s, metadata)
