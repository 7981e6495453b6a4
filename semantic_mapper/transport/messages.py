"""What travels besides ``PosedFrame`` and ``MapUpdate``. Plain data; ``codec`` turns it into bytes and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from semantic_mapper.labels import LabelSet
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

NodeState = Literal["starting", "running", "degraded", "stopping", "ended"]
EndReason = Literal["end", "stopped", "error"]


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """What a stream of frames is; sent before its first frame and kept in every log.

    Args:
        source: Where the frames come from, for people ("folder redkitchen", "OAK-D 18443010").
        cameras: Intrinsics of each camera by its id.
        label_set: Classes of the frames' label images; None for a stream without labels.
        frame_count: Frames that the source will send; None where nobody knows (a live camera).
        frame_hz: Nominal rate; 0 = not known.
        metadata: Anything else worth keeping, as text.
    """

    source: str
    cameras: Mapping[str, CameraIntrinsics] = field(default_factory=dict[str, CameraIntrinsics])
    label_set: LabelSet | None = None
    frame_count: int | None = None
    frame_hz: float = 0.0
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, slots=True)
class Status:
    """What a node says about itself, about once a second.

    Args:
        node: Name of the node.
        state: Where it is in its life.
        stamp_ns: When it said so, on the robot's monotonic clock.
        counters: Totals since its start ("fused", "dropped", "rejected", ...).
        ages_s: Seconds since something last happened ("frame", ...).
        degraded: One sentence for each thing that does not work as it should; empty when all is well.
    """

    node: str
    state: NodeState
    stamp_ns: int
    counters: Mapping[str, int] = field(default_factory=dict[str, int])
    ages_s: Mapping[str, float] = field(default_factory=dict[str, float])
    degraded: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FrameRefused:
    """The mapper's answer to a frame that it could not use, in place of a ``MapUpdate``."""

    stamp_ns: int
    seq: int
    camera_id: str
    reason: str


@dataclass(frozen=True, slots=True)
class EndOfStream:
    """The last message of a stream of frames.

    Args:
        source: Who ends ("player", a camera id, ...).
        reason: "end" of the recording, "stopped" by a person, or an "error".
        published: Frames that were sent.
        detail: The error, for people.
        damages: What could not be read of a recording, in words; the first few.
        unreadable: How many frames of a recording could not be read, and were not sent; ``damages`` begins with them.
    """

    source: str
    reason: EndReason
    published: int
    detail: str = ""
    damages: tuple[str, ...] = ()
    unreadable: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LabelledKeyframe:
    """A frame with labels to learn from.

    Args:
        frame: With a label image.
        label_set: What its ids mean.
        teacher: Who labelled it, for people ("label tool", "log kitchen.mcap").
    """

    frame: PosedFrame
    label_set: LabelSet
    teacher: str = ""


@dataclass(frozen=True, slots=True)
class WeightsUpdate:
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

    node: str
    version: int
    data: bytes
    digest: str
    parent: str
    score: float
    parent_score: float
    keyframes: int
    held_out: int


@dataclass(frozen=True, slots=True)
class WeightsInUse:
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

    node: str
    version: int
    digest: str
    newest: int = 0
    judged: int = 0
    accepted: bool = False
    reason: str = ""
    rolled_back: int = 0
    contradicts: bool = False


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
