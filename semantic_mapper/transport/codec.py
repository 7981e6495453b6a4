"""The one codec of wire and log: messages <-> multipart ``[topic, msgpack header, buffers...]``.

What encodes and decodes raises nothing but ``CodecError``. Every size is bounded and checked before anything is
allocated by it. Decoded arrays are fresh and writable. In a log a message is a msgpack array of binaries, which any
msgpack reader opens. Questions about a map have a codec of their own, ``queries.questions``.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper.errors import CodecError, LabelError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.images import (
    CodecOptions,
    DepthSpec,
    RgbSpec,
    Uint8Spec,
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
_FRAME_SCALARS = "stamp_ns seq camera_id intrinsics pose_source pose_sigma world".split()
_UPDATE_SCALARS = (
    "stamp_ns seq camera_id fused is_keyframe source_seqs blocks blocks_touched rays samples stage_ms world".split()
)
_NOT_SENT_AS_0 = "unreadable pseudo_label depth_sigma moving world T_map_world".split()  # most messages need none
_FramedParts = Annotated[list[Annotated[bytes, Meta(max_length=MAX_PART_BYTES)]], Meta(max_length=MAX_PARTS)]
_BEYOND = re.compile(r"Expected `float` [<>]= \S+e\+308")  # how msgspec says it
_Pose = Annotated[tuple[Finite, ...], Meta(min_length=16, max_length=16)]  # (4, 4) float64 row by row, exact

_Packed = dict[str, tuple[Any, bytes]]  # images of a message by their fields in the header: spec and buffer

MessageT = TypeVar("MessageT")
WireT = TypeVar("WireT")


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A colour image that is already a PNG or JPEG file; must decode to the frame's ``rgb``."""

    encoding: Literal["png", "jpeg"]
    data: bytes


@dataclass(frozen=True, slots=True)
class Envelope:
    """What can be known of a message without decoding its buffers."""

    topic: str  # name of the topic ("frame", "map", ...); ``source``: camera id or node
    source: str
    # stamp_ns, seq, world: 0 where the message has none.
    stamp_ns: int = 0
    seq: int = 0
    world: int = 0
    T_world_camera: tuple[float, ...] = ()  # of a frame, 16 numbers row by row; else empty
    T_map_world: tuple[float, ...] = ()  # of a map update, 16 numbers; empty where it is no motion
    # has_depth, has_label: Of a frame.
    has_depth: bool = False
    has_label: bool = False
    rgb_encoding: str = ""  # of a frame: "png", "jpeg" or "raw"
    depth_scale: float = 0.0  # units a metre of a frame's depth where it is packed as uint16, else 0
    # has_computed_depth, has_pseudo_label: Whether no sensor and no person has made them.
    has_computed_depth: bool = False
    has_pseudo_label: bool = False


