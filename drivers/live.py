"""Live cameras that OpenCV reads: one thread owns the device, the newest image wins, a lost device is waited for.

The thread is the only one that touches the device, since a read of a stalled stream may hang for seconds.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from semantic_mapper.backoff import backoff_s
from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, UInt8

FIRST_PAUSE_S = 0.1  # before a lost device is tried again; doubles each time
MAX_PAUSE_S = 1.0
FAILURES = 3  # reads in a row that give nothing: the device is opened again
WAIT_SLICE_S = 0.2
CLOSE_S = 1.0  # how long closing waits for a read that hangs; its thread frees the device whenever it returns

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One image as the device gave it: (H, W, 3) BGR, and when it was captured on the monotonic clock."""

    stamp_ns: int
    bgr: UInt8


class Device(Protocol):
    """An open device, used by one thread."""

    @property
    def description(self) -> str:
        """For people: model and address."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its images."""
        ...

    @property
    def frame_hz(self) -> float:
        """Nominal rate, 0 = not known."""
        ...

    @property
    def warnings(self) -> tuple[str, ...]:
        """What it does other than requested."""
        ...

    def read(self) -> Shot | None:
        """The next image, waited for; None where none came or it was damaged.

        Raises:
            CameraError: the device is gone.
        """
        ...

    def close(self) -> None:
        """Free it."""
        ...


class LiveCamera:
    """A ``Camera`` over a device that may go away and come back.

    Args:
        camera_id: What its images are called.
        open_device: Opens it, each time again; raises ``CameraError`` where it is not there.
        measured: Its calibration; None: guessed, said in ``warnings``.
        stall_s: Silence after which a stream counts as stalled.
        metadata: For ``StreamInfo``.
    """

    def __init__(
        self,
        camera_id: str,
        open_device: Callable[[], Device],
        measured: CameraIntrinsics | None,
        stall_s: float,
        metadata: dict[str, str],
    ) -> None:
        self._camera_id = camera_id
        self._open_device = open_device
        self._measured = measured
        self._stall_s = stall_s
        self._metadata = metadata
        self._info: StreamInfo | None = None
        self._rectify: Rectifier | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._changed = threading.Condition()
        self._newest: tuple[int, Shot] | None = None  # number and image; guarded by _changed
        self._seq = -1  # of the last image; only the thread counts
        self._failures = 0  # to open the device again, in a row
        self._heard = self._read_at = self._last_request = 0.0
        self._lost = ""
        self._device_troubles: tuple[str, ...] = ()

    @property
    def info(self) -> StreamInfo:
        """As of ``Camera``."""
        if self._info is None:
            raise CameraError(f"camera '{self._camera_id}' is not open yet")
        return self._info

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        told = list(self._device_troubles)
        if self._measured is None:
            told.append("not calibrated: the intrinsics are a guess, good for calibrating only")
        silent_s = time.monotonic() - self._heard
        if self._lost:
            told.append(f"{self._lost}; waited for since {silent_s:.0f} s")
        elif self._thread is not None and silent_s > self._stall_s:
            told.append(f"no image for {silent_s:.1f} s: the stream has stalled")
        return tuple(told)

    @property
    def can_wait(self) -> bool:
        """As of ``Camera``."""
        return False

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return min(self._read_at, self._last_request)

    def __enter__(self) -> Self:
        """Open the device.

        Raises:
            CameraError: it is not there, or its images have another size than was calibrated.
        """
        device = self._open()
        intrinsics = self._measured or guess_intrinsics(*device.size)
        rectify = self._rectify = Rectifier(intrinsics)
        self._info = StreamInfo(
            source=device.description,
            cameras={self._camera_id: rectify.intrinsics},
            frame_hz=device.frame_hz,
            metadata=self._metadata,
        )
        self._heard = self._read_at = self._last_request = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(device,), name=f"camera {self._camera_id}", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def __iter__(self) -> Iterator[CameraImage]:
        """The newest image each time; what was captured meanwhile is a gap in ``seq``.

        Raises:
            CameraError: not open, or the reading thread has failed.
        """
        rectify, thread = self._rectify, self._thread
        if rectify is None or thread is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        while not self._stopping.is_set():
            self._last_request = time.monotonic()
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._stopping.is_set(), WAIT_SLICE_S)
                newest, self._newest = self._newest, None
            if newest is not None and not self._stopping.is_set():
                seq, shot = newest
                yield CameraImage(shot.stamp_ns, seq, self._camera_id, rectify(shot.bgr), None, rectify.intrinsics)
            elif not thread.is_alive() and not self._stopping.is_set():
                raise CameraError(f"camera '{self._camera_id}': its reading thread has failed; the log says why")

    def stop(self) -> None:
        """As of ``Camera``."""
        self._stopping.set()  # no lock: a signal handler may interrupt whoever holds it

    def _open(self) -> Device:
        """Raises: CameraError: see ``__enter__``."""
        device = self._open_device()
        expected = device.size if self._measured is None else (self._measured.width, self._measured.height)
        if device.size != expected:
            device.close()
            raise CameraError(
                f"{device.description}: gives images of {device.size[0]}x{device.size[1]}, but was calibrated at "
                f"{expected[0]}x{expected[1]}; calibrate for a size that it offers"
            )
        self._device_troubles = device.warnings
        return device

    def _run(self, device: Device) -> None:
        """Read until told to stop; open it again when it is lost."""
        while True:
            try:
                lost = self._read_on(device)
            finally:
                device.close()
            if self._stopping.is_set():
                return
            self._lost = lost
            self._seq += 1  # a gap tells of it, even if nothing else was lost
            _log.warning("camera_lost", camera=self._camera_id, reason=lost)
            again = self._open_again()
            if again is None:
                return
            device = again

    def _read_on(self, device: Device) -> str:
        """Read until it is lost, and say why; empty where it was stopped."""
        failures = 0
        while not self._stopping.is_set():
            began = time.monotonic()
            try:
                shot = device.read()
            except CameraError as error:
                return str(error)
            now = self._read_at = time.monotonic()
            self._seq += 1
            self._device_troubles = device.warnings
            if shot is None:
                failures += 1
                if failures >= FAILURES or now - began >= self._stall_s:
                    return f"{device.description}: gives no images"
                continue
            failures = 0
            if self._lost:
                _log.info("camera_back", camera=self._camera_id, device=device.description, seq=self._seq)
            self._failures, self._heard, self._lost = 0, now, ""
            with self._changed:
                self._newest = (self._seq, shot)
                self._changed.notify()
        return ""

    def _open_again(self) -> Device | None:
        """Wait for the device, longer each time; None where it was stopped."""
        while not self._stopping.wait(backoff_s(self._failures + 1, FIRST_PAUSE_S, MAX_PAUSE_S)):
            self._read_at = time.monotonic()
            self._failures += 1
            try:
                return self._open()
            except CameraError as error:
                self._lost = str(error)
        return None
