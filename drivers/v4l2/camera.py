"""V4L2 cameras: size, rate, pixel format and controls are set, and what the device gives instead is read back."""

from __future__ import annotations

import difflib
import errno
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.drivers.calibration import require_calibration
from semantic_mapper.drivers.live import LiveCamera, RawImage, nominal_hz
from semantic_mapper.drivers.v4l2 import ioctls
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.devices import SHOWN_FORMATS, stable_path
from semantic_mapper.drivers.v4l2.ioctls import Control
from semantic_mapper.errors import CameraError

OLDEST_STAMP_S = 10.0  # a buffer is never older; a stamp that is comes from another clock
AHEAD_S = 0.1  # so far a driver may foretell the end of an exposure
RATE_TOLERANCE = 0.02  # 29.97 is 30


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
    requested = (config.width, config.height) if config.width else None
    size = requested if measured is None else (measured.width, measured.height)
    if requested is not None and requested != size:
        raise CameraError(
            f"{config.calibration}: is for another size than the {requested[0]}x{requested[1]} that is requested "
            "of it; leave width and height out, or calibrate for that size"
        )
    named = Path(config.device)
    known = stable_path(named)

    def open_device() -> V4l2Device:
        nonlocal known
        if known == named:  # it was not there yet, or udev had not named it
            known = stable_path(named)
        return V4l2Device(known, config, size)

    return LiveCamera(camera_id, open_device, measured, config.stall_s, {"driver": "v4l2", "device": config.device})


class V4l2Device:
    """A ``Device`` (drivers/live.py) over ``cv2.VideoCapture``.

    Args:
        path: Of the device, best a link by its id.
        config: What to ask of it.
        size: Width and height to ask for; None = as the device has it.

    Raises:
        CameraError: it is not there, may not be opened, is in use, or gives no images.
    """

    def __init__(self, path: Path, config: Config, size: tuple[int, int] | None) -> None:
        self._path = path
        who, formats = _examine(path)
        self.description = f"V4L2 {who.card} at {path}"
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraError(f"{self.description}: cannot be opened for streaming; is another program using it?")
        try:
            self._negotiate(config, size, formats)
            self._warnings += apply_controls(path, config)
        except OSError as error:
            self._capture.release()
            raise CameraError(f"{self.description}: went away while it was opened ({error.strerror})") from error
        self._clock_warning = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        clock = (self._clock_warning,) if self._clock_warning else ()
        return tuple(f"{self.description}: {trouble}" for trouble in (*self._warnings, *clock))

    def read(self) -> RawImage | None:
        """As of ``Device``."""
        try:
            good, bgr = self._capture.read()
        except cv2.error as error:
            raise CameraError(f"{self.description}: {error}") from error
        arrived_ns = time.monotonic_ns()
        if not good or bgr is None:
            if not self._path.exists():
                raise CameraError(f"{self.description}: is gone; plug it in again")
            return None
        image = np.asarray(bgr, np.uint8)
        if image.shape != (self.size[1], self.size[0], 3):
            return None
        return RawImage(self._stamp_ns(arrived_ns), image)

    def close(self) -> None:
        """As of ``Device``."""
        self._capture.release()

    def _negotiate(self, config: Config, size: tuple[int, int] | None, formats: tuple[str, ...]) -> None:
        """Ask, then read back: a device takes what it cannot do for a wish, and says nothing."""
        capture = self._capture
        if config.fourcc:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        capture.set(cv2.CAP_PROP_FPS, config.fps)
        self.size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.frame_hz = nominal_hz(float(capture.get(cv2.CAP_PROP_FPS)))
        self._warnings: tuple[str, ...] = ()
        given = ioctls.fourcc_text(int(capture.get(cv2.CAP_PROP_FOURCC)))
        if config.fourcc and given != config.fourcc:
            more = ", ..." if len(formats) > SHOWN_FORMATS else ""
            offer = f"; it offers {', '.join(formats[:SHOWN_FORMATS])}{more}" if formats else ""
            self._warnings += (f"requested pixels as {config.fourcc}, it gives {given}{offer}",)
        if abs(self.frame_hz - config.fps) > RATE_TOLERANCE * config.fps:
            self._warnings += (
                f"requested {config.fps:g} images/s, it gives {self.frame_hz:g} at this size and format",
            )

    def _stamp_ns(self, arrived_ns: int) -> int:
        """When the buffer was filled, as the kernel says; else when it arrived here, which ``warnings`` says."""
        stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if -AHEAD_S * 1e9 < arrived_ns - stamp_ns < OLDEST_STAMP_S * 1e9:
            self._clock_warning = ""
            return min(stamp_ns, arrived_ns)
        self._clock_warning = (
            "its buffers carry no stamps of the monotonic clock, so images are stamped when they arrive, some tens of "
            "milliseconds late"
        )
        return arrived_ns