class FrameHeader(Wire, frozen=True):
    """``PosedFrame`` without its images; buffers: rgb, depth, label, depth_sigma, those that there are."""

    TOPIC: ClassVar = "frame"
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
            raise CodecError("has a spread of its depth, and no depth")

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of its images."""
        return self.intrinsics.height, self.intrinsics.width


class MapUpdateHeader(Wire, frozen=True, kw_only=True):
    """``MapUpdate`` without its images; buffers: label, confidence, depth and, where something moves, moving (0, 1)."""

    TOPIC: ClassVar = "map"
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
    def size(self) -> tuple[int, int]:
        """Height and width of its images."""
        return self.height, self.width


class KeyframeHeader(Wire, frozen=True):
    """``LabelledKeyframe`` without its frame; then come header and buffers of that."""

    camera_id: Source
    teacher: Word
    label_set: LabelSet


_ImageHeader = FrameHeader | MapUpdateHeader
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
    return msgspec.msgpack.encode(parts)


def unpack_parts(payload: Buffer) -> list[bytes]:
    """Inverse of ``pack_parts``; ``CodecError`` where it is no such payload, or one beyond the size limits."""
    try:
        return msgspec.msgpack.decode(payload, type=_FramedParts)
    except (ValueError, RecursionError) as error:
        raise CodecError(f"payload is not a framed message: {error}") from error


def to_plain(value: object, what: str) -> Any:
    """A message or header as dicts, lists, strings and numbers, also those of NumPy; ``CodecError``: something else."""

    def plain(value: object) -> object:
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"no header holds a {type(value).__name__}")

    try:
        return msgspec.to_builtins(value, builtin_types=(bytes,), enc_hook=plain)
    except (ValueError, TypeError, OverflowError) as error:
        raise CodecError(f"{what}: cannot be sent: {error}") from error


def pack_header(header: Mapping[str, Any], what: str, limit: int = MAX_HEADER_BYTES) -> bytes:
    """Plain fields, which have passed ``check_header``, -> msgpack; ``CodecError`` beyond ``limit`` bytes."""
    packed = msgspec.msgpack.encode({"v": PROTOCOL_VERSION, **header})
    if len(packed) > limit:
        raise CodecError(f"{what}: cannot be sent: a header of {len(packed)} bytes, at most {limit}")
    return packed


def unpack_header(packed: Buffer, what: str, limit: int = MAX_HEADER_BYTES) -> dict[str, Any]:
    """msgpack -> plain fields without the protocol's version, not checked any further. Raises CodecError: too long, not
    msgpack, nested too deeply, no map, or of another protocol version."""
    if len(packed) > limit:
        raise CodecError(f"{what}: header of {len(packed)} bytes, at most {limit} are accepted")
    try:
        fields = msgspec.msgpack.decode(packed, type=dict[str, Any])
    except (ValueError, RecursionError) as error:  # ValueError includes bad UTF-8
        raise CodecError(f"{what}: bad header: {error}") from error
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

    Raises CodecError: an unknown or missing field, a wrong type, a number out of bounds or not finite, or what
    ``__post_init__`` refuses; names the field.
    """
    try:
        return msgspec.convert(header, kind, dec_hook=read)
    except (ValueError, TypeError, RecursionError, OverflowError) as error:
        raise CodecError(f"{what}: bad header: {_BEYOND.sub('only finite numbers can be sent', str(error))}") from error


def encode(message: Message, options: CodecOptions = _DEFAULTS, *, sender: str = "source") -> list[bytes]:
    """Any message -> parts.

    ``sender`` is the second word of the topic of a ``StreamInfo``; the other messages name theirs. Raises CodecError: a
    value that cannot be sent: out of bounds, NaN, or of the wrong type.
    """
    if isinstance(message, PosedFrame):
        return encode_frame(message, options)
    if isinstance(message, MapUpdate):
        return _encode_map_update(message, options)
    row = _ROWS[type(message)]
    source = getattr(message, row.source) if row.source else sender
    what, header, buffers = f"{row.name} of '{source}'", message, []
    if isinstance(message, LabelledKeyframe):
        header = KeyframeHeader(source, message.teacher, message.label_set)
        buffers = encode_frame(message.frame, options)[1:]
    elif isinstance(message, WeightsUpdate):
        buffers = [message.data]
    parts = [topic_bytes(row.name, source), _pack(header, what), *buffers]
    if isinstance(message, LabelledKeyframe):
        _open(parts)  # is it too large, or without labels?
    return parts


