"""Typed msgpack headers. Whatever comes in is bounded first, then converted; anything else is a ``CodecError``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar, cast

import msgpack
import msgspec
from msgspec import Meta

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.framing import MAX_KEYFRAME_PIXELS, MAX_PART_BYTES, Buffer
from semantic_mapper.transport.images import ImageEncoding
from semantic_mapper.transport.messages import EndReason, NodeState
from semantic_mapper.transport.topics import SOURCE_PATTERN
from semantic_mapper.types import MAX_PIXELS, MAX_POSE_SIGMA_M, MAX_SIDE, MAX_STAMP_NS

MAX_DAMAGES = 50  # damaged places of a recording that its end tells of
PROTOCOL_VERSION = 1  # raise it when a header changes its meaning; readers refuse what they do not know
MAX_HEADER_BYTES = 1 << 18
MAX_KEYFRAME_BYTES = 8 * MAX_KEYFRAME_PIXELS + 2 * MAX_HEADER_BYTES  # raw colour, float32 depth, labels: all of it
MAX_WEIGHTS_BYTES = 1 << 26  # of a weights file on the wire: five times the shipped one

_MAX_ENTRIES = 1024

Source = Annotated[str, Meta(pattern=SOURCE_PATTERN)]
Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
CaptureStamp = Annotated[int, Meta(ge=0, le=MAX_STAMP_NS)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
PartBytes = Annotated[int, Meta(ge=0, le=MAX_PART_BYTES)]
Word = Annotated[str, Meta(max_length=128)]
Sentence = Annotated[str, Meta(max_length=4096)]
ClassId = Annotated[int, Meta(ge=0, le=255)]
Pose = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
Milliseconds = dict[Word, float]
Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256
UnitInterval = Annotated[float, Meta(ge=0, le=1)]


class Plain(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all structs that travel."""


