"""What travels: limits, types of header fields, one struct a message, and the one table of topics.

``codec`` makes bytes of messages. ``PosedFrame`` and ``MapUpdate`` are messages, too; they are core types
(``semantic_mapper.types``). Bounds are checked when a message is sent and when one is received. A topic on the wire is
``name/source/``, so that a subscription matches whole words only.
"""

import hashlib
import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from semantic_mapper.errors import CodecError
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import MAX_PIXELS, MAX_SIDE, MAX_STAMP_NS, CameraIntrinsics, MapUpdate, PosedFrame

Buffer = bytes | bytearray | memoryview
Parts = Sequence[Buffer]

MAX_PARTS = 8
MAX_KEYFRAME_PIXELS = 1 << 23  # 4096 x 2048: dozens of them are kept while a finetuner learns
MAX_PART_BYTES = 4 * MAX_PIXELS + (1 << 16)  # one float32 image and some room for a codec's overhead
MAX_HEADER_BYTES = 1 << 18
MAX_TOPIC_BYTES = 96
MAX_ENTRIES = 1024  # of one list in a header

SOURCE_PATTERN = r"^[A-Za-z0-9_.:-]{1,64}\Z"  # camera ids and node names, as they stand in topics
Source = Annotated[str, Meta(pattern=SOURCE_PATTERN)]
Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
CaptureStamp = Annotated[int, Meta(ge=0, le=MAX_STAMP_NS)]
MAX_COUNT = 2**63 - 1
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
PartBytes = Annotated[int, Meta(ge=0, le=MAX_PART_BYTES)]
Word = Annotated[str, Meta(max_length=128)]
Sentence = Annotated[str, Meta(max_length=4096)]
ClassId = Annotated[int, Meta(ge=0, le=255)]
Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256
# Every number of a header is of this type or has bounds of its own: NaN and infinity are refused by comparison.
Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
UnitInterval = Annotated[float, Meta(ge=0, le=1)]

NodeState = Literal["starting", "running", "degraded", "stopping", "ended"]
EndReason = Literal["end", "stopped", "error"]

MAX_DAMAGES = 50  # damaged places of a recording that its end tells of
MAX_KEYFRAME_BYTES = 8 * MAX_KEYFRAME_PIXELS + 2 * MAX_HEADER_BYTES  # raw colour, float32 depth, labels: all of it
MAX_WEIGHTS_BYTES = 1 << 26  # of a weights file on the wire: five times the shipped one
_SENTENCE = 4096  # letters; longer ones are cut
_WORD = 128
_MAX_NUMBERS, _MAX_SENTENCES = 256, 64  # of a status
# Metadata of a stream whose lengths are not metres, as poses from pictures alone give them; without it they are.
SCALE_KEY, SCALE_UNKNOWN = "scale", "unknown"
SCENE_DEPTH_KEY = "scene_depth"  # median depth of what poses from pictures were found by, in the unit of the poses


