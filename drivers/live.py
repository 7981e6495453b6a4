"""Live cameras, whose device may go away and come back: those that OpenCV reads, and those of an SDK that is polled."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, UInt8

FIRST_PAUSE_S = 0.1  # before a lost device is tried again; doubles each time
MAX_PAUSE_S = 1.0
FAILURES = 3  # reads in a row that give nothing: the device is opened again
WAIT_SLICE_S = 0.2
SLICE_S = 0.1  # how soon a polled camera notices a stop
RETRY_S = 1.0  # between two attempts to find a polled device that has gone
FUTURE_NS = 100_000_000  # a stamp further ahead of now is wrong
MIN_HZ = 1e-3  # of a film or camera: one divided by it is still a time
DRIFT = 2e-4  # how much faster or slower than ours the sender's clock may run
LATE_NS = 1_000_000_000  # an image is never so much later than the quickest one: then its clock is not usable
CLOSE_S = 1.0  # how long closing waits for a read that hangs; its thread frees the device whenever it returns

NOT_CALIBRATED = "not calibrated: the intrinsics are a guess, good for calibrating only"

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
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

    def read(self) -> RawImage | None:
        """The next image, waited for; None where none came or it was damaged.

        Raises:
            CameraError: the device is gone.
        """
        ...

    def close(self) -> None:
        """Free it."""
        ...


class LiveCamera(Camera):
    """A ``Camera`` that OpenCV reads: one thread owns the device, the newest image wins, a lost device is waited for.

    The thread is the only one that touches the device, since a read of a stalled stream may hang for seconds.

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
        super().__init__(camera_id)
        self._open_device = open_device
        self._measured = measured
        self._stall_s = stall_s
        self._metadata = metadata
        self._rectify: Rectifier | None = None
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._newest: tuple[int, RawImage] | None = None  # number and image; guarded by _changed
        self._seq = -1  # of the last image; only the thread counts
        self._failures = 0  # to open the device again, in a row
        self._heard = self._read_at = self._last_request = 0.0
        self._lost = ""
        self._device_warnings: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        warnings = list(self._device_warnings)
        if self._measured is None:
            warnings.append(NOT_CALIBRATED)
        silent_s = time.monotonic() - self._heard
        if self._lost:
            warnings.append(f"{self._lost}; waited for since {silent_s:.0f} s")
        elif self._thread is not None and silent_s > self._stall_s:
            warnings.append(f"no image for {silent_s:.1f} s: the stream has stalled")
        return tuple(warnings)

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return min(self._read_at, self._last_request)

    def __enter__(self) -> Self:
        """As of ``Camera``."""
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
        """The newest image each time; what was captured meanwhile is a gap in ``seq``."""
        rectify, thread = self._rectify, self._thread
        if rectify is None or thread is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        while not self._stopping.is_set():
            self._last_request = time.monotonic()
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._stopping.is_set(), WAIT_SLICE_S)
                newest, self._newest = self._newest, None
            if newest is not None and not self._stopping.is_set():
                seq, picture = newest
                yield CameraImage(
                    picture.stamp_ns, seq, self._camera_id, rectify(picture.bgr), None, rectify.intrinsics
                )
            elif not thread.is_alive() and not self._stopping.is_set():
                raise CameraError(f"camera '{self._camera_id}': its reading thread has failed; the log says why")

    def _open(self) -> Device:
        """Raises: CameraError: it is not there, or its images have another size than was calibrated."""
        device = self._open_device()
        expected = device.size if self._measured is None else (self._measured.width, self._measured.height)
        if device.size != expected:
            device.close()
            raise CameraError(
                f"{device.description}: gives images of {device.size[0]}x{device.size[1]}, but was calibrated at "
                f"{expected[0]}x{expected[1]}; calibrate for a size that it offers"
            )
        self._device_warnings = device.warnings
        return device

    def _run(self, device: Device) -> None:
        """Read until it is stopped; open it again when it is lost."""
        while True:
            try:
                lost = self._read_on(device)
            finally:
                device.close()
            if self._stopping.is_set():
                return
            self._lost = lost
            self._seq += 1  # a gap shows it, even if nothing else was lost
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
                picture = device.read()
            except CameraError as error:
                return str(error)
            now = self._read_at = time.monotonic()
            self._seq += 1
            self._device_warnings = device.warnings
            if picture is None:
                failures += 1
                if failures >= FAILURES or now - began >= self._stall_s:
                    return f"{device.description}: gives no images"
                continue
            failures = 0
            if self._lost:
                _log.info("camera_back", camera=self._camera_id, device=device.description, seq=self._seq)
            self._failures, self._heard, self._lost = 0, now, ""
            with self._changed:
                self._newest = (self._seq, picture)
                self._changed.notify()
        return ""

    def _open_again(self) -> Device | None:
        """Wait for the device, longer each time; None where it was stopped."""
        while not self._stopping.wait(min(FIRST_PAUSE_S * 2.0 ** min(self._failures, 64), MAX_PAUSE_S)):
            self._read_at = time.monotonic()
            self._failures += 1
            try:
                return self._open()
            except CameraError as error:
                self._lost = str(error)
        return None