class IntrinsicsHeader(Plain, frozen=True, kw_only=True):
    """``CameraIntrinsics``."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: Side
    height: Side
    distortion: Annotated[tuple[float, ...], Meta(max_length=14)] = ()


class RgbSpec(Plain, frozen=True, kw_only=True):
    """How the colour buffer is packed."""

    encoding: ImageEncoding
    bytes: PartBytes


class DepthSpec(Plain, frozen=True, kw_only=True):
    """How a depth buffer is packed; ``scale`` in units a metre for uint16, else 0."""

    encoding: Literal["f32", "f32_planes_zstd", "u16_delta_planes_zstd"]
    bytes: PartBytes
    scale: Annotated[float, Meta(ge=0, le=1e6)] = 0.0


class LabelSpec(Plain, frozen=True, kw_only=True):
    """How a label buffer is packed."""

    encoding: Literal["u8_zstd"]
    bytes: PartBytes


class ConfidenceSpec(Plain, frozen=True, kw_only=True):
    """How a confidence buffer is packed; "u8_zstd" rounds to the nearest 1/255."""

    encoding: Literal["u8_zstd", "f32_planes_zstd"]
    bytes: PartBytes


class Header(Plain, frozen=True, kw_only=True):
    """What every header starts with."""

    v: int = PROTOCOL_VERSION


class FrameHeader(Header, frozen=True, kw_only=True):
    """Header of ``PosedFrame``; buffers: rgb, depth, label, those that there are."""

    stamp_ns: CaptureStamp
    seq: Count
    camera_id: Source
    intrinsics: IntrinsicsHeader
    T_world_camera: Pose  # row by row, float64, exact
    pose_source: Word
    pose_sigma: Annotated[float, Meta(ge=0, le=MAX_POSE_SIGMA_M)]
    rgb: RgbSpec
    depth: DepthSpec | None = None
    label: LabelSpec | None = None


class MapUpdateHeader(Header, frozen=True, kw_only=True):
    """Header of ``MapUpdate``; buffers: label, confidence, depth."""

    stamp_ns: Stamp
    seq: Count
    camera_id: Source
    width: Side
    height: Side
    fused: bool
    is_keyframe: bool
    source_seqs: Annotated[tuple[Count, ...], Meta(max_length=_MAX_ENTRIES)]
    blocks: Count
    blocks_touched: Count
    rays: Count = 0
    samples: Count = 0
    stage_ms: Annotated[Milliseconds, Meta(max_length=64)]
    label: LabelSpec
    confidence: ConfidenceSpec
    depth: DepthSpec


class FrameRefusedHeader(Header, frozen=True, kw_only=True):
    """Header of ``FrameRefused``; no buffers."""

    stamp_ns: Stamp
    seq: Count
    camera_id: Source
    reason: Sentence


class StatusHeader(Header, frozen=True, kw_only=True):
    """Header of ``Status``; no buffers."""

    node: Source
    state: NodeState
    stamp_ns: Stamp
    counters: Annotated[dict[Word, Count], Meta(max_length=256)]
    ages_s: Annotated[dict[Word, float], Meta(max_length=256)]
    degraded: Annotated[tuple[Sentence, ...], Meta(max_length=64)]


class ClassHeader(Plain, frozen=True, kw_only=True):
    """One class of a label set."""

    id: ClassId
    name: Word
    color: tuple[ClassId, ClassId, ClassId]


class LabelSetHeader(Plain, frozen=True, kw_only=True):
    """``LabelSet``."""

    name: Word
    classes: Annotated[tuple[ClassHeader, ...], Meta(min_length=1, max_length=256)]
    ignore_id: ClassId


class StreamInfoHeader(Header, frozen=True, kw_only=True):
    """Header of ``StreamInfo``; no buffers."""

    source: Sentence
    cameras: Annotated[dict[Source, IntrinsicsHeader], Meta(max_length=64)]
    label_set: LabelSetHeader | None
    frame_count: Count | None
    frame_hz: Annotated[float, Meta(ge=0, le=1e6)]
    metadata: Annotated[dict[Word, Sentence], Meta(max_length=64)]


class EndOfStreamHeader(Header, frozen=True, kw_only=True):
    """Header of ``EndOfStream``; no buffers."""

    source: Source
    reason: EndReason
    published: Count
    detail: Sentence
    damages: Annotated[tuple[Sentence, ...], Meta(max_length=MAX_DAMAGES)] = ()
    unreadable: Count | msgspec.UnsetType = msgspec.UNSET  # 0 is not sent


class KeyframeHeader(Header, frozen=True, kw_only=True):
    """Header of ``LabelledKeyframe``; then come header and buffers of its frame."""

    camera_id: Source
    teacher: Word
    label_set: LabelSetHeader


class WeightsHeader(Header, frozen=True, kw_only=True):
    """Header of ``WeightsUpdate``; buffer: the file."""

    node: Source
    version: Annotated[int, Meta(ge=1, le=2**31)]
    bytes: Annotated[int, Meta(ge=1, le=MAX_WEIGHTS_BYTES)]
    digest: Digest
    parent: Digest
    score: UnitInterval
    parent_score: UnitInterval
    keyframes: Count
    held_out: Count


class WeightsInUseHeader(Header, frozen=True, kw_only=True):
    """Header of ``WeightsInUse``; no buffers."""

    node: Source
    version: Count
    digest: Digest
    newest: Count
    judged: Count
    accepted: bool
    reason: Sentence
    rolled_back: Count
    contradicts: bool


HeaderT = TypeVar("HeaderT", bound=Header)


def pack_header(header: Header, what: str) -> bytes:
    """Header -> msgpack. What would not be accepted by ``unpack_header`` is refused here already.

    Raises:
        CodecError: a value out of bounds, NaN, or of the wrong type.
    """
    try:
        data = msgspec.to_builtins(header, builtin_types=(bytes,))
        packed = cast(bytes, msgpack.packb(data, use_bin_type=True))
    except (TypeError, ValueError, OverflowError) as error:
        raise CodecError(f"{what}: cannot be sent: {error}") from error
    unpack_header(packed, type(header), what)
    return packed


def unpack_header(packed: Buffer, kind: type[HeaderT], what: str) -> HeaderT:
    """msgpack -> header, checked field by field.

    Raises:
        CodecError: too long, not msgpack, nested too deeply, other protocol version, unknown or missing field, wrong
            type, number out of bounds or not finite.
    """
    if len(packed) > MAX_HEADER_BYTES:
        raise CodecError(f"{what}: header of {len(packed)} bytes, at most {MAX_HEADER_BYTES} are accepted")
    try:
        data: Any = msgpack.unpackb(
            packed,
            max_str_len=1 << 14,
            max_bin_len=0,
            max_array_len=_MAX_ENTRIES,
            max_map_len=256,
            max_ext_len=0,
        )
        _check_version(data, what)
        header = msgspec.convert(data, kind)
        _check_finite(data, what, "")
    except CodecError:
        raise
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        # ValueError includes msgpack's StackError and FormatError, msgspec's ValidationError and bad UTF-8.
        raise CodecError(f"{what}: bad header: {error or type(error).__name__}") from error
    return header


def check_image_size(width: int, height: int, what: str) -> None:
    """Refuse an image that is too large to be allocated on a stranger's word.

    Raises:
        CodecError: more than ``MAX_PIXELS``.
    """
    if width * height > MAX_PIXELS:
        raise CodecError(f"{what}: image of {width}x{height}; at most {MAX_PIXELS} pixels are accepted")


def check_keyframe_size(width: int, height: int, sizes: Sequence[int], what: str) -> None:
    """Refuse a keyframe that is too large as a whole, packed or unpacked: learners keep dozens of them.

    Args:
        width, height: Of its images.
        sizes: Of the parts of its message, bytes.

    Raises:
        CodecError: more than ``MAX_KEYFRAME_PIXELS``, or more than ``MAX_KEYFRAME_BYTES``.
    """
    if width * height > MAX_KEYFRAME_PIXELS:
        raise CodecError(f"{what}: image of {width}x{height}; a keyframe has at most {MAX_KEYFRAME_PIXELS} pixels")
    if sum(sizes) > MAX_KEYFRAME_BYTES:
        raise CodecError(f"{what}: {sum(sizes)} bytes in all; a keyframe has at most {MAX_KEYFRAME_BYTES}")


def _check_version(data: object, what: str) -> None:
    if not isinstance(data, dict):
        raise CodecError(f"{what}: header must be a map, got {type(data).__name__}")
    version = cast("dict[object, object]", data).get("v")
    if version != PROTOCOL_VERSION:
        raise CodecError(
            f"{what}: protocol version {version!r:.40}, this program speaks {PROTOCOL_VERSION}; "
            "run the same release of semantic-mapper on both sides"
        )


def _check_finite(data: object, what: str, path: str) -> None:
    """Only after ``convert``, which bounds the depth."""
    if isinstance(data, float):
        if not math.isfinite(data):
            raise CodecError(f"{what}: {path or 'header'} is {data}; only finite numbers can be sent")
    elif isinstance(data, dict):
        for key, value in cast("dict[object, object]", data).items():
            _check_finite(value, what, f"{path}.{key}" if path else str(key))
    elif isinstance(data, list):
        for index, value in enumerate(cast("list[object]", data)):
            _check_finite(value, what, f"{path}[{index}]")
