"""Images of messages as buffers: colour, depth, labels, confidence; and how the header says each is packed.

Depth and labels are packed without loss: differences along rows, byte planes, zstd. Sizes are checked before anything
is decoded; of colour images they, and whether the file is complete, are read from the file's own marks. What is
damaged, or not of the (height, width) that is expected, is a ``CodecError``.
"""

import struct
import threading
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
import zstandard
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.messages import Buffer, PartBytes, Wire
from semantic_mapper.types import Float32, UInt8

ImageEncoding = Literal["raw", "png", "jpeg"]

_ZSTD_LEVEL = 1  # ten times faster than PNG on depth
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_ANIMATION = (b"acTL", b"fcTL", b"fdAT")
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start-of-frame marks; the three are tables
_JPEG_SCAN, _JPEG_END = 0xDA, b"\xff\xd9"
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # poses belong to the pixels as stored, not as turned by EXIF
_thread = threading.local()  # zstd contexts must not be shared between threads, and cost too much to make each time


@dataclass(frozen=True, slots=True)
class CodecOptions:
    """How images are packed. The defaults lose nothing of a frame."""

    rgb: ImageEncoding = "png"  # "png" (lossless, small), "raw" (lossless, fast), "jpeg" (lossy)
    jpeg_quality: int = 92  # 1 to 100
    # units a metre: depth that is exactly uint16 / ``depth_scale`` is sent as these units, other depth as float32;
    # either way it is bit exact
    depth_scale: float = 1000.0


class RgbSpec(Wire, frozen=True):
    """How a colour buffer is packed."""

    encoding: ImageEncoding
    bytes: PartBytes

    def decode(self, data: Buffer, size: tuple[int, int], what: str) -> UInt8:
        """(H, W, 3) uint8 RGB."""
        height, width = size
        if self.encoding == "raw":
            if len(data) != 3 * height * width:
                raise CodecError(f"{what}: raw {width}x{height} must have {3 * height * width} bytes, got {len(data)}")
            return np.frombuffer(data, np.uint8).reshape(height, width, 3).copy()
        try:
            rgb, found = decode_image_file(bytes(data), size)
        except CodecError as error:
            raise CodecError(f"{what}: {error}") from error
        if found != self.encoding:
            raise CodecError(f"{what}: the header announces {self.encoding}, the data are {found}")
        return rgb


class DepthSpec(Wire, frozen=True):
    """How a depth buffer is packed; ``scale`` in units a metre for uint16, else 0."""

    encoding: Literal["f32_planes_zstd", "u16_delta_planes_zstd"]
    bytes: PartBytes
    scale: Annotated[float, Meta(ge=0, le=1e6)] = 0.0

    def decode(self, data: Buffer, size: tuple[int, int], what: str) -> Float32:
        """(H, W) metres."""
        is_units = self.encoding == "u16_delta_planes_zstd"
        if is_units and np.float32(self.scale) <= 0:
            raise CodecError(f"{what}: scale of depth must be positive, got {self.scale}")
        itemsize = 2 if is_units else 4
        planes = np.frombuffer(zstd_decompress(data, itemsize * size[0] * size[1], what), np.uint8)
        values = np.ascontiguousarray(planes.reshape(itemsize, -1).T)
        if not is_units:
            return values.view("<f4").reshape(size).astype(np.float32, copy=False)
        delta = values.view("<u2").reshape(size)
        return depth_from_uint16(np.cumsum(delta, axis=1, dtype=np.uint16), self.scale)


class Uint8Spec(Wire, frozen=True):
    """How a buffer of class ids, of a mask or of confidence in 255ths is packed."""

    encoding: Literal["u8_zstd"]
    bytes: PartBytes

    def decode(self, data: Buffer, size: tuple[int, int], what: str) -> UInt8:
        """(H, W)."""
        return np.frombuffer(zstd_decompress(data, size[0] * size[1], what), np.uint8).reshape(size).copy()


def zstd_compress(data: Buffer) -> bytes:
    """Compress; the size stands in the result, which ``zstd_decompress`` relies on."""
    compressor: zstandard.ZstdCompressor | None = getattr(_thread, "compressor", None)
    if compressor is None:
        compressor = _thread.compressor = zstandard.ZstdCompressor(level=_ZSTD_LEVEL, write_content_size=True)
    return bytes(memoryview(compressor.compress(data)))  # a copy: what it gives holds room for incompressible data


def zstd_decompress(data: Buffer, size: int, what: str) -> bytes:
    """Decompress exactly ``size`` bytes; ``CodecError`` where the data are damaged or not of that size."""
    try:
        announced = zstandard.frame_content_size(data)
        if announced == size:
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except (zstandard.ZstdError, ValueError) as error:
        raise CodecError(f"{what}: cannot be decompressed: {error}") from error
    raise CodecError(f"{what}: compressed data announce {announced} bytes, the header means {size}")


def depth_from_uint16(raw: NDArray[np.uint16], scale: float) -> Float32:
    """Sensor units (H, W), 0 = no measurement -> metres, ``raw / scale`` in float32, with ``scale`` units a metre.

    Every importer and driver must use this one.
    """
    return raw.astype(np.float32) / np.float32(scale)


