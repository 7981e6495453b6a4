"""V4L2 cameras: size, rate, pixel format and controls are set, and what the device gives instead is read back."""

import threading
from contextlib import ExitStack
from pathlib import Path

import cv2

import semantic_mapper.drivers.v4l2.ioctls as ioctls
from semantic_mapper.config import nearest
from semantic_mapper.drivers.base import as_camera_error
from semantic_mapper.drivers.calibration import require_calibration
from semantic_mapper.drivers.live import CaptureDevice, LiveCamera
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.devices import SHOWN_FORMATS, stable_path
from semantic_mapper.drivers.v4l2.devices import list_devices as list_devices
from semantic_mapper.errors import CameraError
from semantic_mapper.types import CameraIntrinsics

OLDEST_STAMP_S = 10.0  # a buffer is never older; a stamp that is comes from another clock
AHEAD_S = 0.1  # so far a driver may foretell the end of an exposure
RATE_TOLERANCE = 0.02  # 29.97 is 30
_CLOCK = "its buffers carry no stamps of the monotonic clock, so images are stamped when they arrive, some ms late"


def open_camera(config: Config, camera_id: str = "camera") -> LiveCamera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``."""
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

    def open_device(_: threading.Event) -> V4l2Device:
        nonlocal known
        if known == named:  # it was not there yet, or udev had not named it
            known = stable_path(named)
        return V4l2Device(camera_id, known, config, measured, size)

    return LiveCamera(camera_id, open_device, config.stall_s)


class V4l2Device(CaptureDevice):
    """A device file, best a link by its id; raises ``CameraError`` where it is not there, not allowed or in use."""

    def __init__(
        self,
        camera_id: str,
        path: Path,
        config: Config,
        measured: CameraIntrinsics | None,
        size: tuple[int, int] | None,
    ) -> None:
        self._path = path
        fix = "is it plugged in, is it a camera, and are you in the group `video`? `doctor --cameras` lists them"
        with as_camera_error(f"{path}: no such camera", fix, OSError), ioctls.opened(path) as fd:
            who, formats = ioctls.query_capability(fd), ioctls.list_formats(fd)
        if not who.captures:
            raise CameraError(f"{path}: no such camera: it is the metadata of {who.card}, or an output; {fix}")
        source = f"V4L2 {who.card} at {path}"
        capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        if not capture.isOpened():
            raise CameraError(f"{source}: cannot be opened for streaming; is another program using it?")
        if config.fourcc:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        capture.set(cv2.CAP_PROP_FPS, config.fps)
        super().__init__(camera_id, source, capture, measured, {"driver": "v4l2", "device": config.device})
        self._other_clock = False
        # A device takes what it cannot do for a wish, and says nothing.
        given, hz = ioctls.fourcc_text(round(self.get(cv2.CAP_PROP_FOURCC))), self.info.frame_hz
        if config.fourcc and given != config.fourcc:
            offer = ", ".join(formats[:SHOWN_FORMATS])
            self._notes.append(f"{source}: requested pixels as {config.fourcc}, it gives {given}; it offers {offer}")
        if abs(hz - config.fps) > RATE_TOLERANCE * config.fps:
            self._notes.append(f"{source}: requested {config.fps:g} images/s, it gives {hz:g} at this size and format")
        with (
            ExitStack() as undo,
            as_camera_error(f"{source}: went away while it was opened", "plug it in again", OSError),
        ):
            undo.callback(capture.release)
            self._notes += [f"{source}: {trouble}" for trouble in apply_controls(path, config)]
            undo.pop_all()

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        return (*super().warnings, *((f"{self.info.source}: {_CLOCK}",) if self._other_clock else ()))

    def _nothing(self) -> None:
        if not self._path.exists():
            raise CameraError(f"{self.info.source}: is gone; plug it in again")

    def _stamp_ns(self, arrived_ns: int) -> int:
        """When the buffer was filled, as the kernel says; else when it arrived here, which ``warnings`` says."""
        stamp_ns = round(self.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        self._other_clock = not -AHEAD_S * 1e9 < arrived_ns - stamp_ns < OLDEST_STAMP_S * 1e9
        return arrived_ns if self._other_clock else min(stamp_ns, arrived_ns)


def apply_controls(path: Path, config: Config) -> list[str]:
    """Set what the config asks for; one sentence for each control that did not follow.

    Controls that the config leaves automatic are set so: a camera keeps what was set before. Raises ``OSError`` where
    the device is gone.
    """
    exposure = max(1, round(config.exposure_ms * 10)) if config.exposure_ms else None
    white = config.white_balance_k or None
    gain = config.gain if config.gain >= 0 else None
    warnings: list[str] = []
    with ioctls.opened(path) as fd:
        controls = ioctls.list_controls(fd)
        by_id = {control.id: control for control in controls.values()}
        # Automatic modes first: while one is on, a device refuses the value. None: its default.
        modes = [
            ("exposure_ms", ioctls.EXPOSURE_AUTO, ioctls.EXPOSURE_MANUAL if exposure else None),
            ("white_balance_k", ioctls.AUTO_WHITE_BALANCE, int(white is None)),
            *([("gain", ioctls.AUTOGAIN, 0)] if gain is not None else []),
        ]
        values = [
            ("exposure_ms", by_id.get(ioctls.EXPOSURE_ABSOLUTE), exposure),
            ("white_balance_k", by_id.get(ioctls.WHITE_BALANCE_TEMPERATURE), white),
            ("gain", by_id.get(ioctls.GAIN), gain),
            *((name, controls.get(name), value) for name, value in config.controls.items()),
        ]
        wanted = [(s, by_id[mode], value) for s, mode, value in modes if mode in by_id]
        for setting, control, value in [*wanted, *(row for row in values if row[2] is not None)]:
            if control is None:
                warnings.append(f"it has no control '{setting}'{nearest(setting, [*controls])}")
                continue
            value = control.default if value is None else value
            try:
                given = f"{ioctls.set_control(fd, control.id, value)}"
            except OSError as error:
                given = f"an error ({error.strerror or error})"
            if given != f"{value}":
                span = f"{control.name} goes from {control.minimum} to {control.maximum}"
                warnings.append(f"{setting}: requested {control.name} = {value}, it has {given}; {span}")
    return warnings
