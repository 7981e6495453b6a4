"""Colour images as PNG, JPEG or raw bytes. Size and completeness are read from the file's own marks before decoding."""

from __future__ import annotations

import struct
from typing import Literal

import cv2
import numpy as np

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.types import UInt8

ImageEncoding = Literal["raw", "png", "jpeg"]

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_ANIMATION = (b"acTL", b"fcTL", b"fdAT")
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start-of-frame marks; the three are tables
_JPEG_SCAN, _JPEG_END = 0xDA, b"\xff\xd9"
_FLAGS = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # poses belong to the pixels as stored, not as turned by EXIF


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
