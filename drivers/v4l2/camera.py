"""A V4L2 camera as a ``Camera``."""

from __future__ import annotations

from pathlib import Path

from semantic_mapper.drivers.calibration import require_calibration
from semantic_mapper.drivers.live import LiveCamera
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.device import V4l2Device
from semantic_mapper.drivers.v4l2.paths import stable_path
from semantic_mapper.errors import CameraError


def open_camera(config: Config, camera_id: str = "camera") -> LiveCamera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``.

    Raises:
        CameraError: no device or no calibration is named, or the calibration is for another size than requested.
        ConfigError: the calibration cannot be read.
    """
    if not config.device:
        raise CameraError(
            f"camera '{camera_id}': no device is named; `doctor --cameras` lists what is connected; give its "
            'address as device = "/dev/v4l/by-id/..."'
        )
    measured = require_calibration(config.calibration, config.uncalibrated, f"V4L2 camera at {config.device}")
    asked = (config.width, config.height) if config.width else None
    size = asked if measured is None else (measured.width, measured.height)
    if asked is not None and asked != size:
        raise CameraError(
            f"{config.calibration}: is for another size than the {asked[0]}x{asked[1]} that the camera is asked "
            "for; leave width and height out, or calibrate for that size"
        )
    named = Path(config.device)
    known = stable_path(named)

    def open_device() -> V4l2Device:
        nonlocal known
        if known == named:  # it was not there yet, or udev had not named it
            known = stable_path(named)
        return V4l2Device(known, config, size)

    return LiveCamera(camera_id, open_device, measured, config.stall_s, {"driver": "v4l2", "device": config.device})