class Wire(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all structs that travel."""


class ClassForm(Wire, frozen=True):
    """One class of a label set."""

    id: ClassId
    name: Word
    color: tuple[ClassId, ClassId, ClassId]


class LabelSetForm(Wire, frozen=True):
    """``LabelSet`` in a header."""

    name: Word
    classes: Annotated[tuple[ClassForm, ...], Meta(min_length=1, max_length=256)]
    ignore_id: ClassId

    @classmethod
    def of(cls, labels: LabelSet) -> "LabelSetForm":
        """A label set as it travels."""
        classes = tuple(map(ClassForm, labels.ids, labels.names, labels.colors))
        return cls(labels.name, classes, labels.ignore_id)

    def to_label_set(self) -> LabelSet:
        """The core type; ``LabelError`` where a class or id stands twice, or a class is the ignore id."""
        ids, names, colors = zip(*((c.id, c.name, c.color) for c in self.classes), strict=True)
        return LabelSet(self.name, ids, names, colors, self.ignore_id)


class StreamInfo(Wire, frozen=True):
    """What a stream of frames is; sent before its first frame and kept in every log."""

    source: Sentence  # where the frames come from, for people ("folder redkitchen", "OAK-D 18443010")
    # intrinsics of each camera by its id
    cameras: Annotated[Mapping[Source, CameraIntrinsics], Meta(max_length=64)] = msgspec.field(default_factory=dict)
    label_set: LabelSet | None = None  # classes of the frames' label images; None for a stream without labels
    frame_count: Count | None = None  # frames that the source will send; None where nobody knows (a live camera)
    frame_hz: Annotated[float, Meta(ge=0, le=1e6)] = 0.0  # nominal rate; 0 = not known
    # anything else worth keeping, as text
    metadata: Annotated[Mapping[Word, Sentence], Meta(max_length=64)] = msgspec.field(default_factory=dict)

    @property
    def scale_known(self) -> bool:
        """Whether lengths are metres."""
        return self.metadata.get(SCALE_KEY) != SCALE_UNKNOWN


class Status(Wire, frozen=True):
    """What a node says about itself, about once a second.

    Numbers beyond their bounds become the nearest one that can be sent, and what is too long or too much is cut, so
    that nothing that a node counts can keep it from saying so.
    """

    node: Source  # name of the node
    state: NodeState  # where it is in its life
    stamp_ns: Stamp  # when it said so, on the robot's monotonic clock
    # totals since its start ("fused", "dropped", "rejected", ...)
    counters: Annotated[Mapping[Word, Count], Meta(max_length=_MAX_NUMBERS)] = msgspec.field(default_factory=dict)
    # seconds since something last happened ("frame", ...)
    ages_s: Annotated[Mapping[Word, Finite], Meta(max_length=_MAX_NUMBERS)] = msgspec.field(default_factory=dict)
    # one sentence for each thing that does not work as it should; empty when all is well
    degraded: Annotated[tuple[Sentence, ...], Meta(max_length=_MAX_SENTENCES)] = ()

    def __post_init__(self) -> None:
        most = sys.float_info.max
        counters = [(_sendable(name, _WORD), min(max(n, 0), MAX_COUNT)) for name, n in self.counters.items()]
        ages = [
            (_sendable(name, _WORD), min(max(age, -most), most))
            for name, age in self.ages_s.items()
            if not math.isnan(age)
        ]
        force_setattr(self, "counters", dict(counters[:_MAX_NUMBERS]))
        force_setattr(self, "ages_s", dict(ages[:_MAX_NUMBERS]))
        force_setattr(self, "degraded", tuple(_sendable(text, _SENTENCE) for text in self.degraded[:_MAX_SENTENCES]))


class FrameRefused(Wire, frozen=True):
    """The mapper's answer to a frame that it could not use, in place of a ``MapUpdate``."""

    stamp_ns: Stamp
    seq: Count
    camera_id: Source
    reason: Sentence

    def __post_init__(self) -> None:
        force_setattr(self, "reason", self.reason[:_SENTENCE])


class EndOfStream(Wire, frozen=True):
    """The last message of a stream of frames."""

    source: Source  # who ends ("player", a camera id, ...)
    reason: EndReason  # "end" of the recording, "stopped" by a person, or an "error"
    published: Count  # frames that were sent
    detail: Sentence = ""  # the error, for people
    # what could not be read of a recording, in words; the first few
    damages: Annotated[tuple[Sentence, ...], Meta(max_length=MAX_DAMAGES)] = ()
    # how many frames of a recording could not be read, and were not sent; ``damages`` begins with them
    unreadable: Count = 0

    def __post_init__(self) -> None:
        force_setattr(self, "detail", self.detail[:_SENTENCE])
        force_setattr(self, "damages", tuple(text[:1024] for text in self.damages[:MAX_DAMAGES]))


class LabelledKeyframe(Wire, frozen=True, eq=False):
    """A frame with labels to learn from."""

    frame: PosedFrame  # with a label image
    label_set: LabelSet  # what its ids mean
    teacher: Word = ""  # who labelled it, for people ("label tool", "log kitchen.mcap")

    @property
    def camera_id(self) -> str:
        """Of the frame."""
        return self.frame.camera_id

    def __post_init__(self) -> None:
        force_setattr(self, "teacher", self.teacher[:_WORD])


class WeightsUpdate(Wire, frozen=True):
    """Weights that a learner offers to a mapper."""

    node: Source  # the learner
    version: Annotated[int, Meta(ge=1, le=2**31)]  # higher than that of all before it
    # a whole weights file (safetensors), never a pickle
    data: Annotated[bytes, Meta(min_length=1, max_length=MAX_WEIGHTS_BYTES)] = msgspec.field(name="bytes")
    digest: Digest  # SHA-256 of ``data``, hexadecimal
    parent: Digest  # digest of the weights that it was found better than; a mapper that uses others does not take it
    # score, parent_score: mIoU over rays of the held-out keyframes, in 0..1, with these weights and with the parent.
    score: UnitInterval
    parent_score: UnitInterval
    # keyframes, held_out: How many it learned from, and how many it was judged by.
    keyframes: Count
    held_out: Count


class WeightsInUse(Wire, frozen=True):
    """What weights a mapper uses, and what became of the last ones that it was offered."""

    node: Source  # the mapper
    version: Count  # in use; 0 = those that it was started with
    digest: Digest  # SHA-256 of the file in use, hexadecimal
    newest: Count = 0  # the highest version that it has been offered
    judged: Count = 0  # the version that it was offered last; 0 = none yet
    accepted: bool = False  # whether that one was taken
    reason: Sentence = ""  # why it was not, for people
    # whether it was not taken because it contradicts the map, rather than for any other reason
    contradicts: bool = False

    def __post_init__(self) -> None:
        force_setattr(self, "reason", self.reason[:_SENTENCE])


Message = (
    PosedFrame
    | MapUpdate
    | FrameRefused
    | Status
    | StreamInfo
    | EndOfStream
    | LabelledKeyframe
    | WeightsUpdate
    | WeightsInUse
)


def _sendable(text: str, length: int) -> str:
    """Cut, and without what is no UTF-8, such as the odd bytes of a file's name."""
    return text[:length].encode(errors="replace").decode()


def digest_of(data: Buffer) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of message."""

    name: str  # first word of the topic on the wire
    message: type[Message]  # type of the decoded message
    source: str  # field of the header that is the second word of the topic; empty where any sender may stand there
    logged: bool  # whether the recorder keeps it
    # "newest": an unread message gives way to a newer one of the same source; "all": nothing is dropped
    queue: Literal["newest", "all"]
    latched: bool = False  # the last one is sent again to every new subscriber
    # topic of what it ends: its latched message comes after that one's, and holds until there is a new one
    closes: str = ""


TOPICS = {
    topic.name: topic
    for topic in (
        Topic("info", StreamInfo, "", logged=True, queue="all", latched=True),
        Topic("frame", PosedFrame, "camera_id", logged=True, queue="newest"),
        Topic("end", EndOfStream, "source", logged=False, queue="all", latched=True, closes="info"),
        Topic("map", MapUpdate, "camera_id", logged=False, queue="newest"),
        Topic("refused", FrameRefused, "camera_id", logged=True, queue="all"),
        Topic("status", Status, "node", logged=True, queue="newest", latched=True),
        Topic("keyframe", LabelledKeyframe, "camera_id", logged=False, queue="all"),
        Topic("weights", WeightsUpdate, "node", logged=False, queue="all", latched=True),
        Topic("in_use", WeightsInUse, "node", logged=False, queue="all", latched=True),
    )
}


def topic_bytes(name: str, source: str) -> bytes:
    """Topic as it stands on the wire, ``name/source/``; ``CodecError`` where it cannot hold the source's letters."""
    if not re.match(SOURCE_PATTERN, source):
        raise CodecError(
            f"'{source}' cannot be the name of a camera or node: use 1 to 64 letters, digits and any of _ . : -"
        )
    return f"{name}/{source}/".encode()


def subscription(name: str, source: str | None = None) -> bytes:
    """Prefix that matches all messages of a topic, or those of one source."""
    return f"{name}/".encode() if source is None else topic_bytes(name, source)


def parse_topic(topic: Buffer) -> tuple[Topic, str]:
    """Topic on the wire -> its row of the table and the source; ``CodecError`` where it is not one of ours."""
    start = bytes(topic[: MAX_TOPIC_BYTES + 1])
    name, _, rest = start.decode("ascii", errors="replace").partition("/")
    if len(start) <= MAX_TOPIC_BYTES and name in TOPICS and rest.endswith("/") and re.match(SOURCE_PATTERN, rest[:-1]):
        return TOPICS[name], rest[:-1]
    raise CodecError(f"unknown topic {start[:40]!r}; topics read '<name>/<source>/' with a name of {', '.join(TOPICS)}")


def read_topic(parts: Parts) -> tuple[Topic, str]:
    """Topic and source of a message; ``CodecError`` where it has too few or too many parts, or an unknown topic."""
    if not 2 <= len(parts) <= MAX_PARTS:
        raise CodecError(f"a message has 2 to {MAX_PARTS} parts, got {len(parts)}")
    return parse_topic(parts[0])
