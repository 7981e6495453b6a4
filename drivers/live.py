"""Live cameras: devices that may go away and come back, read by a thread of their own."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Self, TypeVar

import cv2
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage, as_camera_error
from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

FIRST_PAUSE_S = 0.1  # before a lost device is tried again; doubles each time
MAX_PAUSE_S = 1.0
START_S = 20.0  # how long a device may take for its first image
STALL_S = 3.0  # without an image for so long, a device is opened again
QUEUE = 1  # images that wait for their reader; the oldest gives way, which is a gap
SLICE_S = 0.1  # how long a device that is polled waits for an image at a time
FUTURE_NS = 100_000_000  # a stamp further ahead of now is wrong
MIN_HZ, MAX_HZ = 1e-3, 1e3  # beyond, what a container or device reports is no rate
DRIFT = 2e-4  # how much faster or slower than ours the sender's clock may run
LATE_NS = 1_000_000_000  # an image is never so much later than the quickest one: then its clock is not usable
CLOSE_S = 5.0  # how long closing waits for a read that hangs; its thread frees the device whenever it returns
_WAIT_SLICE_S = 0.2
_DAMAGED_PAUSE_S = 0.01  # after a read that gave nothing: it may have failed at once

NOT_CALIBRATED = "not calibrated: the intrinsics are a guess, good for calibrating only"

FirstT = TypeVar("FirstT")

_log = get_logger(__name__)


class Device:
    """Base of an open device, used by one thread. Its constructor raises ``CameraError`` where it cannot be had."""

    info: StreamInfo  # its description, intrinsics and rate

    @property
    def warnings(self) -> tuple[str, ...]:
        """What it does other than requested; any thread may ask."""
        return ()

    def read(self) -> CameraImage | None:
        """The next image, waited for; ``seq`` is the device's own count. None where none came or it was damaged.

        Raises CameraError: the device is gone, or gives what cannot be used.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Free it; one that has gone already is no error."""
        raise NotImplementedError


class LiveCamera(Camera):
    """A thread owns the device, since a read may hang for seconds. The newest image wins; a lost device is waited for.

    ``open_device`` opens it, each time again (``CameraError``: not there), and gets an event that tells it to give up.
    After ``stall_s`` of silence a stream counts as stalled.
    """

    def __init__(
        self, camera_id: str, open_device: Callable[[threading.Event], Device], stall_s: float = STALL_S
    ) -> None:
        super().__init__(camera_id)
        self._open_device = open_device
        self._stall_s = stall_s
        self._device: Device | None = None
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._waiting: deque[CameraImage] = deque(maxlen=QUEUE)  # guarded by _changed
        self._counter = FrameCounter()
        self._heard = self._read_at = self._last_request = 0.0
        self._lost = self._refused = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        warnings = [*(self._device.warnings if self._device is not None else ())]
        silent_s = time.monotonic() - self._heard
        if self._refused:
            warnings.append(f"images are passed over: {self._refused}")
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
        self._heard = self._read_at = self._last_request = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(device,), name=f"camera {self._camera_id}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def __iter__(self) -> Iterator[CameraImage]:
        """The newest image each time; what was captured meanwhile is a gap in ``seq``."""
        if self._thread is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        while not self._stopping.is_set():
            self._last_request = time.monotonic()
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping.is_set(), _WAIT_SLICE_S)
                image = self._waiting.popleft() if self._waiting else None
            if image is not None and not self._stopping.is_set():
                yield image
            elif not self._thread.is_alive() and not self._stopping.is_set():
                raise CameraError(f"camera '{self._camera_id}': its reading thread has failed; the log says why")

    def _open(self) -> Device:
        device = self._device = self._open_device(self._stopping)
        self._info = device.info
        self._counter.restart(device.info.frame_hz)
        _log.info("camera_connected", camera=self._camera_id, device=device.info.source)
        return device

    def _run(self, device: Device | None) -> None:
        """Read until it is stopped; open it again when it is lost."""
        while device is not None:
            try:
                self._lost = self._read_on(device)
            finally:
                device.close()
            if self._stopping.is_set():
                return
            _log.warning("camera_lost", camera=self._camera_id, reason=self._lost)
            device = self._open_again()

    def _read_on(self, device: Device) -> str:
        """Read until it is lost, and say why; empty where it was stopped."""
        heard = time.monotonic()
        while not self._stopping.is_set():
            try:
                image = device.read()
            except CameraError as error:
                return str(error)
            now = self._read_at = time.monotonic()
            self._refused = "" if image is None else self._counter.refusal(image.stamp_ns)
            if image is None or self._refused:
                if now - heard > self._stall_s:
                    return f"{device.info.source}: gives no images"
                self._stopping.wait(_DAMAGED_PAUSE_S)
                continue
            heard = self._heard = now
            self._lost = ""
            image = self._counter.numbered(image)
            with self._changed:
                self._waiting.append(image)
                self._changed.notify()
        return ""

    def _open_again(self) -> Device | None:
        """Wait for the device, longer each time; None where it was stopped."""
        pause_s = FIRST_PAUSE_S
        while not self._stopping.wait(pause_s):
            pause_s = min(2 * pause_s, MAX_PAUSE_S)
            self._read_at = time.monotonic()
            try:
                return self._open()
            except CameraError as error:
                self._lost = str(error)
        return None


class CaptureDevice(Device):
    """A ``Device`` that OpenCV reads, each image rectified; ``CameraError``: ``capture`` gives no images, or of another
    size than was calibrated. ``source``: model and address for people. ``measured`` None: guessed, as ``warnings`` say.
    """

    def __init__(
        self,
        camera_id: str,
        source: str,
        capture: cv2.VideoCapture,
        measured: CameraIntrinsics | None,
        metadata: dict[str, str],
    ) -> None:
        self._camera_id = camera_id
        self._capture = capture
        self._count = -1
        self._notes: list[str] = [] if measured is not None else [NOT_CALIBRATED]
        size = (round(self.get(cv2.CAP_PROP_FRAME_WIDTH)), round(self.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if min(size) <= 0:
            capture.release()
            raise CameraError(f"{source}: holds no video that OpenCV can read; is it complete, and its codec common?")
        measured = measured or guess_intrinsics(*size)
        width, height = measured.width, measured.height
        if size != (width, height):
            capture.release()
            raise CameraError(
                f"{source}: gives images of {size[0]}x{size[1]}, but was calibrated at {width}x{height}; calibrate for "
                "a size that it offers"
            )
        self._rectify = Rectifier(measured)
        hz = self.get(cv2.CAP_PROP_FPS)
        hz = hz if MIN_HZ <= hz <= MAX_HZ else 0.0
        self.info = StreamInfo(source, {camera_id: self._rectify.intrinsics}, frame_hz=hz, metadata=metadata)

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        return tuple(self._notes)

    def get(self, name: int) -> float:
        """A property of the capture; 0 for what is no number."""
        value = float(self._capture.get(name))
        return value if np.isfinite(value) else 0.0

    def read(self) -> CameraImage | None:
        """As of ``Device``."""
        self._count += 1
        with as_camera_error(self.info.source, "is it an image or video that OpenCV can read?", cv2.error):
            good, bgr = self._capture.read()
        arrived_ns = time.monotonic_ns()
        intrinsics = self._rectify.intrinsics
        if not good or bgr is None:
            return self._nothing()
        if bgr.shape != (intrinsics.height, intrinsics.width, 3):
            return None
        rgb = self._rectify(np.asarray(bgr, np.uint8))
        return CameraImage(self._stamp_ns(arrived_ns), self._count, self._camera_id, rgb, None, intrinsics)

    def close(self) -> None:
        """As of ``Device``."""
        self._capture.release()

    def _nothing(self) -> None:
        """There was no image; raises ``CameraError`` where there will be no more."""

    def _stamp_ns(self, arrived_ns: int) -> int:
        """When the last image was captured."""
        raise NotImplementedError


def first_of(read: Callable[[], FirstT | None], stopping: threading.Event, name: str) -> FirstT:
    """The first thing that a device gives.

    Raises CameraError: it gives nothing for ``START_S``, or a stop was requested.
    """
    deadline = time.monotonic() + START_S
    while not stopping.is_set() and time.monotonic() < deadline:
        if (found := read()) is not None:
            return found
    raise CameraError(
        f"{name} was opened, but has given no image for {START_S:g} s: plug it in again, or set a lower `fps`"
    )


class FrameCounter:
    """Numbers a camera's images from 0, with jumps where images were lost, over all its connections."""

    def __init__(self) -> None:
        self._hz = 0.0
        self._last: tuple[int, int] | None = None  # number and stamp of the last image
        self._shift: int | None = None  # from the device's numbers to ours; None = not known of this connection

    def restart(self, hz: float) -> None:
        """The device counts again from here; its nominal rate tells how many images it lost meanwhile."""
        self._hz = hz
        self._shift = None

    def refusal(self, stamp_ns: int) -> str:
        """Why an image of this stamp is passed over (not later than the one before, or of the future); or empty."""
        if stamp_ns > time.monotonic_ns() + FUTURE_NS:
            return "its stamp is in the future: check the clocks of this machine and of the device"
        if self._last is not None and stamp_ns <= self._last[1]:
            return "its stamp is not later than that of the image before"
        return ""

    def numbered(self, image: CameraImage) -> CameraImage:
        """An image that the device counts as ``seq``, with our number."""
        number = 0
        if self._last is not None:
            last, last_ns = self._last
            number = image.seq + self._shift if self._shift is not None else last
            if number <= last:  # the device counts again: ask the clock
                number = last + max(2, round((image.stamp_ns - last_ns) / 1e9 * self._hz))
        self._shift = number - image.seq
        self._last = (number, image.stamp_ns)
        return replace(image, seq=number)


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
