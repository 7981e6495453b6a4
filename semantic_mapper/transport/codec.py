"""The one codec of wire and log: messages <-> multipart ``[topic, msgpack header, buffers...]``.

What encodes and decodes raises nothing but ``CodecError``. Every size is bounded and checked before anything is
allocated by it. Decoded arrays are fresh and writable. In a log a message is a msgpack array of binaries, which any
msgpack reader opens. Questions about a map have a codec of their own, ``queries.questions``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import msgpack
import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.errors import CodecError, LabelError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.images import (
    CodecOptions,
    DepthSpec,
    RgbSpec,
    Uint8Spec,
    decode_depth,
    decode_rgb,
    decode_uint8,
    encode_depth,
    encode_rgb,
    encode_uint8,
)
from semantic_mapper.transport.messages import (
    MAX_ENTRIES,
    MAX_HEADER_BYTES,
    MAX_KEYFRAME_BYTES,
    MAX_KEYFRAME_PIXELS,
    MAX_PART_BYTES,
    MAX_PARTS,
    MAX_WEIGHTS_BYTES,
    TOPICS,
    Buffer,
    CaptureStamp,
    Count,
    Finite,
    LabelledKeyframe,
    LabelSetForm,
    Message,
    Parts,
    Side,
    Source,
    Stamp,
    StreamInfo,
    Topic,
    WeightsUpdate,
    Wire,
    Word,
    digest_of,
    read_topic,
    topic_bytes,
)
from semantic_mapper.types import MAX_PIXELS, MAX_POSE_SIGMA_M, CameraIntrinsics, Float32, MapUpdate, PosedFrame, UInt8

PROTOCOL_VERSION = 1  # raise it when a header changes its meaning; readers refuse what they do not know

_DEFAULTS = CodecOptions()
_ROWS = {row.message: row for row in TOPICS.values()}
_UPDATE_SCALARS = (
    "stamp_ns seq camera_id fused is_keyframe source_seqs blocks blocks_touched rays samples stage_ms world".split()
)
_WeightsBytes = Annotated[int, Meta(ge=1, le=MAX_WEIGHTS_BYTES)]
_BEYOND = re.compile(r"Expected `float` [<>]= \S+e\+308")  # how msgspec says it
_NOT_SENT_AS_0 = (  # what most messages do not need
    "unreadable",
    "pseudo_label",
    "depth_sigma",
    "moving",
    "world",
    "T_map_world",
)
_Pose = Annotated[tuple[Finite, ...], Meta(min_length=16, max_length=16)]  # (4, 4) float64 row by row, exact

MessageT = TypeVar("MessageT")
WireT = TypeVar("WireT")


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
        world: Of a frame or map update.
        T_map_world: Of a map update, 16 numbers; empty where it is no motion.
        has_depth, has_label: Of a frame.
        has_computed_depth, has_pseudo_label: Whether no sensor and no person has made them.
        rgb_encoding: Of a frame: "png", "jpeg" or "raw".
        depth_scale: Units a metre of a frame's depth where it is packed as uint16, else 0.
    """

    topic: str
    source: str
    stamp_ns: int = 0
    seq: int = 0
    T_world_camera: tuple[float, ...] = ()
    world: int = 0
    T_map_world: tuple[float, ...] = ()
    has_depth: bool = False
    has_label: bool = False
    rgb_encoding: str = ""
    depth_scale: float = 0.0
    has_computed_depth: bool = False
    has_pseudo_label: bool = False