class StreamEnded(Exception):  # noqa: N818 -- an event, not an error: the camera is gone and may come back
    """The device has gone, or gives nothing any more; the text says which."""


class PolledCamera(Camera):
    """Base of a camera over an SDK that is polled; a device that goes away is looked for until it is back."""

    def __init__(self, camera_id: str) -> None:
        super().__init__(camera_id)
        self._connected = False

    def __enter__(self) -> Self:
        """Open the device and wait for its first image."""
        self._connect(again=False)
        self._connected = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free the device."""
        self._disconnect()

    def __iter__(self) -> Iterator[CameraImage]:
        """As of ``Camera``."""
        source = self.info.source
        while not self._stopping.is_set():
            self._last_poll_time = time.monotonic()
            if self._connected:
                try:
                    yield from self._images()
                except StreamEnded as end:
                    self._connected = False
                    self._warn_of_device(f"{source}: {end}; it is looked for every {RETRY_S:g} s")
                    _log.warning("camera_lost", camera=self._camera_id, device=source, reason=str(end))
                    self._disconnect()
            elif not self._stopping.wait(RETRY_S):
                try:
                    self._connect(again=True)
                    self._connected = True
                except CameraError as error:
                    self._warn_of_device(f"{source} is away: {error}")

    def _connect(self, *, again: bool) -> None:
        """Open the device, start it, and set ``_info``; ``again``: it was away, and is looked for once.

        Raises:
            CameraError: it does not work, and nothing is left open.
        """
        raise NotImplementedError

    def _images(self) -> Iterator[CameraImage]:
        """Images of one connection.

        Raises:
            StreamEnded: at its end.
        """
        raise NotImplementedError

    def _disconnect(self) -> None:
        """Free the device; one that has gone already is no error."""
        raise NotImplementedError

    def _warn_of_device(self, text: str) -> None:
        """Keep it for ``warnings``, until an image comes."""
        raise NotImplementedError


def nominal_hz(reported: float) -> float:
    """A rate as a container or a device reports it; 0 for what cannot be one."""
    return reported if MIN_HZ <= reported <= 1000 else 0.0


class FrameCounter:
    """Numbers a camera's images from 0, with jumps where images were lost, over all its connections.

    Args:
        hz: Nominal rate, by which the images that are lost while the device is away are counted.
    """

    def __init__(self, hz: float) -> None:
        self._period_ns = 1e9 / hz
        self._last: tuple[int, int] | None = None  # number and stamp of the last image
        self._shift: int | None = None  # from the device's numbers to ours; None = not known of this connection

    def restart(self) -> None:
        """The device counts again from here."""
        self._shift = None

    def refusal(self, stamp_ns: int) -> str:
        """Why an image of this stamp is passed over (not later than the one before, or of the future); or empty."""
        if stamp_ns > time.monotonic_ns() + FUTURE_NS:
            return "its stamp is in the future: check the clocks of this machine and of the device"
        if self._last is not None and stamp_ns <= self._last[1]:
            return "its stamp is not later than that of the image before"
        return ""

    def number(self, counted: int, stamp_ns: int) -> int:
        """Number of the image that the device counts as ``counted``."""
        number = 0
        if self._last is not None:
            last, last_ns = self._last
            number = counted + self._shift if self._shift is not None else last
            if number <= last:  # the device counts again: ask the clock
                number = last + max(2, round((stamp_ns - last_ns) / self._period_ns))
        self._shift = number - counted
        self._last = (number, stamp_ns)
        return number


class StreamClock:
    """Stamps images by the sender's clock.

    An image needs at least as long as the quickest one, so the least distance between arrival and the sender's time
    is the distance of the clocks (plus the way of that quickest image). It may grow by ``DRIFT``.
    """

    def __init__(self) -> None:
        self.trustworthy = True
        self._offset_ns: float | None = None
        self._last_arrival_ns = 0
        self._last_sent_ns = 0

    def stamp_ns(self, sent_ns: int, arrived_ns: int) -> int:
        """When an image was sent, on our clock; when it arrived, from when on the sender's clock is not one."""
        distance = float(arrived_ns - sent_ns)
        if self._offset_ns is None:
            self._offset_ns = distance
        elif sent_ns <= self._last_sent_ns:
            self.trustworthy = False
        else:
            grown = self._offset_ns + DRIFT * (arrived_ns - self._last_arrival_ns)
            self._offset_ns = min(distance, grown)
            self.trustworthy = self.trustworthy and distance - self._offset_ns < LATE_NS
        self._last_arrival_ns, self._last_sent_ns = arrived_ns, sent_ns
        return round(sent_ns + self._offset_ns) if self.trustworthy else arrived_ns
