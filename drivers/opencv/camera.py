"""A video file or a stream as a ``Camera``."""

from __future__ import annotations

from functools import partial

from semantic_mapper.drivers.base import Camera
from semantic_mapper.drivers.calibration import require_calibration
from semantic_mapper.drivers.live import LiveCamera
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.drivers.opencv.file import VideoFile
from semantic_mapper.drivers.opencv.stream import StreamDevice
from semantic_mapper.errors import CameraError
from semantic_mapper.redaction import without_secrets


def open_camera(config: Config, camera_id: str = "camera") -> Camera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``.

    Raises:
        CameraError: no source or no calibration is named.
        ConfigError: the calibration cannot be read.
    """
    if not config.source:
        raise CameraError(f'camera \'{camera_id}\': no video is named; give source = "FILE" or source = "rtsp://..."')
    shown = without_secrets(config.source)
    measured = require_calibration(config.calibration, config.uncalibrated, f"video {shown}")
    if "://" not in config.source:
        return VideoFile(config, camera_id, measured)
    metadata = {"driver": "opencv", "url": shown, "stamps": config.stamps}
    return LiveCamera(camera_id, partial(StreamDevice, config), measured, config.stall_s, metadata)
