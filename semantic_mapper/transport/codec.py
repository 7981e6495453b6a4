"""The one codec of wire and log: typed messages <-> multipart ``[topic, msgpack header, raw buffers...]``.

``encode_*`` and ``decode_*`` raise nothing but ``CodecError``. Every size is bounded and checked before anything is
allocated by it. Decoded arrays are fresh and writable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from semantic_mapper.errors import CodecError
from semantic_mapper.transport import compression, headers
from semantic_mapper.transport.buffers import (
    CodecOptions,
    decode_confidence,
    decode_depth,
    encode_confidence,
    encode_depth,
)
from semantic_mapper.transport.headers import pack_header
from semantic_mapper.transport.images import decode_rgb, encode_rgb
from semantic_mapper.transport.learning_messages import (
    decode_in_use,
    decode_weights,
    encode_in_use,
    encode_weights,
    open_weights,
)
from semantic_mapper.transport.messages import FrameRefused, LabelledKeyframe, Message, Status
from semantic_mapper.transport.opening import (
    Parts,
    check_source,
    message_name,
    open_buffers,
    open_header,
    topic_name,
)
from semantic_mapper.transport.plain import intrinsics_header, label_set_header, to_intrinsics, to_label_set
from semantic_mapper.transport.small_messages import (
    decode_end,
    decode_info,
    decode_refused,
    decode_status,
    encode_end,
    encode_info,
    encode_refused,
    encode_status,
)
from semantic_mapper.transport.topics import parse_topic, topic_bytes
from semantic_mapper.types import MapUpdate, PosedFrame

__all__ = [
    "CodecOptions",
    "EncodedImage",
    "Envelope",
    "Parts",
    "decode",
    "decode_end",
    "decode_frame",
    "decode_in_use",
    "decode_info",
    "decode_keyframe",
    "decode_map_update",
    "decode_refused",
    "decode_status",
    "decode_weights",
    "encode_end",
    "encode_frame",
    "encode_in_use",
    "encode_info",
    "encode_keyframe",
    "encode_map_update",
    "encode_refused",
    "encode_status",
    "encode_weights",
    "read_envelope",
    "repack_rgb",
]

_DEFAULTS = CodecOptions()


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A colour image that is already a PNG or JPEG file; must decode to the frame's ``rgb``."""

    encoding: Literal["png", "jpeg"]
    data: bytes


@dataclass(frozen=True, slots=True)
class Envelope:
    """What can be known of a message without decoding its buffers.

    Args:
        topic: Name of the topic ("frame", "map", ...); ``source``: camera id or node.
        stamp_ns, seq: 0 where the message has none.
        T_world_camera: Of a frame, 16 numbers row by row; else empty.
        has_depth, has_label: Of a frame.
        rgb_encoding: Of a frame: "png", "jpeg" or "raw".
        depth_scale: Units a metre of a frame's depth where it is packed as uint16, else 0.
    """

    topic: str
    source: str
    stamp_ns: int = 0
    seq: int = 0
    T_world_camera: tuple[float, ...] = ()
    has_depth: bool = False
    has_label: bool = False
    rgb_encoding: str = ""
    depth_scale: float = 0.0


def encode_frame(
    frame: PosedFrame, options: CodecOptions = _DEFAULTS, *, encoded_rgb: EncodedImage | None = None
) -> list[bytes]:
    """Posed frame -> parts. Depth, labels, stamps and the float64 pose are exact; so is colour unless "jpeg".

    Args:
        frame: With a finite pose; whether it is a rotation is for the receiver to judge.
        options: How to pack.
        encoded_rgb: Sent instead of packing ``frame.rgb`` anew, so that an imported JPEG stays what it was.

    Raises:
        CodecError: NaN in pose or intrinsics, or a camera id that a topic cannot hold.
    """
    what = message_name("frame", frame.camera_id, frame.seq)
    intrinsics = intrinsics_header(frame.intrinsics)
    headers.check_image_size(intrinsics.width, intrinsics.height, what)
    if encoded_rgb is None:
        encoded_rgb_bytes = encode_rgb(frame.rgb, options.rgb, options.jpeg_quality)
    else:
        encoded_rgb_bytes = encoded_rgb.data
    buffers = [encoded_rgb_bytes]
    depth = label = None
    if frame.depth_m is not None:
        depth, data = encode_depth(frame.depth_m, options)
        buffers.append(data)
    if frame.label is not None:
        buffers.append(compression.pack_uint8(frame.label, options.zstd_level))
        label = headers.LabelSpec(encoding="u8_zstd", bytes=len(buffers[-1]))
    header = headers.FrameHeader(
        stamp_ns=int(frame.stamp_ns),
        seq=int(frame.seq),
        camera_id=frame.camera_id,
        intrinsics=intrinsics,
        T_world_camera=tuple(frame.T_world_camera.ravel().tolist()),
        pose_source=frame.pose_source,
        pose_sigma=float(frame.pose_sigma),
        rgb=headers.RgbSpec(
            encoding=options.rgb if encoded_rgb is None else encoded_rgb.encoding, bytes=len(encoded_rgb_bytes)
        ),
        depth=depth,
        label=label,
    )
    return [topic_bytes("frame", frame.camera_id), pack_header(header, what), *buffers]


