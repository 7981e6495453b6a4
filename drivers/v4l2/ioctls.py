"""What the kernel says of a video device beyond what OpenCV asks: who it is, its formats, its controls.

Layouts and numbers are those of linux/videodev2.h, the same on all 64 bit machines. All functions raise ``OSError``
where a device cannot be opened, does not answer or refuses.
"""

import ctypes
import errno
import fcntl
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

EXPOSURE_AUTO = 0x009A0901
EXPOSURE_ABSOLUTE = 0x009A0902  # in 100 microseconds
AUTO_WHITE_BALANCE = 0x0098090C
WHITE_BALANCE_TEMPERATURE = 0x0098091A
AUTOGAIN = 0x00980912
GAIN = 0x00980913
EXPOSURE_MANUAL = 1  # of EXPOSURE_AUTO

LOWEST, HIGHEST = -(2**31), 2**31 - 1  # value of a control; ctypes would pass on what is left of a larger one

_CAP_VIDEO_CAPTURE = 0x00000001
_CAP_DEVICE_CAPS = 0x80000000
_BUF_TYPE_VIDEO_CAPTURE = 1
_CTRL_FLAG_DISABLED = 0x0001
_CTRL_FLAG_NEXT = 0x80000000
_FOURCC_BIG_ENDIAN = 1 << 31
_MAX_ROWS = 1024  # a driver that never says that it is at the end shall not hang us


_u32, _i32 = ctypes.c_uint32, ctypes.c_int32
_text16, _text32 = ctypes.c_char * 16, ctypes.c_char * 32


def _structure(**fields: Any) -> Any:
    return type("_Structure", (ctypes.Structure,), {"_fields_": tuple(fields.items())})


_Capability = _structure(
    driver=_text16, card=_text32, bus_info=_text32, version=_u32, capabilities=_u32, device_caps=_u32, rest=_u32 * 3
)
_Format = _structure(
    index=_u32, type=_u32, flags=_u32, description=_text32, pixelformat=_u32, mbus_code=_u32, rest=_u32 * 3
)
_QueryControl = _structure(
    id=_u32, type=_u32, name=_text32, minimum=_i32, maximum=_i32, step=_i32, default=_i32, flags=_u32, rest=_u32 * 2
)
_ControlValue = _structure(id=_u32, value=_i32)


def _number(direction: int, number: int, kind: Any) -> int:
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


_READ, _WRITE = 2, 1
QUERYCAP = _number(_READ, 0, _Capability)
ENUM_FMT = _number(_READ | _WRITE, 2, _Format)
G_CTRL = _number(_READ | _WRITE, 27, _ControlValue)
S_CTRL = _number(_READ | _WRITE, 28, _ControlValue)
QUERYCTRL = _number(_READ | _WRITE, 36, _QueryControl)


@dataclass(frozen=True, slots=True)
class Capability:
    """Who a device is; ``captures`` is False for the nodes of a camera that carry its metadata."""

    card: str
    driver: str
    bus: str
    captures: bool


@dataclass(frozen=True, slots=True)
class Control:
    """A setting of the device, ``name`` in small letters with _."""

    id: int
    name: str
    minimum: int
    maximum: int
    default: int


@contextmanager
def opened(path: Path) -> Iterator[int]:
    """A file descriptor of a device, for questions and controls while another one streams."""
    fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


def query_capability(fd: int) -> Capability:
    """Who it is."""
    row = _Capability()
    fcntl.ioctl(fd, QUERYCAP, row)
    of_node = row.device_caps if row.capabilities & _CAP_DEVICE_CAPS else row.capabilities
    return Capability(_text(row.card), _text(row.driver), _text(row.bus_info), bool(of_node & _CAP_VIDEO_CAPTURE))


def list_formats(fd: int) -> tuple[str, ...]:
    """FOURCC of each pixel format that it offers."""
    rows = _rows(fd, ENUM_FMT, lambda i: _Format(index=i, type=_BUF_TYPE_VIDEO_CAPTURE))
    return tuple(fourcc_text(row.pixelformat) for row in rows)


def _rows(fd: int, request: int, row_of: Callable[[int], Any]) -> Iterator[Any]:
    for index in range(_MAX_ROWS):
        row = row_of(index)
        try:
            fcntl.ioctl(fd, request, row)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return
            raise
        yield row


def list_controls(fd: int) -> dict[str, Control]:
    """Its controls by name."""
    found: dict[str, Control] = {}
    last = 0
    for row in _rows(fd, QUERYCTRL, lambda _: _QueryControl(id=last | _CTRL_FLAG_NEXT)):  # noqa: B023 -- requested again each time
        last = row.id
        name = re.sub(r"[^a-z0-9]+", "_", _text(row.name).lower()).strip("_")
        if not row.flags & _CTRL_FLAG_DISABLED:
            found[name] = Control(row.id, name, row.minimum, row.maximum, row.default)
    return found


def set_control(fd: int, control: int, value: int) -> int:
    """Set a control; returns the value that it has then."""
    fcntl.ioctl(fd, S_CTRL, _ControlValue(id=control, value=value))
    return get_control(fd, control)


def get_control(fd: int, control: int) -> int:
    """Value of a control."""
    row = _ControlValue(id=control)
    fcntl.ioctl(fd, G_CTRL, row)
    return row.value


def fourcc_text(code: int) -> str:
    """Four letters of a pixel format, as v4l2-ctl shows them; what cannot be printed becomes "."."""
    letters = [chr(code >> shift & 0x7F) for shift in (0, 8, 16, 24)]
    text = "".join(letter if letter.isprintable() else "." for letter in letters)
    return f"{text}-BE" if code & _FOURCC_BIG_ENDIAN else text


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", errors="replace").strip()