def encode_frame(
    frame: PosedFrame, options: CodecOptions = _DEFAULTS, *, encoded_rgb: EncodedImage | None = None
) -> list[bytes]:
    """Posed frame -> parts. Depth, its spread, labels, stamps and the float64 pose are exact; so is colour unless
    "jpeg". ``encoded_rgb`` is sent instead of packing ``frame.rgb`` again, so that an imported JPEG stays what it was.

    Raises CodecError: the pose is not finite (whether it is a rotation the receiver judges), or no topic can hold the
    camera's id.
    """
    rgb = encoded_rgb.data if encoded_rgb else encode_rgb(frame.rgb, options.rgb, options.jpeg_quality)
    packed: _Packed = {"rgb": (RgbSpec(encoded_rgb.encoding if encoded_rgb else options.rgb, len(rgb)), rgb)}
    if frame.depth_m is not None:
        packed["depth"] = encode_depth(frame.depth_m, options.depth_scale)
    if frame.label is not None:
        packed["label"] = encode_uint8(frame.label)
    if frame.depth_sigma_m is not None:
        packed["depth_sigma"] = encode_depth(frame.depth_sigma_m, options.depth_scale)
    header = FrameHeader(
        T_world_camera=tuple(frame.T_world_camera.ravel().tolist()),
        pseudo_label=frame.label_is_pseudo and frame.label is not None,
        **{name: getattr(frame, name) for name in _FRAME_SCALARS},
        **{name: spec for name, (spec, _) in packed.items()},
    )
    return _parts(header, packed)


def _encode_map_update(update: MapUpdate, options: CodecOptions) -> list[bytes]:
    what = f"map of camera '{update.camera_id}' seq={update.seq}"
    for image in (update.confidence, update.depth_m, update.moving):
        if image is not None and image.shape != update.label.shape:
            raise CodecError(f"{what}: an image {image.shape} must have the size of label, {update.label.shape}")
    if not bool(np.all((update.confidence >= 0) & (update.confidence <= 1 + 1e-5))):
        raise CodecError(f"{what}: confidence must lie in [0, 1]")
    packed: _Packed = {
        "label": encode_uint8(update.label),
        "confidence": encode_uint8(np.rint(np.minimum(update.confidence, 1) * 255).astype(np.uint8)),
        "depth": encode_depth(np.ascontiguousarray(update.depth_m, np.float32), options.depth_scale),
    }
    if update.moving is not None and update.moving.any():
        packed["moving"] = encode_uint8(update.moving.astype(np.uint8))
    is_motion = not np.array_equal(update.T_map_world, np.eye(4))
    header = MapUpdateHeader(
        width=update.label.shape[1],
        height=update.label.shape[0],
        T_map_world=tuple(update.T_map_world.ravel().tolist()) if is_motion else None,
        **{name: getattr(update, name) for name in _UPDATE_SCALARS},
        **{name: spec for name, (spec, _) in packed.items()},
    )
    return _parts(header, packed)


def with_label(parts: Parts, pseudo_label: UInt8 | None) -> list[bytes]:
    """A frame with a pseudo label (H, W), or none, in place of its label; all else stays, byte for byte."""
    packed: _Packed = {} if pseudo_label is None else {"label": encode_uint8(pseudo_label)}
    return _with_images(parts, packed, without="label", pseudo_label=pseudo_label is not None)


def retaken(parts: Parts, stamp_ns: int, seq: int) -> list[bytes]:
    """A frame as of another capture, without labels; all else stays, byte for byte."""
    return _with_images(parts, {}, without="label", pseudo_label=False, stamp_ns=stamp_ns, seq=seq)


def with_computed_depth(parts: Parts, depth_m: Float32, sigma_m: Float32) -> list[bytes]:
    """A frame with computed depth (H, W) and its one-sigma spread, in metres; all else stays, byte for byte."""
    scale = _DEFAULTS.depth_scale
    return _with_images(parts, {"depth": encode_depth(depth_m, scale), "depth_sigma": encode_depth(sigma_m, scale)})


def scaled_frame(parts: Parts, factor: float) -> list[bytes]:
    """A frame whose pose is so many times as far from the origin; all else, depth too, stays, byte for byte."""
    T = np.array(_open_frame(parts)[0].T_world_camera).reshape(4, 4)
    T[:3, 3] *= factor
    return _with_images(parts, {}, T_world_camera=tuple(T.ravel().tolist()))


def repack_rgb(parts: Parts, options: CodecOptions) -> list[bytes]:
    """A frame with its colour image packed as ``options`` say; all else, and an image that is so already, stays."""
    header, buffers = _open_frame(parts)
    if header.rgb.encoding == options.rgb:
        return [bytes(part) for part in parts]
    data = encode_rgb(_decode_images(header, buffers, ("rgb",))["rgb"], options.rgb, options.jpeg_quality)
    return _with_images(parts, {"rgb": (RgbSpec(options.rgb, len(data)), data)})


