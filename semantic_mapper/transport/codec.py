"""The one codec of wire and log: messages, questions and answers <-> multipart ``[name, msgpack header, buffers...]``.

What encodes and decodes raises nothing but ``CodecError``; only ``decode_answer`` raises what the answer says. Every
size is bounded and checked before anything is allocated by it. Decoded arrays are fresh and writable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from semantic_mapper import errors
from semantic_mapper.errors import CodecError, SemanticMapperError, TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.compression import zstd_compress, zstd_decompress
from semantic_mapper.transport.framing import (
    MAX_KEYFRAME_PIXELS,
    MAX_PART_BYTES,
    MAX_PARTS,
    Buffer,
    Parts,
    check_buffers,
)
from semantic_mapper.transport.headers import (
    MAX_ENTRIES,
    PROTOCOL_VERSION,
    CaptureStamp,
    Count,
    Finite,
    IntrinsicsForm,
    LabelSetForm,
    Side,
    Source,
    Stamp,
    Wire,
    WireT,
    Word,
    check_header,
    pack_header,
    to_plain,
    unpack_header,
)
from semantic_mapper.transport.images import (
    CodecOptions,
    ConfidenceSpec,
    DepthSpec,
    LabelSpec,
    RgbSpec,
    decode_confidence,
    decode_depth,
    decode_label,
    decode_rgb,
    encode_confidence,
    encode_depth,
    encode_label,
    encode_rgb,
)
from semantic_mapper.transport.messages import (
    MAX_KEYFRAME_BYTES,
    MAX_WEIGHTS_BYTES,
    FrameRefused,
    LabelledKeyframe,
    Message,
    Status,
    StreamInfo,
    WeightsUpdate,
    digest_of,
)
from semantic_mapper.transport.query_messages import (
    MAX_REQUEST_ROWS,
    QUESTIONS,
    Answer,
    ArrayForm,
    ArraySpec,
    ErrorAnswer,
    Request,
    array_forms,
)
from semantic_mapper.transport.topics import TOPICS, Topic, read_topic, topic_bytes
from semantic_mapper.types import MAX_PIXELS, MAX_POSE_SIGMA_M, CameraIntrinsics, Float32, MapUpdate, PosedFrame, UInt8

_DEFAULTS = CodecOptions()
_ROWS = {row.message: row for row in TOPICS.values()}
_FORMS: dict[str, Any] = {  # of fields that stand otherwise in a header than in Python
    "intrinsics": IntrinsicsForm,
    "cameras": Annotated[dict[Source, IntrinsicsForm], Meta(max_length=64)],
    "label_set": LabelSetForm | None,
}
_UPDATE_SCALARS = (
    "stamp_ns seq camera_id fused is_keyframe source_seqs blocks blocks_touched rays samples stage_ms world".split()
)
_WeightsBytes = Annotated[int, Meta(ge=1, le=MAX_WEIGHTS_BYTES)]
_ERROR = "error"  # in the place of an answer's kind
_RAISED = {
    e.__name__: e for e in (errors.MapError, errors.LabelError, errors.CodecError, errors.ShapeError, errors.PoseError)
}
_ZSTD_LEVEL = 1
_NOT_SENT_AS_0 = (
    "unreadable",
    "scale_unknown",
    "computed",
    "pseudo_label",
    "depth_sigma",
    "gone",
    "moving",
    "world",
    "T_map_world",
)  # came later: what does not need it is read by older releases, too
_FRAME_BUFFERS = ("rgb", "depth", "label", "depth_sigma")  # fields of a frame's header, in the order of their buffers

MessageT = TypeVar("MessageT")
AnswerT = TypeVar("AnswerT", bound=Answer)


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

    stamp_ns: CaptureStamp
    seq: Count
    camera_id: Source
    intrinsics: CameraIntrinsics
    T_world_camera: Annotated[tuple[Finite, ...], Meta(min_length=16, max_length=16)]  # row by row, float64, exact
    pose_source: Word
    pose_sigma: Annotated[float, Meta(ge=0, le=MAX_POSE_SIGMA_M)]
    rgb: RgbSpec
    depth: DepthSpec | None = None
    label: LabelSpec | None = None
    depth_sigma: DepthSpec | None = None  # of computed depth
    pseudo_label: bool = False
    world: Count = 0  # sent where it is not 0

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
    label: LabelSpec
    confidence: ConfidenceSpec
    depth: DepthSpec
    moving: LabelSpec | None = None
    world: Count = 0
    T_map_world: Annotated[tuple[Finite, ...], Meta(min_length=16, max_length=16)] | None = None  # None: no motion

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
        described.append((item.encode_name, _FORMS.get(item.name, item.type)))
    return msgspec.defstruct(kind.__name__.removesuffix("Header"), described, kw_only=True, forbid_unknown_fields=True)


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
            return _encode_weights(message)
        case _:
            row = _ROWS[type(message)]
            source = getattr(message, row.source) if row.source else sender
            what = f"{row.name} of '{source}'"
            header = to_plain(message, what)
            if isinstance(message, StreamInfo) and message.label_set is not None:
                header["label_set"] = to_plain(LabelSetForm.of(message.label_set), what)
            _leave_out_zeros(header)
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
        encoded_rgb_bytes, encoding = encode_rgb(frame.rgb, options.rgb, options.jpeg_quality), options.rgb
    else:
        encoded_rgb_bytes, encoding = encoded_rgb.data, encoded_rgb.encoding
    buffers = [encoded_rgb_bytes]
    depth = label = sigma = None
    if frame.depth_m is not None:
        depth, data = encode_depth(frame.depth_m, options)
        buffers.append(data)
    if frame.label is not None:
        label, data = encode_label(frame.label, options)
        buffers.append(data)
    if frame.depth_sigma_m is not None:
        sigma, data = encode_depth(frame.depth_sigma_m, options)
        buffers.append(data)
    header = FrameHeader(
        stamp_ns=frame.stamp_ns,
        seq=frame.seq,
        camera_id=frame.camera_id,
        intrinsics=frame.intrinsics,
        T_world_camera=tuple(frame.T_world_camera.ravel().tolist()),
        pose_source=frame.pose_source,
        pose_sigma=float(frame.pose_sigma),
        rgb=RgbSpec(encoding, len(encoded_rgb_bytes)),
        depth=depth,
        label=label,
        depth_sigma=sigma,
        pseudo_label=frame.label_is_pseudo and label is not None,
        world=int(frame.world),
    )
    return [topic_bytes("frame", frame.camera_id), _pack_frame_header(header), *buffers]


def with_label(parts: Parts, pseudo_label: UInt8 | None, options: CodecOptions = _DEFAULTS) -> list[bytes]:
    """A frame with a pseudo label (H, W), or none, in place of its label; all else stays, byte for byte.

    Raises:
        CodecError: no frame.
    """
    packed = None if pseudo_label is None else encode_label(pseudo_label, options)
    return _rebuilt(parts, {"label": packed}, pseudo_label=packed is not None)


def with_computed_depth(
    parts: Parts, depth_m: Float32, sigma_m: Float32, options: CodecOptions = _DEFAULTS
) -> list[bytes]:
    """A frame with computed depth (H, W) and its one-sigma spread, in metres; all else stays, byte for byte.

    Raises:
        CodecError: no frame.
    """
    return _rebuilt(parts, {"depth": encode_depth(depth_m, options), "depth_sigma": encode_depth(sigma_m, options)})


def _rebuilt(parts: Parts, images: Mapping[str, tuple[Wire, bytes] | None], **fields: Any) -> list[bytes]:
    """A frame with other images, by their fields in the header, and other fields; None = without the image."""
    header, buffers = _open_frame(parts)
    data = {name: bytes(buffer) for name, buffer in _named(header, buffers).items()}
    for name, packed in images.items():
        fields[name], data[name] = (None, b"") if packed is None else packed
    header = msgspec.structs.replace(header, **fields)
    there = [data[name] for name in _FRAME_BUFFERS if getattr(header, name) is not None]
    return [bytes(parts[0]), _pack_frame_header(header), *there]


def repack_rgb(parts: Parts, options: CodecOptions) -> list[bytes]:
    """A frame with its colour image packed as ``options`` say; all else, and an image that is so already, stays.

    Raises:
        CodecError: no frame, or its colour image is damaged.
    """
    header, buffers = _open_frame(parts)
    if header.rgb.encoding == options.rgb:
        return [bytes(part) for part in parts]
    data = encode_rgb(_decode_rgb(header, buffers[0]), options.rgb, options.jpeg_quality)
    return _rebuilt(parts, {"rgb": (RgbSpec(options.rgb, len(data)), data)})


def decode(parts: Parts) -> Message:
    """Any message, by its topic.

    Raises:
        CodecError: anything that ``encode`` would not have made.
    """
    row, _ = read_topic(parts)
    match row.name:
        case "frame":
            return _decode_frame(*_open_frame(parts))
        case "map":
            return _decode_map_update(*_open_map_update(parts))
        case "keyframe":
            header, frame = _open_keyframe(parts)
            return LabelledKeyframe(_decode_frame(*frame), header.label_set, header.teacher)
        case "weights":
            update = _open_weights(parts)
            if digest_of(update.data) != update.digest:
                raise CodecError(f"{_weights_name(update)}: the file is not the one that its digest names")
            return update
        case _:
            return _open_plain(parts, row)


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
    row, source = read_topic(parts)
    match row.name:
        case "frame":
            header, _ = _open_frame(parts)
            return _frame_envelope(row.name, header)
        case "keyframe":
            _, (header, _) = _open_keyframe(parts)
            return _frame_envelope(row.name, header)
        case "map":
            update, _ = _open_map_update(parts)
            where = {"world": update.world, "T_map_world": update.T_map_world or ()}
            return Envelope(row.name, source, update.stamp_ns, update.seq, **where)
        case "weights":
            _open_weights(parts)
            return Envelope(row.name, source)
    message = _open_plain(parts, row)
    if isinstance(message, FrameRefused):
        return Envelope(row.name, source, message.stamp_ns, message.seq)
    return Envelope(row.name, source, message.stamp_ns if isinstance(message, Status) else 0)


def encode_request(kind: str, request: Request) -> list[bytes]:
    """Question -> parts.

    Args:
        kind: A key of ``QUESTIONS``.
        request: Of its type; arrays are converted to the dtypes of their forms.

    Raises:
        CodecError: too many rows, or a value that cannot be sent.
    """
    parts, specs = _encode_query(kind, request, kind)
    _check_rows(specs, kind)
    return parts


def decode_request(parts: Parts) -> tuple[str, Request]:
    """Parts -> kind and question.

    Raises:
        CodecError: anything that ``encode_request`` would not have made.
    """
    kind = _query_kind(parts)
    question = QUESTIONS.get(kind)
    if question is None:
        raise CodecError(f"unknown question {kind!r}; there are {', '.join(QUESTIONS)}")
    fields, specs = _open_query(parts, question.request, kind)
    _check_rows(specs, kind)
    return kind, _decode_query(fields, specs, parts, question.request, kind)


def encode_answer(kind: str, answer: Answer) -> list[bytes]:
    """Answer -> parts; see ``encode_request``.

    Raises:
        CodecError: larger than a message may be, or a value that cannot be sent.
    """
    parts, _ = _encode_query(kind, answer, f"answer to '{kind}'")
    return parts


def encode_error(error: SemanticMapperError) -> list[bytes]:
    """An error in the place of an answer; an overlong text is cut."""
    text = str(error).encode("utf-8", errors="replace").decode()[:4000]
    return [_ERROR.encode(), _pack({"error": type(error).__name__, "text": text}, ErrorAnswer, "error")]


def decode_answer(kind: str, answer: type[AnswerT], parts: Parts) -> AnswerT:
    """Parts -> the answer to a question.

    Args:
        kind: Of the question.
        answer: The answer type of the question.
        parts: What came.

    Raises:
        MapError, LabelError, CodecError, ShapeError, PoseError: the other side answered with this error.
        TransportError: it answered with another one.
        CodecError: anything that ``encode_answer`` would not have made, or an answer to another question.
    """
    what = f"answer to '{kind}'"
    actual = _query_kind(parts)
    if actual == _ERROR:
        said = check_header(unpack_header(parts[1], what), ErrorAnswer, what)
        raise _RAISED.get(said.error, TransportError)(said.text)
    if actual != kind:
        raise CodecError(f"{what}: got one to {actual!r}")
    fields, specs = _open_query(parts, answer, what)
    lengths = {s.shape[: f.free] for f, s in zip(array_forms(answer).values(), specs, strict=False)}
    if QUESTIONS[kind].aligned and len(lengths) > 1:
        raise CodecError(f"{what}: arrays of different lengths {sorted(lengths)}")
    return _decode_query(fields, specs, parts, answer, what)


def _pack(header: Mapping[str, Any], kind: type[object], what: str) -> bytes:
    """A header, checked as its reader will check it."""
    _read(header, kind, what)
    return pack_header(header, what)


def _pack_frame_header(header: FrameHeader) -> bytes:
    plain = to_plain(header, header.name)
    _leave_out_zeros(plain)
    return _pack(plain, FrameHeader, header.name)


def _read(header: Mapping[str, Any], kind: type[WireT], what: str) -> WireT:
    """Plain fields -> struct; intrinsics and label sets among them become what they are in Python."""
    try:
        restored = {
            name: msgspec.convert(value, _FORMS[name]) if name in _FORMS else value for name, value in header.items()
        }
        if (lens := restored.get("intrinsics")) is not None:
            restored["intrinsics"] = lens.to_intrinsics()
        if (cameras := restored.get("cameras")) is not None:
            restored["cameras"] = {name: lens.to_intrinsics(f"camera '{name}': ") for name, lens in cameras.items()}
        if (labels := restored.get("label_set")) is not None:
            restored["label_set"] = labels.to_label_set()
    except ValueError as error:  # msgspec's, and those of the core types
        raise CodecError(f"{what}: bad header: {error}") from error
    return check_header(restored, kind, what)


def _open(parts: Parts, name: str, kind: type[WireT]) -> WireT:
    """Header of a message that must be of topic ``name``; its buffers are left alone."""
    row, source = read_topic(parts)
    if row.name != name:
        raise CodecError(f"expected a message of topic '{name}', got '{row.name}'")
    what = f"{name} message"
    header = _read(unpack_header(parts[1], what), kind, what)
    _check_source(row, source, header)
    return header


def _check_source(row: Topic, source: str, header: object) -> None:
    if row.source and getattr(header, row.source) != source:
        raise CodecError(f"topic '{row.name}/{source}/' carries a message of '{getattr(header, row.source)}'")


def _open_plain(parts: Parts, row: Topic) -> Any:
    """A message without buffers."""
    message = _open(parts, row.name, row.message)
    check_buffers(parts, (), f"{row.name} message")
    return message


def _open_frame(parts: Parts) -> tuple[FrameHeader, Parts]:
    header = _open(parts, "frame", FrameHeader)
    if header.depth_sigma is not None and header.depth is None:
        raise CodecError(f"{header.name}: has a spread of its depth, and no depth")
    specs = [getattr(header, name) for name in _FRAME_BUFFERS]
    return header, check_buffers(parts, [s.bytes for s in specs if s is not None], header.name)


def _named(header: FrameHeader, buffers: Parts) -> dict[str, Buffer]:
    """The buffers of a frame by the fields of its header."""
    names = [name for name in _FRAME_BUFFERS if getattr(header, name) is not None]
    return dict(zip(names, buffers, strict=True))


def _frame_envelope(topic: str, header: FrameHeader) -> Envelope:
    return Envelope(
        topic=topic,
        source=header.camera_id,
        stamp_ns=header.stamp_ns,
        seq=header.seq,
        T_world_camera=header.T_world_camera,
        world=header.world,
        has_depth=header.depth is not None,
        has_label=header.label is not None,
        rgb_encoding=header.rgb.encoding,
        depth_scale=header.depth.scale if header.depth and header.depth.encoding == "u16_delta_planes_zstd" else 0.0,
        has_computed_depth=header.depth_sigma is not None,
        has_pseudo_label=header.pseudo_label and header.label is not None,
    )


def _decode_rgb(header: FrameHeader, buffer: Buffer) -> UInt8:
    try:
        return decode_rgb(buffer, header.rgb.encoding, *header.size)
    except CodecError as error:
        raise CodecError(f"{header.name}: rgb: {error}") from error


def _decode_frame(header: FrameHeader, buffers: Parts) -> PosedFrame:
    size, what, data = header.size, header.name, _named(header, buffers)
    sigma = header.depth_sigma
    return PosedFrame(
        stamp_ns=header.stamp_ns,
        seq=header.seq,
        camera_id=header.camera_id,
        rgb=_decode_rgb(header, data["rgb"]),
        depth_m=None if header.depth is None else decode_depth(header.depth, data["depth"], size, what),
        label=None if header.label is None else decode_label(data["label"], size, what),
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
    if update.confidence.shape != (height, width) or update.depth_m.shape != (height, width):
        raise CodecError(
            f"{what}: label {update.label.shape}, confidence {update.confidence.shape} and depth_m "
            f"{update.depth_m.shape} must have one size"
        )
    label_spec, label = encode_label(update.label, options)
    confidence_spec, confidence = encode_confidence(update.confidence, options)
    depth_spec, depth = encode_depth(np.ascontiguousarray(update.depth_m, np.float32), options)
    fields = {name: getattr(update, name) for name in MapUpdateHeader.__struct_fields__ if name in _UPDATE_SCALARS}
    specs = {"label": label_spec, "confidence": confidence_spec, "depth": depth_spec}
    buffers = [label, confidence, depth]
    if update.moving is not None and update.moving.shape != (height, width):
        raise CodecError(f"{what}: moving {update.moving.shape} must have the size of label, {update.label.shape}")
    if update.moving is not None and update.moving.any():
        specs["moving"], data = encode_label(update.moving.astype(np.uint8), options)
        buffers.append(data)
    T = None if np.array_equal(update.T_map_world, np.eye(4)) else tuple(update.T_map_world.ravel().tolist())
    header = to_plain(MapUpdateHeader(width=width, height=height, T_map_world=T, **fields, **specs), what)
    _leave_out_zeros(header)
    return [topic_bytes("map", update.camera_id), _pack(header, MapUpdateHeader, what), *buffers]


def _open_map_update(parts: Parts) -> tuple[MapUpdateHeader, Parts]:
    header = _open(parts, "map", MapUpdateHeader)
    specs = (header.label, header.confidence, header.depth, header.moving)
    return header, check_buffers(parts, [s.bytes for s in specs if s is not None], header.name)


def _decode_map_update(header: MapUpdateHeader, buffers: Parts) -> MapUpdate:
    size, what = (header.height, header.width), header.name
    label, confidence, depth, *moving = buffers
    T = header.T_map_world
    return MapUpdate(
        label=decode_label(label, size, what),
        confidence=decode_confidence(header.confidence, confidence, size, what),
        depth_m=decode_depth(header.depth, depth, size, what),
        moving=decode_label(moving[0], size, what) > 0 if moving else None,
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
    parts = [
        topic_bytes("keyframe", frame.camera_id),
        _pack(header, KeyframeHeader, what),
        *encode_frame(frame, options)[1:],
    ]
    _check_keyframe_size(frame.intrinsics, parts, what)
    return parts


def _open_keyframe(parts: Parts) -> tuple[KeyframeHeader, tuple[FrameHeader, Parts]]:
    """Its header, and that of its frame with buffers."""
    header = _open(parts, "keyframe", KeyframeHeader)
    inner = [topic_bytes("frame", header.camera_id), *parts[2:]]
    if len(inner) < 2:
        raise CodecError(f"keyframe of camera '{header.camera_id}': has no frame")
    frame, buffers = _open_frame(inner)
    what = f"keyframe of camera '{frame.camera_id}' seq={frame.seq}"
    if frame.label is None:
        raise CodecError(f"{what}: has no label image")
    _check_keyframe_size(frame.intrinsics, parts, what)
    return header, (frame, buffers)


def _check_keyframe_size(lens: CameraIntrinsics, parts: Parts, what: str) -> None:
    """Refuse a keyframe that is too large as a whole, packed or unpacked: learners keep dozens of them."""
    width, height, size = lens.width, lens.height, sum(map(len, parts))
    if width * height > MAX_KEYFRAME_PIXELS:
        raise CodecError(f"{what}: image of {width}x{height}; a keyframe has at most {MAX_KEYFRAME_PIXELS} pixels")
    if size > MAX_KEYFRAME_BYTES:
        raise CodecError(f"{what}: {size} bytes in all; a keyframe has at most {MAX_KEYFRAME_BYTES}")


def _weights_name(update: WeightsUpdate) -> str:
    return f"weights {update.version} of '{update.node}'"


def _encode_weights(update: WeightsUpdate) -> list[bytes]:
    what = _weights_name(update)
    if len(update.data) > MAX_WEIGHTS_BYTES:
        raise CodecError(f"{what}: a file of {len(update.data)} bytes; at most {MAX_WEIGHTS_BYTES} can be sent")
    header = to_plain(update, what)
    _read(header, WeightsUpdate, what)
    packed = pack_header({**header, "bytes": len(update.data)}, what)
    return [topic_bytes("weights", update.node), packed, update.data]


def _open_weights(parts: Parts) -> WeightsUpdate:
    """In the header stands the size of the file; whether the file is that of the digest is not checked."""
    row, source = read_topic(parts)
    fields = unpack_header(parts[1], "weights message")
    size = check_header(fields.get("bytes"), cast("type[int]", _WeightsBytes), "weights message: bytes")
    (data,) = check_buffers(parts, [size], "weights message")
    update = _read({**fields, "bytes": bytes(data)}, WeightsUpdate, "weights message")
    _check_source(row, source, update)
    return update


def _encode_query(kind: str, message: Request | Answer, what: str) -> tuple[list[bytes], tuple[ArraySpec, ...]]:
    forms = array_forms(type(message))
    arrays: dict[str, NDArray[np.generic]] = {}
    specs: list[ArraySpec] = []
    buffers: list[bytes] = []
    for name, form in forms.items():
        if form.optional and getattr(message, name) is None:
            continue
        array = arrays[name] = np.ascontiguousarray(getattr(message, name), form.dtype)
        if array.nbytes > MAX_PART_BYTES:  # before it is copied; the rest is checked when all are there
            raise CodecError(f"{what}: {name} of {array.nbytes} bytes, at most {MAX_PART_BYTES} can be sent")
        data = array.tobytes()
        buffers.append(zstd_compress(data, _ZSTD_LEVEL) if form.is_compressed else data)
        specs.append(ArraySpec(array.shape, len(buffers[-1])))
    _check_specs(forms, specs, what)
    scalars = {name: getattr(message, name) for name in message.__struct_fields__ if name not in forms}
    header = to_plain({**scalars, "arrays": specs}, what)
    check_header({**header, **arrays}, type(message), what)
    _leave_out_zeros(header)
    return [kind.encode(), pack_header(header, what), *buffers], tuple(specs)


def _leave_out_zeros(header: dict[str, Any]) -> None:
    for name in _NOT_SENT_AS_0:
        if header.get(name, 1) in (0, None):
            del header[name]


def _query_kind(parts: Parts) -> str:
    if not 2 <= len(parts) <= MAX_PARTS:
        raise CodecError(f"a question or answer has 2 to {MAX_PARTS} parts, got {len(parts)}")
    return bytes(parts[0][:32]).decode("ascii", errors="replace")


def _open_query(parts: Parts, kind: type[object], what: str) -> tuple[dict[str, Any], tuple[ArraySpec, ...]]:
    """Fields of a header, and the forms of the arrays, which are checked."""
    fields, forms = unpack_header(parts[1], what), array_forms(kind)
    specs = check_header(fields.get("arrays", ()), tuple[ArraySpec, ...], f"{what}: arrays")
    _check_specs(forms, specs, what)
    if not forms.keys().isdisjoint(fields):
        raise CodecError(f"{what}: bad header: arrays travel in buffers")
    return fields, specs


def _decode_query(
    fields: Mapping[str, Any], specs: tuple[ArraySpec, ...], parts: Parts, kind: type[WireT], what: str
) -> WireT:
    """Fresh and writable arrays, whose sizes were checked by ``_check_specs``, in a question or answer."""
    forms = array_forms(kind)
    buffers = check_buffers(parts, [spec.bytes for spec in specs], what)
    arrays: dict[str, NDArray[np.generic]] = {}
    for (name, form), spec, buffer in zip(list(forms.items())[: len(specs)], specs, buffers, strict=True):
        data = zstd_decompress(buffer, math.prod(spec.shape), f"{what}: {name}") if form.is_compressed else buffer
        array = np.frombuffer(data, form.dtype).reshape(spec.shape)
        arrays[name] = array.astype(np.dtype(form.dtype).newbyteorder("="))
    return check_header({**fields, **arrays}, kind, what)


def _check_rows(specs: tuple[ArraySpec, ...], what: str) -> None:
    for spec in specs:
        if spec.shape[0] > MAX_REQUEST_ROWS:
            raise CodecError(f"{what}: {spec.shape[0]} rows; ask for at most {MAX_REQUEST_ROWS} at once")


def _check_specs(forms: Mapping[str, ArrayForm], specs: Sequence[ArraySpec], what: str) -> None:
    needed = sum(not form.optional for form in forms.values())
    if not needed <= len(specs) <= len(forms):
        raise CodecError(f"{what}: has the arrays {list(forms)}, got {len(specs)}")
    for (name, form), spec in zip(forms.items(), specs, strict=False):  # those that are left out stand last
        if len(spec.shape) != form.free + len(form.tail) or spec.shape[form.free :] != form.tail:
            raise CodecError(f"{what}: {name} of shape {spec.shape}, expected {('N',) * form.free + form.tail}")
        size = math.prod(spec.shape) * np.dtype(form.dtype).itemsize
        if size > MAX_PART_BYTES:
            raise CodecError(f"{what}: {name} of {size} bytes, at most {MAX_PART_BYTES} are accepted; ask for less")
        if not form.is_compressed and spec.bytes != size:
            raise CodecError(f"{what}: {name} of shape {spec.shape} has {size} bytes, the header means {spec.bytes}")
