"""A machine with V4L2 cameras: device files and links of udev are real, the kernel (capture, ioctl) is not."""

from __future__ import annotations

import errno
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.v4l2 import devices, ioctls
from semantic_mapper.drivers.v4l2.ioctls import Control

SELECT_S = 0.15  # how long OpenCV waits for a stream that has stalled; 10 s by default
CAPTURE, METADATA = 0x00000001, 0x00800000

EXPOSURE_AUTO = Control(ioctls.EXPOSURE_AUTO, "auto_exposure", 0, 3, 3)
EXPOSURE = Control(ioctls.EXPOSURE_ABSOLUTE, "exposure_time_absolute", 3, 2047, 250)
AUTO_WHITE = Control(ioctls.AUTO_WHITE_BALANCE, "white_balance_automatic", 0, 1, 1)
WHITE = Control(ioctls.WHITE_BALANCE_TEMPERATURE, "white_balance_temperature", 2000, 6500, 4000)
GAIN = Control(ioctls.GAIN, "gain", 0, 100, 16)
FOCUS = Control(0x009A090A, "focus_absolute", 0, 250, 0)


@dataclass
class Sensor:
    """One camera, as good or bad as a test wants it."""

    card: str = "HD Webcam"
    formats: tuple[str, ...] = ("MJPG", "YUYV")
    sizes: tuple[tuple[int, int], ...] = ((64, 48),)
    rate: float = 30.0
    bus: str = "usb-1.2"
    controls: tuple[Control, ...] = (EXPOSURE_AUTO, EXPOSURE, AUTO_WHITE, WHITE, GAIN, FOCUS)
    clock: Any = time.monotonic  # of its buffers
    capabilities: int = CAPTURE
    level: int = 100  # of its images' red; green is 50, blue 0
    stalled: bool = False
    damaged: bool = False
    busy: bool = False
    answers: bool = True
    hangs: threading.Event | None = None  # a read does not return before it is set
    values: dict[int, int] = field(default_factory=dict)
    opens: int = 0


class Machine:
    """Cameras by device file."""

    def __init__(self, folder: Path) -> None:
        self.dev = folder / "dev"
        self.by_id = self.dev / "v4l" / "by-id"
        self.by_id.mkdir(parents=True)
        self._plugged: dict[Path, Sensor] = {}

    def plug(self, sensor: Sensor, index: int, link: str = "usb-HD_Webcam-video-index0") -> Path:
        """Its by-id path; its own where ``link`` is empty."""
        node = self.dev / f"video{index}"
        node.touch()
        self._plugged[node] = sensor
        if not link:
            return node
        (self.by_id / link).symlink_to(node)
        return self.by_id / link

    def unplug(self, sensor: Sensor) -> None:
        node = next(n for n, s in self._plugged.items() if s is sensor)
        for link in list(self.by_id.iterdir()):
            if link.resolve() == node:
                link.unlink()
        node.unlink()
        del self._plugged[node]

    def sensor(self, path: str) -> Sensor | None:
        return self._plugged.get(Path(path).resolve())

    def has(self, sensor: Sensor) -> bool:
        return any(s is sensor for s in self._plugged.values())

    def ioctl(self, fd: int, request: int, told: Any) -> int:
        """As the kernel fills in its structures."""
        sensor = self.sensor(os.readlink(f"/proc/self/fd/{fd}"))
        if sensor is None:
            raise OSError(errno.ENODEV, "No such device")
        if not sensor.answers:
            raise OSError(errno.EIO, "Input/output error")
        controls = {c.id: c for c in sensor.controls}
        if request == ioctls.QUERYCAP:
            told.card, told.driver, told.bus_info = sensor.card.encode(), b"uvcvideo", sensor.bus.encode()
            told.capabilities, told.device_caps = 0x80000000 | CAPTURE | METADATA, sensor.capabilities
        elif request == ioctls.ENUM_FMT and told.index < len(sensor.formats):
            told.pixelformat = cv2.VideoWriter.fourcc(*sensor.formats[told.index])
        elif request == ioctls.QUERYCTRL and (later := [i for i in sorted(controls) if i > told.id & 0x7FFFFFFF]):
            c = controls[later[0]]
            told.id, told.name = c.id, c.name.replace("_", " ").title().encode()
            told.minimum, told.maximum, told.default, told.flags = c.minimum, c.maximum, c.default, 0
        elif request == ioctls.S_CTRL and told.id in controls:
            c = controls[told.id]
            if c is EXPOSURE and sensor.values.get(ioctls.EXPOSURE_AUTO, 3) != ioctls.EXPOSURE_MANUAL:
                raise OSError(errno.EACCES, "Permission denied")
            sensor.values[told.id] = min(max(told.value, c.minimum), c.maximum)
        elif request == ioctls.G_CTRL and told.id in controls:
            told.value = sensor.values.get(told.id, controls[told.id].default)
        else:
            raise OSError(errno.EINVAL, "Invalid argument")
        return 0

    def capture(self, path: str, backend: int) -> Capture:
        assert backend == cv2.CAP_V4L2
        return Capture(self, self.sensor(path))


class Capture:
    """``cv2.VideoCapture`` as it behaves over V4L2; used by one thread at a time."""

    def __init__(self, machine: Machine, sensor: Sensor | None) -> None:
        self._machine = machine
        self._sensor = sensor
        self._open = sensor is not None and not sensor.busy
        self._thread = threading.get_ident()
        self._stamp_s = 0.0
        if sensor is not None:
            sensor.opens += 1
            self._fourcc, self._size, self._asked = sensor.formats[0], sensor.sizes[0], [0, 0]

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self._open  # also when the device is gone

    def set(self, name: int, value: float) -> bool:
        assert self._sensor is not None
        if name == cv2.CAP_PROP_FOURCC:
            wish = ioctls.fourcc_text(int(value))
            self._fourcc = wish if wish in self._sensor.formats else self._sensor.formats[-1]
        elif name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            self._asked[name == cv2.CAP_PROP_FRAME_HEIGHT] = int(value)
            if all(self._asked):
                self._size = min(self._sensor.sizes, key=lambda s: abs(s[0] - self._asked[0]))
        return True  # whatever came of it

    def get(self, name: int) -> float:
        assert self._sensor is not None
        return {
            cv2.CAP_PROP_FRAME_WIDTH: self._size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: self._size[1],
            cv2.CAP_PROP_FPS: self._sensor.rate,
            cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*self._fourcc),
            cv2.CAP_PROP_POS_MSEC: self._stamp_s * 1000,
        }[name]

    def read(self) -> tuple[bool, np.ndarray | None]:
        sensor = self._sensor
        assert sensor is not None and self._open
        if not self._machine.has(sensor):
            return False, None
        if sensor.stalled:
            time.sleep(SELECT_S)
            return False, None
        time.sleep(0.005)
        if sensor.hangs is not None:
            sensor.hangs.wait()
        if sensor.damaged:
            return False, None
        self._stamp_s = sensor.clock() - 0.02
        image = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        image[..., 1], image[..., 2] = 50, sensor.level
        return True, image

    def release(self) -> None:
        self._open = False


def make_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """No cameras yet."""
    made = Machine(tmp_path)
    monkeypatch.setattr(ioctls, "fcntl", SimpleNamespace(ioctl=made.ioctl))
    monkeypatch.setattr(cv2, "VideoCapture", made.capture)
    monkeypatch.setattr(devices, "DEVICES", made.dev)
    monkeypatch.setattr(devices, "LINKS", (made.by_id,))
    return made