def _with_images(parts: Parts, packed: _Packed, *, without: str = "", **fields: Any) -> list[bytes]:
    """A frame with some other images and fields, and without one image that is not given again."""
    header, buffers = _open_frame(parts)
    kept = {name: (spec, bytes(data)) for (name, spec), data in zip(_specs(header).items(), buffers, strict=True)}
    kept.pop(without, None)
    kept |= packed
    specs = {name: kept[name][0] if name in kept else None for name in header.IMAGES}
    header = msgspec.structs.replace(header, **specs, **fields)
    return _parts(header, {name: kept[name] for name in header.IMAGES if name in kept})


def decode(parts: Parts) -> Message:
    """Any message, by its topic; ``CodecError`` where ``encode`` would not have made it."""
    _, header, buffers = _open(parts)
    match header:
        case FrameHeader():
            return _decode_frame(header, buffers)
        case MapUpdateHeader():
            images, T = _decode_images(header, buffers), header.T_map_world
            return MapUpdate(
                label=images["label"],
                confidence=images["confidence"].astype(np.float32) / np.float32(255),
                depth_m=images["depth"],
                moving=images["moving"] > 0 if "moving" in images else None,
                T_map_world=np.eye(4) if T is None else np.array(T, np.float64).reshape(4, 4),
                **{name: getattr(header, name) for name in _UPDATE_SCALARS},
            )
        case KeyframeHeader():
            return LabelledKeyframe(_decode_frame(*_open_frame(buffers)), header.label_set, header.teacher)
        case WeightsUpdate() if digest_of(header.data) != header.digest:
            raise CodecError(
                f"weights {header.version} of '{header.node}': the file is not the one that its digest names"
            )
        case _:
            return header


def decode_as(kind: type[MessageT], parts: Parts) -> MessageT:
    """As ``decode``, a message that must be of this type."""
    row, _ = read_topic(parts)
    if row.message is not kind:
        raise CodecError(f"expected a {kind.__name__}, got a message of topic '{row.name}'")
    return cast(MessageT, decode(parts))


def read_envelope(parts: Parts) -> Envelope:
    """Check topic, header and buffer sizes of a message, but leave its buffers alone (some ten microseconds).
    ``CodecError`` where it is not one of ours, or damaged."""
    row, header, buffers = _open(parts)
    if isinstance(header, KeyframeHeader):
        header, _ = _open_frame(buffers)
    common: dict[str, Any] = {name: getattr(header, name, 0) for name in ("stamp_ns", "seq", "world")}
    source = read_topic(parts)[1]
    if not isinstance(header, FrameHeader):
        return Envelope(row.name, source, **common, T_map_world=getattr(header, "T_map_world", None) or ())
    return Envelope(
        row.name,
        source,
        **common,
        T_world_camera=header.T_world_camera,
        has_depth=header.depth is not None,
        has_label=header.label is not None,
        rgb_encoding=header.rgb.encoding,
        depth_scale=header.depth.scale if header.depth else 0.0,
        has_computed_depth=header.depth_sigma is not None,
        has_pseudo_label=header.pseudo_label and header.label is not None,
    )


def _parts(header: _ImageHeader, packed: _Packed) -> list[bytes]:
    topic = topic_bytes(header.TOPIC, header.camera_id)
    return [topic, _pack(header, _name(header)), *(data for _, data in packed.values())]


def _name(header: _ImageHeader) -> str:
    return f"{header.TOPIC} of camera '{header.camera_id}' seq={header.seq}"


