"""What travels on topics: one struct a message, whose types say what its fields may hold. ``codec`` makes bytes of it.

``PosedFrame`` and ``MapUpdate`` travel, too; they are core types (``semantic_mapper.types``). Bounds are checked when a
message is sent and when one is received.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Mapping
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.framing import MAX_KEYFRAME_PIXELS, Buffer
from semantic_mapper.transport.headers import (
    MAX_COUNT,
    MAX_HEADER_BYTES,
    Count,
    Digest,
    Finite,
    Sentence,
    Source,
    Stamp,
    UnitInterval,
    Wire,
    Word,
)
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

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


class StreamInfo(Wire, frozen=True):
    """What a stream of frames is; sent before its first frame and kept in every log.

    Args:
        source: Where the frames come from, for people ("folder redkitchen", "OAK-D 18443010").
        cameras: Intrinsics of each camera by its id.
        label_set: Classes of the frames' label images; None for a stream without labels.
        frame_count: Frames that the source will send; None where nobody knows (a live camera).
        frame_hz: Nominal rate; 0 = not known.
        metadata: Anything else worth keeping, as text.
    """

    source: Sentence
    cameras: Annotated[Mapping[Source, CameraIntrinsics], Meta(max_length=64)] = msgspec.field(default_factory=dict)
    label_set: LabelSet | None = None
    frame_count: Count | None = None
    frame_hz: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    metadata: Annotated[Mapping[Word, Sentence], Meta(max_length=64)] = msgspec.field(default_factory=dict)

    @property
    def scale_known(self) -> bool:
        """Whether lengths are metres."""
        return self.metadata.get(SCALE_KEY) != SCALE_UNKNOWN


class Status(Wire, frozen=True):
    """What a node says about itself, about once a second.

    Numbers beyond their bounds become the nearest one that can be sent, and what is too long or too much is cut, so
    that nothing that a node counts can keep it from saying so.

    Args:
        node: Name of the node.
        state: Where it is in its life.
        stamp_ns: When it said so, on the robot's monotonic clock.
        counters: Totals since its start ("fused", "dropped", "rejected", ...).
        ages_s: Seconds since something last happened ("frame", ...).
        degraded: One sentence for each thing that does not work as it should; empty when all is well.
    """

    node: Source
    state: NodeState
    stamp_ns: Stamp
    counters: Annotated[Mapping[Word, Count], Meta(max_length=_MAX_NUMBERS)] = msgspec.field(default_factory=dict)
    ages_s: Annotated[Mapping[Word, Finite], Meta(max_length=_MAX_NUMBERS)] = msgspec.field(default_factory=dict)
    degraded: Annotated[tuple[Sentence, ...], Meta(max_length=_MAX_SENTENCES)] = ()

    def __post_init__(self) -> None:
        counters = [(_sendable(name, _WORD), min(max(n, 0), MAX_COUNT)) for name, n in self.counters.items()]
        ages = [(_sendable(name, _WORD), _finite(age)) for name, age in self.ages_s.items() if not math.isnan(age)]
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
    """The last message of a stream of frames.

    Args:
        source: Who ends ("player", a camera id, ...).
        reason: "end" of the recording, "stopped" by a person, or an "error".
        published: Frames that were sent.
        detail: The error, for people.
        damages: What could not be read of a recording, in words; the first few.
        unreadable: How many frames of a recording could not be read, and were not sent; ``damages`` begins with them.
    """

    source: Source
    reason: EndReason
    published: Count
    detail: Sentence = ""
    damages: Annotated[tuple[Sentence, ...], Meta(max_length=MAX_DAMAGES)] = ()
    unreadable: Count = 0

    def __post_init__(self) -> None:
        force_setattr(self, "detail", self.detail[:_SENTENCE])
        force_setattr(self, "damages", tuple(text[:1024] for text in self.damages[:MAX_DAMAGES]))


class LabelledKeyframe(Wire, frozen=True, eq=False):
    """A frame with labels to learn from.

    Args:
        frame: With a label image.
        label_set: What its ids mean.
        teacher: Who labelled it, for people ("label tool", "log kitchen.mcap").
    """

    frame: PosedFrame
    label_set: LabelSet
    teacher: Word = ""

    def __post_init__(self) -> None:
        force_setattr(self, "teacher", self.teacher[:128])


class WeightsUpdate(Wire, frozen=True):
    """Weights that a learner offers to a mapper.

    Args:
        node: The learner.
        version: Higher than that of all before it.
        data: A whole weights file (safetensors), never a pickle.
        digest: SHA-256 of ``data``, hexadecimal.
        parent: Digest of the weights that it was found better than; a mapper that uses others does not take it.
        score, parent_score: mIoU over rays of the held-out keyframes, in 0..1, with these weights and with the parent.
        keyframes, held_out: How many it learned from, and how many it was judged by.
    """

    node: Source
    version: Annotated[int, Meta(ge=1, le=2**31)]
    data: Annotated[bytes, Meta(min_length=1, max_length=MAX_WEIGHTS_BYTES)] = msgspec.field(name="bytes")
    digest: Digest
    parent: Digest
    score: UnitInterval
    parent_score: UnitInterval
    keyframes: Count
    held_out: Count


class WeightsInUse(Wire, frozen=True):
    """What weights a mapper uses, and what became of the last ones that it was offered.

    Args:
        node: The mapper.
        version: In use; 0 = those that it was started with.
        digest: SHA-256 of the file in use, hexadecimal.
        newest: The highest version that it has been offered.
        judged: The version that it was offered last; 0 = none yet.
        accepted: Whether that one was taken.
        reason: Why it was not, for people.
        rolled_back: How often somebody has asked for other weights.
        contradicts: Whether it was not taken because it contradicts the map, rather than for any other reason.
    """

    node: Source
    version: Count
    digest: Digest
    newest: Count = 0
    judged: Count = 0
    accepted: bool = False
    reason: Sentence = ""
    rolled_back: Count = 0
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


def _finite(number: float) -> float:
    return min(max(number, -sys.float_info.max), sys.float_info.max)


def digest_of(data: Buffer) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(data).hexdigest()
