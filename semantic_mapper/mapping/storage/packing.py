"""Lossless packing of images for scratch space on this machine: byte planes and zstd, quick rather than small.

Every ``unpack`` gives back what was packed, bit for bit. The bytes are no file format: another version may pack
otherwise.
"""

from __future__ import annotations

import threading

import numpy as np
import zstandard
from numpy.typing import NDArray

from semantic_mapper.types import Float32, UInt8

_LEVEL = 1  # higher ones take several times as long for a few per cent
_UNIT_SCALES = (1000.0, 5000.0)  # units a metre in which depth sensors and logs count
_contexts = threading.local()  # zstd contexts must not be shared between threads, and cost too much to make anew

BoolImage = NDArray[np.bool_]


def pack_color(rgb: UInt8) -> bytes:
    """(H, W, 3) uint8 -> differences along rows, one plane a colour."""
    delta = rgb.copy()
    delta[:, 1:] -= rgb[:, :-1]  # modulo 256, undone exactly by the running sum
    return _compress(delta.reshape(-1, 3).T)


def unpack_color(data: bytes, height: int, width: int) -> UInt8:
    """Inverse of ``pack_color``."""
    delta = np.frombuffer(_decompress(data), np.uint8).reshape(3, height, width)
    return np.ascontiguousarray(np.cumsum(delta, axis=2, dtype=np.uint8).transpose(1, 2, 0))


def pack_depth(depth_m: Float32) -> bytes:
    """(H, W) float32 -> a byte that says how, then sensor units where they give the same floats, else the floats."""
    for code, scale in enumerate(_UNIT_SCALES, 1):
        units = _as_units(depth_m, scale)
        if units is not None:
            delta = units.copy()
            delta[:, 1:] -= units[:, :-1]  # modulo 2^16
            return bytes([code]) + _compress(delta.view(np.uint8).reshape(-1, 2).T)
    return bytes([0]) + pack_floats(depth_m)


def unpack_depth(data: bytes, height: int, width: int) -> Float32:
    """Inverse of ``pack_depth``."""
    if data[0] == 0:
        return unpack_floats(data[1:], (height, width))
    planes = np.frombuffer(_decompress(data[1:]), np.uint8).reshape(2, -1)
    delta = np.ascontiguousarray(planes.T).view(np.uint16).reshape(height, width)
    return _as_metres(np.cumsum(delta, axis=1, dtype=np.uint16), _UNIT_SCALES[data[0] - 1])


def pack_floats(values: Float32) -> bytes:
    """Float32 of any shape -> four byte planes; NaN included."""
    return _compress(np.ascontiguousarray(values).view(np.uint8).reshape(-1, 4).T)


def unpack_floats(data: bytes, shape: tuple[int, ...]) -> Float32:
    """Inverse of ``pack_floats``."""
    planes = np.frombuffer(_decompress(data), np.uint8).reshape(4, -1)
    return np.ascontiguousarray(planes.T).view(np.float32).reshape(shape)


def pack_mask(mask: BoolImage) -> bytes:
    """(H, W) bool -> bits."""
    return _compress(np.packbits(mask))


def unpack_mask(data: bytes, height: int, width: int) -> BoolImage:
    """Inverse of ``pack_mask``."""
    bits = np.unpackbits(np.frombuffer(_decompress(data), np.uint8), count=height * width)
    return bits.astype(np.bool_).reshape(height, width)


def _as_metres(units: NDArray[np.uint16], scale: float) -> Float32:
    return units.astype(np.float32) / np.float32(scale)


def _as_units(depth_m: Float32, scale: float) -> NDArray[np.uint16] | None:
    """The units that give exactly these metres; None where there are none."""
    with np.errstate(invalid="ignore", over="ignore"):
        raw = np.rint(depth_m * np.float32(scale))
        if not bool(((raw >= 0) & (raw <= 65535)).all()):  # NaN compares False
            return None
    units = raw.astype(np.uint16)
    same = np.array_equal(_as_metres(units, scale).view(np.uint32), np.ascontiguousarray(depth_m).view(np.uint32))
    return units if same else None


def _compress(array: NDArray[np.uint8]) -> bytes:
    compressor: zstandard.ZstdCompressor | None = getattr(_contexts, "compressor", None)
    if compressor is None:
        compressor = _contexts.compressor = zstandard.ZstdCompressor(level=_LEVEL)
    return compressor.compress(array.tobytes())


def _decompress(data: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(data)