def _examine(path: Path) -> tuple[ioctls.Capability, tuple[str, ...]]:
    """Who it is and its pixel formats.

    Raises:
        CameraError: not there, not allowed, not a camera.
    """
    try:
        with ioctls.opened(path) as fd:
            who = ioctls.query_capability(fd)
            formats = ioctls.list_formats(fd)
    except FileNotFoundError as error:
        raise CameraError(
            f"{path}: no such camera; is it plugged in? `semantic-mapper doctor --cameras` lists them"
        ) from error
    except PermissionError as error:
        raise CameraError(f"{path}: no permission; add yourself to the group `video` and log in again") from error
    except OSError as error:
        kind = "is no video device" if error.errno in (errno.ENOTTY, errno.EINVAL) else "does not answer"
        raise CameraError(
            f"{path}: {kind} ({error.strerror}); `semantic-mapper doctor --cameras` lists them"
        ) from error
    if not who.captures:
        raise CameraError(
            f"{path}: gives no images (it is the metadata of {who.card}, or an output); "
            "`semantic-mapper doctor --cameras` lists those that do"
        )
    return who, formats


@dataclass(frozen=True, slots=True)
class _Wish:
    """A value for a control; ``value`` None = the device's default, ``needed`` = its lack is worth telling."""

    setting: str
    control: int
    value: int | None
    needed: bool = True


def apply_controls(path: Path, config: Config) -> tuple[str, ...]:
    """Set what the config asks for; one sentence for each control that did not follow.

    Controls that the config leaves automatic are set so: a camera keeps what was set before.

    Raises:
        OSError: the device is gone.
    """
    with ioctls.opened(path) as fd:
        controls = ioctls.list_controls(fd)
        by_id = {c.id: c for c in controls.values()}
        warnings = [_set(fd, by_id.get(wish.control), wish) for wish in _wishes(config)]
        for name, value in config.controls.items():
            if name in controls:
                warnings.append(_set(fd, controls[name], _Wish(name, controls[name].id, value)))
            else:
                near = difflib.get_close_matches(name, controls, n=1, cutoff=0.5)
                hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(controls) or 'none'}"
                warnings.append(f"it has no control '{name}'; {hint}")
    return tuple(trouble for trouble in warnings if trouble)


def _wishes(config: Config) -> list[_Wish]:
    """Automatic modes come first: while one is on, a device refuses or forgets the value."""
    wishes: list[_Wish] = []
    if config.exposure_ms:
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_AUTO, ioctls.EXPOSURE_MANUAL, needed=False))
        tenths_ms = max(1, round(config.exposure_ms * 10))
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_ABSOLUTE, tenths_ms))
    else:
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_AUTO, None, needed=False))
    manual = bool(config.white_balance_k)
    wishes.append(_Wish("white_balance_k", ioctls.AUTO_WHITE_BALANCE, int(not manual), needed=False))
    if manual:
        wishes.append(_Wish("white_balance_k", ioctls.WHITE_BALANCE_TEMPERATURE, config.white_balance_k))
    if config.gain >= 0:
        wishes.append(_Wish("gain", ioctls.AUTOGAIN, 0, needed=False))
        wishes.append(_Wish("gain", ioctls.GAIN, config.gain))
    return wishes


def _set(fd: int, control: Control | None, wish: _Wish) -> str:
    """What went otherwise than wished; empty where nothing did."""
    if control is None:
        return f"it has no control for {wish.setting}" if wish.needed else ""
    value = control.default if wish.value is None else wish.value
    span = f"{control.name} goes from {control.minimum} to {control.maximum}"
    try:
        ioctls.set_control(fd, control.id, value)
        given = ioctls.get_control(fd, control.id)
    except OSError as error:
        return f"{wish.setting}: it refuses {control.name} = {value} ({error.strerror or error}); {span}"
    return "" if given == value else f"{wish.setting}: requested {control.name} = {value}, it has {given}; {span}"