def depth_to_uint16(depth_m: Float32, scale: float) -> NDArray[np.uint16] | None:
    """The sensor units that give exactly ``depth_m`` back, bit for bit; None where no units do."""
    with np.errstate(invalid="ignore", over="ignore"):
        raw = np.rint(depth_m * np.float32(scale))
        if not bool(np.all((raw >= 0) & (raw <= 65535))):  # NaN compares False
            return None
    units = raw.astype(np.uint16)
    metres = depth_from_uint16(units, scale)
    same = np.array_equal(metres.view(np.uint32), np.ascontiguousarray(depth_m).view(np.uint32))
    return units if same else None


def encode_depth(depth_m: Float32, scale: float) -> tuple[DepthSpec, bytes]:
    """Depth (H, W) in metres -> how it is packed, and the bytes: units of ``scale`` where these give it back exactly,
    else floats. Either way it is bit exact, NaN included."""
    units = depth_to_uint16(depth_m, scale)
    if units is None:
        data = _compress_planes(np.ascontiguousarray(depth_m, "<f4"))
        return DepthSpec("f32_planes_zstd", len(data)), data
    delta = units.copy()
    delta[:, 1:] -= units[:, :-1]  # modulo 2^16, undone exactly by the running sum
    data = _compress_planes(delta.astype("<u2", copy=False))
    return DepthSpec("u16_delta_planes_zstd", len(data), float(scale)), data


def _compress_planes(values: NDArray[np.generic]) -> bytes:
    """The first bytes of all elements, then the second ones, and so on."""
    return zstd_compress(values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes())


def encode_uint8(image: UInt8) -> tuple[Uint8Spec, bytes]:
    """Class ids or a mask (H, W) -> how they are packed, and the bytes."""
    data = zstd_compress(np.ascontiguousarray(image).tobytes())
    return Uint8Spec("u8_zstd", len(data)), data


def encode_rgb(rgb: UInt8, encoding: ImageEncoding, jpeg_quality: int) -> bytes:
    """(H, W, 3) uint8 RGB -> bytes; "raw" and "png" are lossless. ``CodecError`` where OpenCV cannot encode it."""
    if encoding == "raw":
        return np.ascontiguousarray(rgb).tobytes()  # a copy: the caller may reuse its buffer while zmq still sends
    if encoding == "png":
        # Level 1 with the default filter: a third of the time of the default level for 10 % more bytes.
        suffix, flags = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]
    else:
        suffix, flags = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    done, data = cv2.imencode(suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), flags)
    if not done:
        raise CodecError(f"OpenCV cannot encode a {rgb.shape[1]}x{rgb.shape[0]} image as {encoding}")
    return data.tobytes()


def decode_image_file(data: bytes, expected: tuple[int, int] | None = None) -> tuple[UInt8, Literal["png", "jpeg"]]:
    """A JPEG or PNG file, of the ``expected`` (height, width) if given -> (H, W, 3) uint8 RGB and its encoding. Raises
    CodecError: neither, damaged, cut off, or of another size."""
    encoding, size = sniff_image(data)
    if expected is not None and size != expected:
        raise CodecError(f"the header announces {expected[1]}x{expected[0]}, the data are {size[1]}x{size[0]}")
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
    except cv2.error as error:
        raise CodecError(f"OpenCV cannot decode the image: {error}") from error
    if bgr is None:  # pyright: ignore[reportUnnecessaryComparison] -- the stubs do not know
        raise CodecError("OpenCV cannot decode the image; the file is damaged")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8), encoding


def sniff_image(data: bytes) -> tuple[Literal["png", "jpeg"], tuple[int, int]]:
    """Encoding and (height, width) of an image file, without decoding it. Raises CodecError: neither PNG nor JPEG, or
    cut off before its end mark."""
    if data.startswith(_PNG_MAGIC) and len(data) >= 33 and data[12:16] == b"IHDR":
        width, height = struct.unpack(">II", data[16:24])
        _check_png(data)
        return "png", (height, width)
    if data.startswith(_JPEG_MAGIC):
        return "jpeg", _jpeg_size(data)
    raise CodecError(f"neither a PNG nor a JPEG image (starts with {data[:8].hex(' ')})")


def _check_png(data: bytes) -> None:
    """Walk the chunks: one head, no animation (OpenCV allocates what later heads and frames announce), one end."""
    at = len(_PNG_MAGIC)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if (kind == b"IHDR") != (at == len(_PNG_MAGIC)) or kind in _PNG_ANIMATION:
            raise CodecError(f"PNG image has a chunk {kind!r} where none may stand")
        at += 12 + length
        if kind == b"IEND" and at <= len(data):
            return
    raise CodecError("PNG image is cut off: it has no end chunk")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Walk the JPEG's segments up to the scan, where its size is known and only the end mark is left to find."""
    size: tuple[int, int] | None = None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        mark = data[at + 1]
        if mark == 0xFF:  # fill byte
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if mark in _JPEG_SIZES and at + 9 <= len(data):
            size = struct.unpack_from(">HH", data, at + 5)
        if mark == _JPEG_SCAN:
            # libjpeg paints the missing rest of a cut image grey and only warns: look for the end ourselves.
            if size is None or data.find(_JPEG_END, at) < 0:
                break
            return size
        at += 2 + max(length, 2)
    raise CodecError("JPEG image is cut off or damaged: no size, scan or end mark")