def decode_frame(parts: Parts) -> PosedFrame:
    """Parts -> posed frame.

    Raises:
        CodecError: anything that ``encode_frame`` would not have made.
    """
    header, buffers = _open_frame(parts)
    what = message_name("frame", header.camera_id, header.seq)
    intrinsics = to_intrinsics(header.intrinsics, what)
    size = (intrinsics.height, intrinsics.width)
    try:
        rgb = decode_rgb(buffers[0], header.rgb.encoding, *size)
    except CodecError as error:
        raise CodecError(f"{what}: rgb: {error}") from error
    depth = None if header.depth is None else decode_depth(header.depth, buffers[1], size, what)
    label = None if header.label is None else compression.unpack_uint8(buffers[-1], *size, f"{what}: label")
    return PosedFrame(
        stamp_ns=header.stamp_ns,
        seq=header.seq,
        camera_id=header.camera_id,
        rgb=rgb,
        depth_m=depth,
        label=label,
        intrinsics=intrinsics,
        T_world_camera=np.array(header.T_world_camera, np.float64).reshape(4, 4),
        pose_source=header.pose_source,
        pose_sigma=header.pose_sigma,
    )


def repack_rgb(parts: Parts, options: CodecOptions) -> list[bytes]:
    """A frame with its colour image packed as ``options`` say; all else, and an image that is so already, stays.

    Raises:
        CodecError: no frame, or its colour image is damaged.
    """
    header, buffers = _open_frame(parts)
    if header.rgb.encoding == options.rgb:
        return [bytes(part) for part in parts]
    what = message_name("frame", header.camera_id, header.seq)
    try:
        rgb = decode_rgb(buffers[0], header.rgb.encoding, header.intrinsics.height, header.intrinsics.width)
    except CodecError as error:
        raise CodecError(f"{what}: rgb: {error}") from error
    data = encode_rgb(rgb, options.rgb, options.jpeg_quality)
    header = msgspec.structs.replace(header, rgb=headers.RgbSpec(encoding=options.rgb, bytes=len(data)))
    return [bytes(parts[0]), pack_header(header, what), data, *(bytes(buffer) for buffer in buffers[1:])]


def encode_keyframe(keyframe: LabelledKeyframe, options: CodecOptions = _DEFAULTS) -> list[bytes]:
    """Labelled keyframe -> parts; its frame as ``encode_frame`` packs it.

    Raises:
        CodecError: a frame without labels, or one that cannot be sent.
    """
    frame = keyframe.frame
    what = message_name("keyframe", frame.camera_id, frame.seq)
    if frame.label is None:
        raise CodecError(f"{what}: has no label image, so that there is nothing to learn from it")
    header = headers.KeyframeHeader(
        camera_id=frame.camera_id, teacher=keyframe.teacher[:128], label_set=label_set_header(keyframe.label_set)
    )
    k = frame.intrinsics
    headers.check_keyframe_size(k.width, k.height, (), what)
    topic = topic_bytes("keyframe", frame.camera_id)
    parts = [topic, pack_header(header, what), *encode_frame(frame, options)[1:]]
    headers.check_keyframe_size(k.width, k.height, [len(p) for p in parts], what)
    return parts


def decode_keyframe(parts: Parts) -> LabelledKeyframe:
    """Parts -> labelled keyframe.

    Raises:
        CodecError: anything that ``encode_keyframe`` would not have made.
    """
    header, inner = _open_keyframe(parts)
    return LabelledKeyframe(decode_frame(inner), to_label_set(header.label_set), header.teacher)


def encode_map_update(update: MapUpdate, options: CodecOptions = _DEFAULTS) -> list[bytes]:
    """Map update -> parts; exact but for the confidence, see ``CodecOptions``.

    Raises:
        CodecError: a value that cannot be sent, or images of different sizes.
    """
    what = message_name("map", update.camera_id, update.seq)
    height, width = update.label.shape
    if update.confidence.shape != (height, width) or update.depth_m.shape != (height, width):
        raise CodecError(
            f"{what}: label {update.label.shape}, confidence {update.confidence.shape} and depth_m "
            f"{update.depth_m.shape} must have one size"
        )
    headers.check_image_size(width, height, what)
    label = compression.pack_uint8(update.label, options.zstd_level)
    confidence_spec, confidence = encode_confidence(update.confidence, options)
    depth_spec, depth = encode_depth(np.ascontiguousarray(update.depth_m, np.float32), options)
    header = headers.MapUpdateHeader(
        stamp_ns=int(update.stamp_ns),
        seq=int(update.seq),
        camera_id=update.camera_id,
        width=width,
        height=height,
        fused=bool(update.fused),
        is_keyframe=bool(update.is_keyframe),
        source_seqs=tuple(int(s) for s in update.source_seqs),
        blocks=int(update.blocks),
        blocks_touched=int(update.blocks_touched),
        rays=int(update.rays),
        samples=int(update.samples),
        stage_ms={name: float(ms) for name, ms in update.stage_ms.items()},
        label=headers.LabelSpec(encoding="u8_zstd", bytes=len(label)),
        confidence=confidence_spec,
        depth=depth_spec,
    )
    return [topic_bytes("map", update.camera_id), pack_header(header, what), label, confidence, depth]