class FrameHeader(Wire, frozen=True):
    """``PosedFrame`` without its images; buffers: rgb, depth, label, depth_sigma, those that there are."""

    IMAGES: ClassVar = ("rgb", "depth", "label", "depth_sigma")

    stamp_ns: CaptureStamp
    seq: Count
    camera_id: Source
    intrinsics: CameraIntrinsics
    T_world_camera: _Pose
    pose_source: Word
    pose_sigma: Annotated[float, Meta(ge=0, le=MAX_POSE_SIGMA_M)]
    rgb: RgbSpec
    depth: DepthSpec | None = None
    label: Uint8Spec | None = None
    depth_sigma: DepthSpec | None = None  # of computed depth
    pseudo_label: bool = False
    world: Count = 0

    def __post_init__(self) -> None:
        if self.depth_sigma is not None and self.depth is None:
            raise CodecError(f"{self.name}: has a spread of its depth, and no depth")

    @property
    def name(self) -> str:
        """How errors call the frame."""
        return f"frame of camera '{self.camera_id}' seq={self.seq}"

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its images."""
        return self.intrinsics.height, self.intrinsics.width


class MapUpdateHeader(Wire, frozen=True, kw_only=True):
    """``MapUpdate`` without its images; buffers: label, confidence, depth and, where something moves, moving (0, 1)."""

    IMAGES: ClassVar = ("label", "confidence", "depth", "moving")

    stamp_ns: Stamp
    seq: Count
    camera_id: Source
    width: Side
    height: Side
    fused: bool
    is_keyframe: bool
    source_seqs: Annotated[tuple[Count, ...], Meta(max_length=MAX_ENTRIES)]
    blocks: Count
    blocks_touched: Count
    rays: Count = 0
    samples: Count = 0
    stage_ms: Annotated[dict[Word, Finite], Meta(max_length=64)]
    label: Uint8Spec
    confidence: Uint8Spec  # rounded to the nearest 1/255
    depth: DepthSpec
    moving: Uint8Spec | None = None
    world: Count = 0
    T_map_world: _Pose | None = None  # None: no motion

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_PIXELS:
            raise CodecError(f"image of {self.width}x{self.height}; at most {MAX_PIXELS} pixels are accepted")

    @property
    def name(self) -> str:
        """How errors call the update."""
        return f"map of camera '{self.camera_id}' seq={self.seq}"


class KeyframeHeader(Wire, frozen=True):
    """``LabelledKeyframe`` without its frame; then come header and buffers of that."""

    camera_id: Source
    teacher: Word
    label_set: LabelSet


_HEADERS: dict[str, type[Wire]] = {"frame": FrameHeader, "map": MapUpdateHeader, "keyframe": KeyframeHeader}


def header_type(topic: str) -> type[msgspec.Struct]:
    """What a header of a topic looks like on the wire, to be described to other programs."""
    kind = _HEADERS.get(topic) or cast("type[Wire]", TOPICS[topic].message)
    described: list[Any] = [("v", int, PROTOCOL_VERSION)]
    for item in msgspec.structs.fields(kind):
        described.append((item.encode_name, LabelSetForm | None if item.name == "label_set" else item.type))
    return msgspec.defstruct(kind.__name__.removesuffix("Header"), described, kw_only=True, forbid_unknown_fields=True)


def pack_parts(parts: Parts) -> bytes:
    """Multipart message -> one payload, for logs."""
    return cast(bytes, msgpack.packb([bytes(p) if isinstance(p, memoryview) else p for p in parts], use_bin_type=True))


def unpack_parts(payload: Buffer) -> list[bytes]:
    """Inverse of ``pack_parts``.

    Raises:
        CodecError: not such a payload, or one beyond the size limits.
    """
    try:
        parts = msgpack.unpackb(
            payload,
            max_array_len=MAX_PARTS,
            max_bin_len=MAX_PART_BYTES,
            max_str_len=0,
            max_map_len=0,
            max_ext_len=0,
        )
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        raise CodecError(f"payload is not a framed message: {error or type(error).__name__}") from error
    if not isinstance(parts, list) or not all(isinstance(p, bytes) for p in cast("list[object]", parts)):
        raise CodecError("payload is not a framed message: expected an array of binaries")
    return cast("list[bytes]", parts)


def check_buffers(parts: Parts, sizes: Sequence[int], what: str) -> Parts:
    """The buffers of a message: all parts after topic and header.

    Raises:
        CodecError: they do not have the sizes that the header announces; names both.
    """
    actual = [len(p) for p in parts[2:]]
    if actual != list(sizes):
        raise CodecError(f"{what}: the header announces buffers of {list(sizes)} bytes, got {actual}")
    return parts[2:]


def to_plain(value: object, what: str) -> Any:
    """A message or header as dicts, lists, strings and numbers; numbers of NumPy become Python's.

    Raises:
        CodecError: it holds something else.
    """
    try:
        return msgspec.to_builtins(value, builtin_types=(bytes,), enc_hook=_plain_number)
    except (ValueError, TypeError, OverflowError) as error:
        raise CodecError(f"{what}: cannot be sent: {error}") from error


def pack_header(header: Mapping[str, Any], what: str) -> bytes:
    """Plain fields, which have passed ``check_header``, -> msgpack.

    Raises:
        CodecError: longer than ``MAX_HEADER_BYTES``.
    """
    packed = cast(bytes, msgpack.packb({"v": PROTOCOL_VERSION, **header}, use_bin_type=True))
    if len(packed) > MAX_HEADER_BYTES:
        raise CodecError(f"{what}: cannot be sent: a header of {len(packed)} bytes, at most {MAX_HEADER_BYTES}")
    return packed


def unpack_header(packed: Buffer, what: str) -> dict[str, Any]:
    """msgpack -> plain fields without the protocol's version, not checked any further.

    Raises:
        CodecError: too long, not msgpack, nested too deeply, no map, or of another protocol version.
    """
    if len(packed) > MAX_HEADER_BYTES:
        raise CodecError(f"{what}: header of {len(packed)} bytes, at most {MAX_HEADER_BYTES} are accepted")
    try:
        header: Any = msgpack.unpackb(
            packed, max_str_len=1 << 14, max_bin_len=0, max_array_len=MAX_ENTRIES, max_map_len=256, max_ext_len=0
        )
    except (ValueError, TypeError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        # ValueError includes msgpack's StackError and FormatError, and bad UTF-8.
        raise CodecError(f"{what}: bad header: {error or type(error).__name__}") from error
    if not isinstance(header, dict):
        raise CodecError(f"{what}: header must be a map, got {type(header).__name__}")
    fields = cast("dict[str, Any]", header)
    version = fields.pop("v", None)
    if version is True or version != PROTOCOL_VERSION:
        raise CodecError(
            f"{what}: protocol version {version!r:.40}, this program speaks {PROTOCOL_VERSION}; "
            "run the same release of semantic-mapper on both sides"
        )
    return fields


def check_header(
    header: object, kind: type[WireT], what: str, read: Callable[[Any, object], object] | None = None
) -> WireT:
    """Plain fields -> a struct or dataclass. Values that are arrays already, or such objects, stay what they are;
    ``read`` makes a value of any other type that is not plain from what stands for it.

    Raises:
        CodecError: an unknown or missing field, a wrong type, a number out of bounds or not finite, or what
            ``__post_init__`` refuses; names the field.
    """
    try:
        return msgspec.convert(header, kind, dec_hook=read)
    except (ValueError, TypeError, RecursionError, OverflowError) as error:
        raise CodecError(f"{what}: bad header: {_BEYOND.sub('only finite numbers can be sent', str(error))}") from error


def _plain_number(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"no header holds a {type(value).__name__}")


def encode(message: Message, options: CodecOptions = _DEFAULTS, *, sender: str = "source") -> list[bytes]:
    """Any message -> parts.

    Args:
        message: Overlong texts of it were cut when it was made.
        options: How to pack images.
        sender: Second word of the topic of a ``StreamInfo``; the other messages name theirs.

    Raises:
        CodecError: a value that cannot be sent: out of bounds, NaN, or of the wrong type.
    """
    match message:
        case PosedFrame():
            return encode_frame(message, options)
        case MapUpdate():
            return _encode_map_update(message, options)
        case LabelledKeyframe():
            return _encode_keyframe(message, options)
        case WeightsUpdate():
            what = f"weights {message.version} of '{message.node}'"
            if len(message.data) > MAX_WEIGHTS_BYTES:
                raise CodecError(
                    f"{what}: a file of {len(message.data)} bytes; at most {MAX_WEIGHTS_BYTES} can be sent"
                )
            header = to_plain(message, what)
            check_header(header, WeightsUpdate, what)
            packed = pack_header({**header, "bytes": len(message.data)}, what)
            return [topic_bytes("weights", message.node), packed, message.data]
        case _:
            row = _ROWS[type(message)]
            source = getattr(message, row.source) if row.source else sender
            what = f"{row.name} of '{source}'"
            header = to_plain(message, what)
            if isinstance(message, StreamInfo) and message.label_set is not None:
                header["label_set"] = to_plain(LabelSetForm.of(message.label_set), what)
            return [topic_bytes(row.name, source), _pack(header, row.message, what)]


def encode_frame(
    frame: PosedFrame, options: CodecOptions = _DEFAULTS, *, encoded_rgb: EncodedImage | None = None
) -> list[bytes]:
    """Posed frame -> parts. Depth, its spread, labels, stamps and the float64 pose are exact; so is colour unless
    "jpeg".

    Args:
        frame: With a finite pose; whether it is a rotation is for the receiver to judge.
        options: How to pack.
        encoded_rgb: Sent instead of packing ``frame.rgb`` again, so that an imported JPEG stays what it was.

    Raises:
        CodecError: NaN in the pose, or a camera id that a topic cannot hold.
    """
    if encoded_rgb is None:
        encoding, rgb = options.rgb, encode_rgb(frame.rgb, options.rgb, options.jpeg_quality)
    else:
        encoding, rgb = encoded_rgb.encoding, encoded_rgb.data
    packed: dict[str, tuple[Wire, bytes]] = {"rgb": (RgbSpec(encoding, len(rgb)), rgb)}
    if frame.depth_m is not None:
        packed["depth"] = encode_depth(frame.depth_m, options.depth_scale)
    if frame.label is not None:
        packed["label"] = encode_uint8(frame.label)
    if frame.depth_sigma_m is not None:
        packed["depth_sigma"] = encode_depth(frame.depth_sigma_m, options.depth_scale)
    header = FrameHeader(
        stamp_ns=frame.stamp_ns,
        seq=frame.seq,
        camera_id=frame.camera_id,
        intrinsics=frame.intrinsics,
        T_world_camera=tuple(frame.T_world_camera.ravel().tolist()),
        pose_source=frame.pose_source,
        pose_sigma=float(frame.pose_sigma),
        pseudo_label=frame.label_is_pseudo and frame.label is not None,
        world=int(frame.world),
        **{name: cast(Any, spec) for name, (spec, _) in packed.items()},
    )
    return [topic_bytes("frame", frame.camera_id), _pack_struct(header), *(data for _, data in packed.values())]


def with_label(parts: Parts, pseudo_label: UInt8 | None) -> list[bytes]:
    """A frame with a pseudo label (H, W), or none, in place of its label; all else stays, byte for byte.

    Raises:
        CodecError: no frame.
    """
    packed = None if pseudo_label is None else encode_uint8(pseudo_label)
    return _rebuilt(parts, {"label": packed}, pseudo_label=packed is not None)


def with_computed_depth(parts: Parts, depth_m: Float32, sigma_m: Float32) -> list[bytes]:
    """A frame with computed depth (H, W) and its one-sigma spread, in metres; all else stays, byte for byte.

    Raises:
        CodecError: no frame.
    """
    scale = _DEFAULTS.depth_scale
    return _rebuilt(parts, {"depth": encode_depth(depth_m, scale), "depth_sigma": encode_depth(sigma_m, scale)})


def _rebuilt(parts: Parts, images: Mapping[str, tuple[Wire, bytes] | None], **fields: Any) -> list[bytes]:
    """A frame with other images, by their fields in the header, and other fields; None = without the image."""
    header, buffers = _open_as(FrameHeader, parts)
    data = {name: bytes(buffer) for name, buffer in _by_name(header, buffers).items()}
    for name, packed in images.items():
        fields[name], data[name] = (None, b"") if packed is None else packed
    header = msgspec.structs.replace(header, **fields)
    kept = [data[name] for name in FrameHeader.IMAGES if getattr(header, name) is not None]
    return [bytes(parts[0]), _pack_struct(header), *kept]


def repack_rgb(parts: Parts, options: CodecOptions) -> list[bytes]:
    """A frame with its colour image packed as ``options`` say; all else, and an image that is so already, stays.

    Raises:
        CodecError: no frame, or its colour image is damaged.
    """
    header, buffers = _open_as(FrameHeader, parts)
    if header.rgb.encoding == options.rgb:
        return [bytes(part) for part in parts]
    data = encode_rgb(_decode_rgb(header, buffers[0]), options.rgb, options.jpeg_quality)
    return _rebuilt(parts, {"rgb": (RgbSpec(options.rgb, len(data)), data)})


def decode(parts: Parts) -> Message:
    """Any message, by its topic.

    Raises:
        CodecError: anything that ``encode`` would not have made.
    """
    _, header, buffers = _open(parts)
    match header:
        case FrameHeader():
            return _decode_frame(header, buffers)
        case MapUpdateHeader():
            return _decode_map_update(header, buffers)
        case KeyframeHeader():
            frame = _open_as(FrameHeader, buffers)
            return LabelledKeyframe(_decode_frame(*frame), header.label_set, header.teacher)
        case WeightsUpdate() if digest_of(header.data) != header.digest:
            raise CodecError(
                f"weights {header.version} of '{header.node}': the file is not the one that its digest names"
            )
        case _:
            return header


def decode_as(kind: type[MessageT], parts: Parts) -> MessageT:
    """A message that must be of this type.

    Raises:
        CodecError: another one, or anything that ``encode`` would not have made.
    """
    row, _ = read_topic(parts)
    if row.message is not kind:
        raise CodecError(f"expected a {kind.__name__}, got a message of topic '{row.name}'")
    message = decode(parts)
    assert isinstance(message, kind)
    return message


def read_envelope(parts: Parts) -> Envelope:
    """Check topic, header and buffer sizes of a message, but leave its buffers alone (some ten microseconds).

    Raises:
        CodecError: not one of ours, or damaged.
    """
    row, header, buffers = _open(parts)
    _, source = read_topic(parts)
    if isinstance(header, KeyframeHeader):
        header, _ = _open_as(FrameHeader, buffers)
    stamp_ns, seq, world = (getattr(header, name, 0) for name in ("stamp_ns", "seq", "world"))
    if isinstance(header, MapUpdateHeader):
        return Envelope(row.name, source, stamp_ns, seq, world=world, T_map_world=header.T_map_world or ())
    if not isinstance(header, FrameHeader):
        return Envelope(row.name, source, stamp_ns, seq)
    return Envelope(
        topic=row.name,
        source=source,
        stamp_ns=stamp_ns,
        seq=seq,
        T_world_camera=header.T_world_camera,
        world=world,
        has_depth=header.depth is not None,
        has_label=header.label is not None,
        rgb_encoding=header.rgb.encoding,
        depth_scale=header.depth.scale if header.depth else 0.0,
        has_computed_depth=header.depth_sigma is not None,
        has_pseudo_label=header.pseudo_label and header.label is not None,
    )


def _pack(header: dict[str, Any], kind: type[object], what: str) -> bytes:
    """A header, checked as its reader will check it."""
    _leave_out_zeros(header)
    _read(header, kind, what)
    return pack_header(header, what)


def _pack_struct(header: FrameHeader | MapUpdateHeader) -> bytes:
    return _pack(to_plain(header, header.name), type(header), header.name)


def _read(header: Mapping[str, Any], kind: type[WireT], what: str) -> WireT:
    """Plain fields -> struct; a label set among them becomes what it is in Python."""
    if header.get("label_set") is not None:
        form = check_header(header["label_set"], LabelSetForm, f"{what}: label_set")
        try:
            header = {**header, "label_set": form.to_label_set()}
        except LabelError as error:
            raise CodecError(f"{what}: bad header: {error}") from error
    return check_header(header, kind, what)


def _open(parts: Parts) -> tuple[Topic, Any, Parts]:
    """Row of the topic, header and buffers of any message; the sizes of the buffers are checked, not what is in them.

    Of a keyframe the buffers are the parts of its frame; of weights the header is the message.
    """
    row, source = read_topic(parts)
    what = f"{row.name} message"
    fields = unpack_header(parts[1], what)
    if row.message is WeightsUpdate:  # the size of the file stands in the place of the file
        size = check_header(fields.get("bytes"), cast("type[int]", _WeightsBytes), f"{what}: bytes")
        (data,) = check_buffers(parts, [size], what)
        fields["bytes"] = bytes(data)
    header = cast(Any, _read(fields, _HEADERS.get(row.name, row.message), what))
    if row.source and getattr(header, row.source) != source:
        raise CodecError(f"topic '{row.name}/{source}/' carries a message of '{getattr(header, row.source)}'")
    match header:
        case FrameHeader() | MapUpdateHeader():
            specs = [getattr(header, name) for name in header.IMAGES]
            return row, header, check_buffers(parts, [s.bytes for s in specs if s is not None], header.name)
        case KeyframeHeader():
            return row, header, _open_keyframe(header, parts)
        case WeightsUpdate():
            return row, header, ()
        case _:
            return row, header, check_buffers(parts, (), what)


def _open_as(kind: type[WireT], parts: Parts) -> tuple[WireT, Parts]:
    row, header, buffers = _open(parts)
    if not isinstance(header, kind):
        raise CodecError(f"expected a {kind.__name__}, got the header of topic '{row.name}'")
    return header, buffers


def _by_name(header: FrameHeader, buffers: Parts) -> dict[str, Buffer]:
    """The buffers of a frame by the fields of its header."""
    names = [name for name in FrameHeader.IMAGES if getattr(header, name) is not None]
    return dict(zip(names, buffers, strict=True))


def _decode_rgb(header: FrameHeader, buffer: Buffer) -> UInt8:
    try:
        return decode_rgb(buffer, header.rgb.encoding, *header.size)
    except CodecError as error:
        raise CodecError(f"{header.name}: rgb: {error}") from error


def _decode_frame(header: FrameHeader, buffers: Parts) -> PosedFrame:
    size, what, data = header.size, header.name, _by_name(header, buffers)
    sigma = header.depth_sigma
    return PosedFrame(
        stamp_ns=header.stamp_ns,
        seq=header.seq,
        camera_id=header.camera_id,
        rgb=_decode_rgb(header, data["rgb"]),
        depth_m=None if header.depth is None else decode_depth(header.depth, data["depth"], size, what),
        label=None if header.label is None else decode_uint8(data["label"], size, f"{what}: label"),
        intrinsics=header.intrinsics,
        T_world_camera=np.array(header.T_world_camera, np.float64).reshape(4, 4),
        pose_source=header.pose_source,
        pose_sigma=header.pose_sigma,
        depth_sigma_m=None if sigma is None else decode_depth(sigma, data["depth_sigma"], size, f"{what}: spread of"),
        label_is_pseudo=header.pseudo_label and header.label is not None,
        world=header.world,
    )


def _encode_map_update(update: MapUpdate, options: CodecOptions) -> list[bytes]:
    height, width = update.label.shape
    what = f"map of camera '{update.camera_id}' seq={update.seq}"
    images = {"confidence": update.confidence, "depth_m": update.depth_m, "moving": update.moving}
    for name, image in images.items():
        if image is not None and image.shape != (height, width):
            raise CodecError(f"{what}: {name} {image.shape} must have the size of label, {update.label.shape}")
    if not bool(np.all((update.confidence >= 0) & (update.confidence <= 1 + 1e-5))):
        raise CodecError(f"{what}: confidence must lie in [0, 1]")
    packed: dict[str, tuple[Wire, bytes]] = {
        "label": encode_uint8(update.label),
        "confidence": encode_uint8(np.rint(np.minimum(update.confidence, 1) * 255).astype(np.uint8)),
        "depth": encode_depth(np.ascontiguousarray(update.depth_m, np.float32), options.depth_scale),
    }
    if update.moving is not None and update.moving.any():
        packed["moving"] = encode_uint8(update.moving.astype(np.uint8))
    header = MapUpdateHeader(
        width=width,
        height=height,
        T_map_world=None
        if np.array_equal(update.T_map_world, np.eye(4))
        else tuple(update.T_map_world.ravel().tolist()),
        **{name: getattr(update, name) for name in _UPDATE_SCALARS},
        **{name: cast(Any, spec) for name, (spec, _) in packed.items()},
    )
    return [topic_bytes("map", update.camera_id), _pack_struct(header), *(data for _, data in packed.values())]


def _decode_map_update(header: MapUpdateHeader, buffers: Parts) -> MapUpdate:
    size, what, T = (header.height, header.width), header.name, header.T_map_world
    label, confidence, depth, *moving = buffers
    return MapUpdate(
        label=decode_uint8(label, size, f"{what}: label"),
        confidence=decode_uint8(confidence, size, f"{what}: confidence").astype(np.float32) / np.float32(255),
        depth_m=decode_depth(header.depth, depth, size, what),
        moving=decode_uint8(moving[0], size, f"{what}: moving") > 0 if moving else None,
        T_map_world=np.eye(4) if T is None else np.array(T, np.float64).reshape(4, 4),
        **{name: getattr(header, name) for name in _UPDATE_SCALARS},
    )


def _encode_keyframe(keyframe: LabelledKeyframe, options: CodecOptions) -> list[bytes]:
    frame = keyframe.frame
    what = f"keyframe of camera '{frame.camera_id}' seq={frame.seq}"
    if frame.label is None:
        raise CodecError(f"{what}: has no label image, so that there is nothing to learn from it")
    _check_keyframe_size(frame.intrinsics, (), what)
    labels = to_plain(LabelSetForm.of(keyframe.label_set), what)
    header = {"camera_id": frame.camera_id, "teacher": keyframe.teacher, "label_set": labels}
    packed = _pack(header, KeyframeHeader, what)
    parts = [topic_bytes("keyframe", frame.camera_id), packed, *encode_frame(frame, options)[1:]]
    _check_keyframe_size(frame.intrinsics, parts, what)
    return parts


def _open_keyframe(header: KeyframeHeader, parts: Parts) -> Parts:
    """The parts of its frame, whose header and sizes are checked."""
    inner = [topic_bytes("frame", header.camera_id), *parts[2:]]
    if len(inner) < 2:
        raise CodecError(f"keyframe of camera '{header.camera_id}': has no frame")
    frame, _ = _open_as(FrameHeader, inner)
    what = f"keyframe of camera '{frame.camera_id}' seq={frame.seq}"
    if frame.label is None:
        raise CodecError(f"{what}: has no label image")
    _check_keyframe_size(frame.intrinsics, parts, what)
    return inner


def _check_keyframe_size(lens: CameraIntrinsics, parts: Parts, what: str) -> None:
    """Refuse a keyframe that is too large as a whole, packed or unpacked: learners keep dozens of them."""
    width, height, size = lens.width, lens.height, sum(map(len, parts))
    if width * height > MAX_KEYFRAME_PIXELS:
        raise CodecError(f"{what}: image of {width}x{height}; a keyframe has at most {MAX_KEYFRAME_PIXELS} pixels")
    if size > MAX_KEYFRAME_BYTES:
        raise CodecError(f"{what}: {size} bytes in all; a keyframe has at most {MAX_KEYFRAME_BYTES}")


def _leave_out_zeros(header: dict[str, Any]) -> None:
    for name in _NOT_SENT_AS_0:
        if header.get(name, 1) in (0, None):
            del header[name]
