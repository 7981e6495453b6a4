"""Images of messages as buffers: colour, depth, labels, confidence; and how the header says each is packed.

Of colour images size and completeness are read from the file's own marks before decoding.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Annotated, Literal

import cv2
import numpy as np
from msgspec import Meta

from semantic_mapper.errors import CodecError
from semantic_mapper.transport import compression
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.transport.headers import PartBytes, Wire
from semantic_mapper.types import Float32, UInt8

ImageEncoding = Literal["raw", "png", "jpeg"]

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_ANIMATION = (b"acTL", b"fcTL", b"fdAT")
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start-of-frame marks; the three are tables
_JPEG_SCAN, _JPEG_END = 0xDA, b"\xff\xd9"
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # poses belong to the pixels as stored, not as turned by EXIF


@dataclass(frozen=True, slots=True)
class CodecOptions:
    """How images are packed. The defaults lose nothing of a frame.

    Args:
        rgb: "png" (lossless, small), "raw" (lossless, fast), "jpeg" (lossy).
        jpeg_quality: 1 to 100.
        depth: "auto": uint16 where ``depth_m`` is exactly uint16 / ``depth_scale``, else float32, both compressed and
            both bit exact; "raw": float32 as it is.
        depth_scale: Units a metre tried by "auto".
        confidence: Of map updates; "u8" rounds to the nearest 1/255, "f32" is exact.
        zstd_level: 1 is ten times faster than PNG on depth.
    """

    rgb: ImageEncoding = "png"
    jpeg_quality: int = 92
    depth: Literal["auto", "raw"] = "auto"
    depth_scale: float = 1000.0
    confidence: Literal["u8", "f32"] = "u8"
    zstd_level: int = 1


class RgbSpec(Wire, frozen=True):
    """How a colour buffer is packed."""

    encoding: ImageEncoding
    bytes: PartBytes


class DepthSpec(Wire, frozen=True):
    """How a depth buffer is packed; ``scale`` in units a metre for uint16, else 0."""

    encoding: Literal["f32", "f32_planes_zstd", "u16_delta_planes_zstd"]
    bytes: PartBytes
    scale: Annotated[float, Meta(ge=0, le=1e6)] = 0.0


class LabelSpec(Wire, frozen=True):
    """How a label buffer is packed."""

    encoding: Literal["u8_zstd"]
    bytes: PartBytes


class ConfidenceSpec(Wire, frozen=True):
    """How a confidence buffer is packed; "u8_zstd" rounds to the nearest 1/255."""

    encoding: Literal["u8_zstd", "f32_planes_zstd"]
    bytes: PartBytes


def encode_depth(depth_m: Float32, options: CodecOptions) -> tuple[DepthSpec, bytes]:
    """Depth (H, W) -> how it is packed, and the bytes; always bit exact."""
    if options.depth == "raw":
        data = np.ascontiguousarray(depth_m, "<f4").tobytes()
        return DepthSpec("f32", len(data)), data
    scale, data = compression.pack_depth(depth_m, (options.depth_scale,), options.zstd_level)
    return DepthSpec("u16_delta_planes_zstd" if scale else "f32_planes_zstd", len(data), float(scale)), data


def decode_depth(spec: DepthSpec, data: Buffer, size: tuple[int, int], what: str) -> Float32:
    """Inverse of ``encode_depth``.

    Raises:
        CodecError: damaged, or not of ``size`` (height, width).
    """
    what = f"{what}: depth"
    if spec.encoding == "f32":
        if len(data) != 4 * size[0] * size[1]:
            raise CodecError(f"{what}: {size[1]}x{size[0]} needs {4 * size[0] * size[1]} bytes, got {len(data)}")
        return np.frombuffer(data, "<f4").reshape(size).astype(np.float32)
    if spec.encoding == "f32_planes_zstd":
        return compression.unpack_depth(data, 0.0, *size, what)
    if np.float32(spec.scale) <= 0:
        raise CodecError(f"{what}: scale must be positive, got {spec.scale}")
    return compression.unpack_depth(data, spec.scale, *size, what)


def encode_label(label: UInt8, options: CodecOptions) -> tuple[LabelSpec, bytes]:
    """Class ids (H, W) -> how they are packed, and the bytes."""
    data = compression.pack_uint8(label, options.zstd_level)
    return LabelSpec("u8_zstd", len(data)), data


def decode_label(data: Buffer, size: tuple[int, int], what: str) -> UInt8:
    """Inverse of ``encode_label``.

    Raises:
        CodecError: damaged, or not of ``size`` (height, width).
    """
    return compression.unpack_uint8(data, *size, f"{what}: label")


def encode_confidence(confidence: Float32, options: CodecOptions) -> tuple[ConfidenceSpec, bytes]:
    """Confidence (H, W) -> how it is packed, and the bytes.

    Raises:
        CodecError: "u8" cannot hold values outside [0, 1].
    """
    if options.confidence == "f32":
        data = compression.pack_float32(confidence, options.zstd_level)
        return ConfidenceSpec("f32_planes_zstd", len(data)), data
    if not bool(np.all((confidence >= 0) & (confidence <= 1 + 1e-5))):
        raise CodecError("confidence must lie in [0, 1]; send it as float32 if it may be anything else")
    data = compression.pack_uint8(np.rint(np.minimum(confidence, 1) * 255).astype(np.uint8), options.zstd_level)
    return ConfidenceSpec("u8_zstd", len(data)), data


def decode_confidence(spec: ConfidenceSpec, data: Buffer, size: tuple[int, int], what: str) -> Float32:
    """Inverse of ``encode_confidence``.

    Raises:
        CodecError: damaged, or not of ``size`` (height, width).
    """
    what = f"{what}: confidence"
    if spec.encoding == "f32_planes_zstd":
        return compression.unpack_float32(data, *size, what)
    return compression.unpack_uint8(data, *size, what).astype(np.float32) / np.float32(255)


def encode_rgb(rgb: UInt8, encoding: ImageEncoding, jpeg_quality: int) -> bytes:
    """(H, W, 3) uint8 RGB -> bytes. "raw" and "png" are lossless.

    Raises:
        CodecError: OpenCV cannot encode it.
    """
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


def decode_rgb(data: Buffer, encoding: ImageEncoding, height: int, width: int) -> UInt8:
    """Bytes -> (H, W, 3) uint8 RGB.

    Raises:
        CodecError: damaged, cut off, or of another size than (height, width).
    """
    if encoding == "raw":
        if len(data) != 3 * height * width:
            raise CodecError(f"raw rgb of {width}x{height} must have {3 * height * width} bytes, got {len(data)}")
        return np.frombuffer(data, np.uint8).reshape(height, width, 3).copy()
    data = bytes(data)
    found, size = sniff_image(data)
    if found != encoding or size != (height, width):
        raise CodecError(
            f"the header announces a {encoding} image of {width}x{height}, the data are {found} of {size[1]}x{size[0]}"
        )
    return _decode(data)


def decode_image_file(data: bytes) -> tuple[UInt8, Literal["png", "jpeg"]]:
    """A JPEG or PNG file -> (H, W, 3) uint8 RGB and its encoding; just what ``decode_rgb`` makes of the same bytes.

    Raises:
        CodecError: neither, damaged, or cut off.
    """
    encoding, _ = sniff_image(data)
    return _decode(data), encoding


def sniff_image(data: bytes) -> tuple[Literal["png", "jpeg"], tuple[int, int]]:
    """Encoding and (height, width) of an image file, without decoding it.

    Raises:
        CodecError: neither PNG nor JPEG, or cut off before its end mark.
    """
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


def _decode(data: bytes) -> UInt8:
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
    except cv2.error as error:
        raise CodecError(f"OpenCV cannot decode the image: {error}") from error
    if bgr is None:  # pyright: ignore[reportUnnecessaryComparison] -- the stubs do not know
        raise CodecError("OpenCV cannot decode the image; the file is damaged")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