def decode_map_update(parts: Parts) -> MapUpdate:
    """Parts -> map update.

    Raises:
        CodecError: anything that ``encode_map_update`` would not have made.
    """
    header, (label, confidence, depth) = _open_map_update(parts)
    what = message_name("map", header.camera_id, header.seq)
    size = (header.height, header.width)
    return MapUpdate(
        stamp_ns=header.stamp_ns,
        seq=header.seq,
        camera_id=header.camera_id,
        fused=header.fused,
        is_keyframe=header.is_keyframe,
        source_seqs=header.source_seqs,
        label=compression.unpack_uint8(label, *size, f"{what}: label"),
        confidence=decode_confidence(header.confidence, confidence, size, what),
        depth_m=decode_depth(header.depth, depth, size, what),
        blocks=header.blocks,
        blocks_touched=header.blocks_touched,
        rays=header.rays,
        samples=header.samples,
        stage_ms=dict(header.stage_ms),
    )


def decode(parts: Parts) -> Message:
    """Any message of ours, by its topic.

    Raises:
        CodecError: not one of ours, or damaged.
    """
    return _DECODERS[topic_name(parts)](parts)


def read_envelope(parts: Parts) -> Envelope:
    """Check topic, header and buffer sizes of a message, but leave its buffers alone (some ten microseconds).

    Raises:
        CodecError: not one of ours, or damaged.
    """
    name = topic_name(parts)
    if name == "frame":
        h, _ = _open_frame(parts)
        return Envelope(
            topic=name,
            source=h.camera_id,
            stamp_ns=h.stamp_ns,
            seq=h.seq,
            T_world_camera=h.T_world_camera,
            has_depth=h.depth is not None,
            has_label=h.label is not None,
            rgb_encoding=h.rgb.encoding,
            depth_scale=h.depth.scale if h.depth is not None and h.depth.encoding == "u16_delta_planes_zstd" else 0.0,
        )
    if name == "keyframe":
        _, inner = _open_keyframe(parts)
        h, _ = _open_frame(inner)
        return Envelope(name, h.camera_id, h.stamp_ns, h.seq, h.T_world_camera, h.depth is not None, has_label=True)
    if name == "weights":
        h, _ = open_weights(parts)
        return Envelope(name, h.node)
    if name == "map":
        h, _ = _open_map_update(parts)
        return Envelope(name, h.camera_id, h.stamp_ns, h.seq)
    message = decode(parts)
    _, source = parse_topic(bytes(parts[0]))
    if isinstance(message, FrameRefused):
        return Envelope(name, source, message.stamp_ns, message.seq)
    return Envelope(name, source, message.stamp_ns if isinstance(message, Status) else 0)


_DECODERS = {
    "frame": decode_frame,
    "map": decode_map_update,
    "refused": decode_refused,
    "status": decode_status,
    "info": decode_info,
    "end": decode_end,
    "keyframe": decode_keyframe,
    "weights": decode_weights,
    "in_use": decode_in_use,
}


def _open_frame(parts: Parts) -> tuple[headers.FrameHeader, Parts]:
    header = open_header(parts, "frame", headers.FrameHeader)
    check_source(parts, header.camera_id)
    what = message_name("frame", header.camera_id, header.seq)
    headers.check_image_size(header.intrinsics.width, header.intrinsics.height, what)
    to_intrinsics(header.intrinsics, what)
    specs = [s for s in (header.rgb, header.depth, header.label) if s is not None]
    return header, open_buffers(parts, [s.bytes for s in specs], what)


def _open_keyframe(parts: Parts) -> tuple[headers.KeyframeHeader, Parts]:
    """Its header, and its frame as the parts of a message of its own."""
    header = open_header(parts, "keyframe", headers.KeyframeHeader)
    check_source(parts, header.camera_id)
    inner = [topic_bytes("frame", header.camera_id), *parts[2:]]
    if len(inner) < 2:
        raise CodecError(f"keyframe of camera '{header.camera_id}': has no frame")
    frame, _ = _open_frame(inner)
    what = message_name("keyframe", frame.camera_id, frame.seq)
    if frame.label is None:
        raise CodecError(f"{what}: has no label image")
    headers.check_keyframe_size(frame.intrinsics.width, frame.intrinsics.height, [len(p) for p in parts], what)
    return header, inner


def _open_map_update(parts: Parts) -> tuple[headers.MapUpdateHeader, Parts]:
    header = open_header(parts, "map", headers.MapUpdateHeader)
    check_source(parts, header.camera_id)
    what = message_name("map", header.camera_id, header.seq)
    headers.check_image_size(header.width, header.height, what)
    return header, open_buffers(parts, [header.label.bytes, header.confidence.bytes, header.depth.bytes], what)