def _pack(header: object, what: str) -> bytes:
    fields = to_plain(header, what)
    if (labels := getattr(header, "label_set", None)) is not None:
        fields["label_set"] = to_plain(LabelSetForm.of(labels), what)
    for name in _NOT_SENT_AS_0:
        if fields.get(name, 1) in (0, None):
            del fields[name]
    _read(fields, type(header), what)
    if isinstance(header, WeightsUpdate):
        fields["bytes"] = len(header.data)
    return pack_header(fields, what)


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
    what, buffers = f"{row.name} message", parts[2:]
    fields = unpack_header(parts[1], what)
    if row.message is WeightsUpdate:  # the size of the file stands in the place of the file
        if len(buffers) != 1 or fields.get("bytes") != len(buffers[0]) or len(buffers[0]) > MAX_WEIGHTS_BYTES:
            raise CodecError(f"{what}: the header announces a file of other bytes, or of more than {MAX_WEIGHTS_BYTES}")
        fields["bytes"], buffers = bytes(buffers[0]), ()
    header = cast(Any, _read(fields, _HEADERS.get(row.name, row.message), what))
    if row.source and getattr(header, row.source) != source:
        raise CodecError(f"topic '{row.name}/{source}/' carries a message of '{getattr(header, row.source)}'")
    if isinstance(header, KeyframeHeader):
        return row, header, _open_keyframe(header, parts)
    sizes: list[int] = []
    if isinstance(header, _ImageHeader):
        what, sizes = _name(header), [spec.bytes for spec in _specs(header).values()]
    if (actual := [len(buffer) for buffer in buffers]) != sizes:
        raise CodecError(f"{what}: the header announces buffers of {sizes} bytes, got {actual}")
    return row, header, buffers


def _open_frame(parts: Parts) -> tuple[FrameHeader, Parts]:
    row, header, buffers = _open(parts)
    if not isinstance(header, FrameHeader):
        raise CodecError(f"expected a frame, got a message of topic '{row.name}'")
    return header, buffers


def _open_keyframe(header: KeyframeHeader, parts: Parts) -> Parts:
    """The parts of its frame, whose header and sizes are checked; it is bounded as a whole, packed and unpacked, as
    learners keep dozens of them."""
    what = f"keyframe of camera '{header.camera_id}'"
    inner = [topic_bytes("frame", header.camera_id), *parts[2:]]
    if len(inner) < 2:
        raise CodecError(f"{what}: has no frame")
    frame, _ = _open_frame(inner)
    if frame.label is None:
        raise CodecError(f"{what}: has no label image, so that there is nothing to learn from it")
    height, width = frame.size
    if width * height > MAX_KEYFRAME_PIXELS:
        raise CodecError(f"{what}: image of {width}x{height}; a keyframe has at most {MAX_KEYFRAME_PIXELS} pixels")
    if (size := sum(map(len, parts))) > MAX_KEYFRAME_BYTES:
        raise CodecError(f"{what}: {size} bytes in all; a keyframe has at most {MAX_KEYFRAME_BYTES}")
    return inner


def _specs(header: _ImageHeader) -> dict[str, RgbSpec | DepthSpec | Uint8Spec]:
    """How the images of a message are packed, by name, in the order of its buffers."""
    return {name: spec for name in header.IMAGES if (spec := getattr(header, name)) is not None}


def _decode_images(header: _ImageHeader, buffers: Parts, names: tuple[str, ...] = ()) -> dict[str, NDArray[Any]]:
    """Those of these names; without any, all that there are."""
    return {
        name: spec.decode(data, header.size, f"{_name(header)}: {name}")
        for (name, spec), data in zip(_specs(header).items(), buffers, strict=True)
        if not names or name in names
    }


def _decode_frame(header: FrameHeader, buffers: Parts) -> PosedFrame:
    images = _decode_images(header, buffers)
    return PosedFrame(
        rgb=images["rgb"],
        depth_m=images.get("depth"),
        label=images.get("label"),
        depth_sigma_m=images.get("depth_sigma"),
        T_world_camera=np.array(header.T_world_camera, np.float64).reshape(4, 4),
        label_is_pseudo=header.pseudo_label and header.label is not None,
        **{name: getattr(header, name) for name in _FRAME_SCALARS},
    )
