"""The one table of topics. A topic on the wire is ``name/source/``, so that a subscription matches whole words only."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.framing import MAX_PARTS, Parts
from semantic_mapper.transport.headers import SOURCE_PATTERN
from semantic_mapper.transport.messages import (
    EndOfStream,
    FrameRefused,
    LabelledKeyframe,
    Message,
    Status,
    StreamInfo,
    WeightsInUse,
    WeightsUpdate,
)
from semantic_mapper.types import MapUpdate, PosedFrame

MAX_TOPIC_BYTES = 96


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of message.

    Args:
        name: First word of the topic on the wire.
        message: Type of the decoded message.
        source: Field of the header that is the second word of the topic; empty where any sender may stand there.
        logged: Whether the recorder keeps it.
        nominal_hz: Usual rate, 0 = now and then.
        queue: "newest": an unread message gives way to a newer one of the same source; "all": nothing is dropped.
        latched: The last one is sent again to every new subscriber.
        closes: Topic of what it ends: its latched message comes after that one's, and holds until there is a new one.
    """

    name: str
    message: type[Message]
    source: str
    logged: bool
    nominal_hz: float
    queue: Literal["newest", "all"]
    latched: bool = False
    closes: str = ""


TOPICS = {
    topic.name: topic
    for topic in (
        Topic("info", StreamInfo, "", logged=True, nominal_hz=0, queue="all", latched=True),
        Topic("frame", PosedFrame, "camera_id", logged=True, nominal_hz=15, queue="newest"),
        Topic("end", EndOfStream, "source", logged=False, nominal_hz=0, queue="all", latched=True, closes="info"),
        Topic("map", MapUpdate, "camera_id", logged=False, nominal_hz=5, queue="newest"),
        Topic("refused", FrameRefused, "camera_id", logged=True, nominal_hz=0, queue="all"),
        Topic("status", Status, "node", logged=True, nominal_hz=1, queue="newest", latched=True),
        Topic("keyframe", LabelledKeyframe, "camera_id", logged=False, nominal_hz=0, queue="all"),
        Topic("weights", WeightsUpdate, "node", logged=False, nominal_hz=0, queue="all", latched=True),
        Topic("in_use", WeightsInUse, "node", logged=False, nominal_hz=0, queue="all", latched=True),
    )
}


def topic_bytes(name: str, source: str) -> bytes:
    """Topic as it stands on the wire, ``name/source/``.

    Raises:
        CodecError: the source has characters that a topic cannot hold.
    """
    if not re.match(SOURCE_PATTERN, source):
        raise CodecError(
            f"'{source}' cannot be the name of a camera or node: use 1 to 64 letters, digits and any of _ . : -"
        )
    return f"{name}/{source}/".encode()


def subscription(name: str, source: str | None = None) -> bytes:
    """Prefix that matches all messages of a topic, or those of one source."""
    return f"{name}/".encode() if source is None else topic_bytes(name, source)


def parse_topic(topic: bytes) -> tuple[Topic, str]:
    """Topic on the wire -> its row of the table and the source.

    Raises:
        CodecError: not one of ours.
    """
    if len(topic) <= MAX_TOPIC_BYTES:
        words = topic.decode("ascii", errors="replace").split("/")
        if len(words) == 3 and words[0] in TOPICS and re.match(SOURCE_PATTERN, words[1]) and not words[2]:
            return TOPICS[words[0]], words[1]
    raise CodecError(f"unknown topic {topic[:40]!r}; topics read '<name>/<source>/' with a name of {', '.join(TOPICS)}")


def read_topic(parts: Parts) -> tuple[Topic, str]:
    """Topic and source of a message.

    Raises:
        CodecError: too few or too many parts, or an unknown topic.
    """
    if not 2 <= len(parts) <= MAX_PARTS:
        raise CodecError(f"a message has 2 to {MAX_PARTS} parts, got {len(parts)}")
    return parse_topic(bytes(parts[0][: MAX_TOPIC_BYTES + 1]))
