"""Image buffers of messages: how depth and confidence are packed, as their specs in the header say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from semantic_mapper.errors import CodecError
from semantic_mapper.transport import compression
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.transport.headers import ConfidenceSpec, DepthSpec
from semantic_mapper.transport.images import ImageEncoding
from semantic_mapper.types import Float32, UInt8


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


def encode_depth(depth_m: Float32, options: CodecOptions) -> tuple[DepthSpec, bytes]:
    """Depth (H, W) -> how it is packed, and the bytes; always bit exact."""
    if options.depth == "raw":
        data = np.ascontiguousarray(depth_m, "<f4").tobytes()
        return DepthSpec(encoding="f32", bytes=len(data)), data
    units = compression.depth_to_uint16(depth_m, options.depth_scale)
    if units is None:
        data = compression.pack_float32(depth_m, options.zstd_level)
        return DepthSpec(encoding="f32_planes_zstd", bytes=len(data)), data
    data = compression.pack_uint16(units, options.zstd_level)
    spec = DepthSpec(encoding="u16_delta_planes_zstd", bytes=len(data), scale=float(options.depth_scale))
    return spec, data


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
        return compression.unpack_float32(data, *size, what)
    if np.float32(spec.scale) <= 0:
        raise CodecError(f"{what}: scale must be positive, got {spec.scale}")
    return compression.depth_from_uint16(compression.unpack_uint16(data, *size, what), spec.scale)


def encode_confidence(confidence: Float32, options: CodecOptions) -> tuple[ConfidenceSpec, bytes]:
    """Confidence (H, W) -> how it is packed, and the bytes.

    Raises:
        CodecError: "u8" cannot hold values outside [0, 1].
    """
    if options.confidence == "f32":
        data = compression.pack_float32(confidence, options.zstd_level)
        return ConfidenceSpec(encoding="f32_planes_zstd", bytes=len(data)), data
    if not bool(np.all((confidence >= 0) & (confidence <= 1 + 1e-5))):
        raise CodecError("confidence must lie in [0, 1]; send it as float32 if it may be anything else")
    data = compression.pack_uint8(np.rint(np.minimum(confidence, 1) * 255).astype(np.uint8), options.zstd_level)
    return ConfidenceSpec(encoding="u8_zstd", bytes=len(data)), data


def decode_confidence(spec: ConfidenceSpec, data: Buffer, size: tuple[int, int], what: str) -> Float32:
    """Inverse of ``encode_confidence``.

    Raises:
        CodecError: damaged, or not of ``size`` (height, width).
    """
    what = f"{what}: confidence"
    if spec.encoding == "f32_planes_zstd":
        return compression.unpack_float32(data, *size, what)
    units: UInt8 = compression.unpack_uint8(data, *size, what)
    return units.astype(np.float32) / np.float32(255)
