"""Lossless packing of images for scratch space on this machine: byte planes and zstd, quick rather than small.

Every ``unpack`` gives back what was packed, bit for bit. The bytes are no file format: another version may pack
otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.transport import images
from semantic_mapper.types import Float32, UInt8

_UNIT_SCALES = (1000.0, 5000.0)  # units a metre in which depth sensors and logs count
_FLOATS = 255  # in the place of an index of these

BoolImage = NDArray[np.bool_]


def pack_color(rgb: UInt8) -> bytes:
    """(H, W, 3) uint8 -> differences along rows, one plane a colour."""
    delta = rgb.copy()
    delta[:, 1:] -= rgb[:, :-1]  # modulo 256, undone exactly by the running sum
    return images.zstd_compress(delta.reshape(-1, 3).T.tobytes())


def unpack_color(data: bytes, height: int, width: int) -> UInt8:
    """Inverse of ``pack_color``."""
    planes = images.zstd_decompress(data, 3 * height * width, "colours of a kept frame")
    delta = np.frombuffer(planes, np.uint8).reshape(3, height, width)
    return np.ascontiguousarray(np.cumsum(delta, axis=2, dtype=np.uint8).transpose(1, 2, 0))


def pack_depth(depth_m: Float32) -> bytes:
    """(H, W) float32 -> a byte that says how, then sensor units where they give the same floats, else the floats."""
    scale, data = images.pack_depth(depth_m, *_UNIT_SCALES)
    return bytes([_UNIT_SCALES.index(scale) if scale else _FLOATS]) + data


def unpack_depth(data: bytes, height: int, width: int) -> Float32:
    """Inverse of ``pack_depth``."""
    scale = 0.0 if data[0] == _FLOATS else _UNIT_SCALES[data[0]]
    return images.unpack_depth(data[1:], scale, (height, width), "depth of a kept frame")


def pack_floats(values: Float32) -> bytes:
    """Float32 of any shape -> four byte planes; NaN included."""
    return images.pack_float32(values)


def unpack_floats(data: bytes, shape: tuple[int, ...]) -> Float32:
    """Inverse of ``pack_floats``."""
    return images.unpack_float32(data, shape, "values of a kept frame")


def pack_mask(mask: BoolImage) -> bytes:
    """(H, W) bool -> bits."""
    return images.zstd_compress(np.packbits(mask).tobytes())


def unpack_mask(data: bytes, height: int, width: int) -> BoolImage:
    """Inverse of ``pack_mask``."""
    packed = images.zstd_decompress(data, -(-height * width // 8), "mask of a kept frame")
    return np.unpackbits(np.frombuffer(packed, np.uint8), count=height * width).astype(np.bool_).reshape(height, width)
