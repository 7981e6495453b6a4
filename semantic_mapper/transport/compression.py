"""Lossless packing of depth and label images: delta, byte planes, zstd. Sizes are checked before decoding.

The wire, logs and what a mapper keeps of its frames all pack depth by this module.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import zstandard
from numpy.typing import NDArray

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.types import Float32, UInt8

_contexts = threading.local()  # zstd contexts must not be shared between threads, and cost too much to make again


def zstd_compress(data: Buffer, level: int) -> bytes:
    """Compress; the size stands in the result, which ``zstd_decompress`` relies on."""
    cache: dict[int, zstandard.ZstdCompressor] | None = getattr(_contexts, "compressors", None)
    if cache is None:
        cache = _contexts.compressors = {}
    if level not in cache:
        cache[level] = zstandard.ZstdCompressor(level=level, write_content_size=True)
    return cache[level].compress(data)


def zstd_decompress(data: Buffer, size: int, what: str) -> bytes:
    """Decompress exactly ``size`` bytes.

    Raises:
        CodecError: damaged, or not of that size.
    """
    try:
        announced = zstandard.frame_content_size(data)
        if announced != size:
            raise CodecError(f"{what}: compressed data announce {announced} bytes, the header means {size}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except (zstandard.ZstdError, ValueError) as error:
        if isinstance(error, CodecError):
            raise
        raise CodecError(f"{what}: cannot be decompressed: {error}") from error


def depth_from_uint16(raw: NDArray[np.uint16], scale: float) -> Float32:
    """Sensor units -> metres, ``raw / scale`` in float32. Every importer and driver must use this one.

    Args:
        raw: (H, W) uint16, 0 = no measurement.
        scale: Units a metre, e.g. 1000.
    """
    return raw.astype(np.float32) / np.float32(scale)


def depth_to_uint16(depth_m: Float32, scale: float) -> NDArray[np.uint16] | None:
    """The sensor units that give exactly ``depth_m`` back, bit for bit; None where there are none."""
    with np.errstate(invalid="ignore", over="ignore"):
        raw = np.rint(depth_m * np.float32(scale))
        if not bool(np.all((raw >= 0) & (raw <= 65535))):  # NaN compares False
            return None
    units = raw.astype(np.uint16)
    metres = depth_from_uint16(units, scale)
    same = np.array_equal(metres.view(np.uint32), np.ascontiguousarray(depth_m).view(np.uint32))
    return units if same else None


def pack_depth(depth_m: Float32, scales: Sequence[float], level: int) -> tuple[float, bytes]:
    """(H, W) float32 metres -> the first scale whose units give exactly these metres, and the packed units.

    Where no scale does, the scale is 0 and the floats are packed. Either way it is bit exact, NaN included.
    """
    for scale in scales:
        units = depth_to_uint16(depth_m, scale)
        if units is not None:
            return scale, pack_uint16(units, level)
    return 0.0, pack_float32(depth_m, level)


def unpack_depth(data: Buffer, scale: float, height: int, width: int, what: str) -> Float32:
    """Inverse of ``pack_depth``.

    Raises:
        CodecError: damaged, or not of that size.
    """
    if scale == 0:
        return unpack_float32(data, height, width, what)
    return depth_from_uint16(unpack_uint16(data, height, width, what), scale)


def pack_uint16(image: NDArray[np.uint16], level: int) -> bytes:
    """(H, W) uint16 -> delta along rows, low bytes before high bytes, zstd."""
    delta = image.copy()
    delta[:, 1:] -= image[:, :-1]  # modulo 2^16, undone exactly by the running sum
    planes = delta.astype("<u2", copy=False).view(np.uint8).reshape(-1, 2).T
    return zstd_compress(planes.tobytes(), level)


def unpack_uint16(data: Buffer, height: int, width: int, what: str) -> NDArray[np.uint16]:
    """Inverse of ``pack_uint16``.

    Raises:
        CodecError: damaged, or not of that size.
    """
    planes = np.frombuffer(zstd_decompress(data, 2 * height * width, what), np.uint8).reshape(2, height, width)
    delta = planes[0] | (planes[1].astype(np.uint16) << 8)
    return np.cumsum(delta, axis=1, dtype=np.uint16)


def pack_float32(image: Float32, level: int) -> bytes:
    """(H, W) float32 -> four byte planes, zstd. Bit exact, NaN included."""
    planes = np.ascontiguousarray(image, dtype="<f4").view(np.uint8).reshape(-1, 4).T
    return zstd_compress(planes.tobytes(), level)


def unpack_float32(data: Buffer, height: int, width: int, what: str) -> Float32:
    """Inverse of ``pack_float32``.

    Raises:
        CodecError: damaged, or not of that size.
    """
    planes = np.frombuffer(zstd_decompress(data, 4 * height * width, what), np.uint8).reshape(4, -1)
    return np.ascontiguousarray(planes.T).view("<f4").reshape(height, width).astype(np.float32, copy=False)


def pack_uint8(image: UInt8, level: int) -> bytes:
    """(H, W) uint8 -> zstd."""
    return zstd_compress(np.ascontiguousarray(image).tobytes(), level)


def unpack_uint8(data: Buffer, height: int, width: int, what: str) -> UInt8:
    """Inverse of ``pack_uint8``.

    Raises:
        CodecError: damaged, or not of that size.
    """
    return np.frombuffer(zstd_decompress(data, height * width, what), np.uint8).reshape(height, width).copy()
