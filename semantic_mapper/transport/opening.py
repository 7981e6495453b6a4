"""First steps of decoding, the same for every message: number of parts, topic, header, sizes of the buffers."""

from __future__ import annotations

from collections.abc import Sequence

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.framing import MAX_PARTS, Buffer
from semantic_mapper.transport.headers import HeaderT, unpack_header
from semantic_mapper.transport.topics import parse_topic

Parts = Sequence[Buffer]


def message_name(kind: str, source: str, seq: int) -> str:
    """How errors call a message."""
    return f"{kind} of camera '{source}' seq={seq}"


def topic_name(parts: Parts) -> str:
    """Name of the topic of a message.

    Raises:
        CodecError: too few or too many parts, or a topic that is none of ours.
    """
    if not 2 <= len(parts) <= MAX_PARTS:
        raise CodecError(f"a message has 2 to {MAX_PARTS} parts, got {len(parts)}")
    if len(parts[0]) > 1024:
        raise CodecError(f"topic of {len(parts[0])} bytes is none of ours")
    topic, _ = parse_topic(bytes(parts[0]))
    return topic.name


def open_header(parts: Parts, name: str, kind: type[HeaderT]) -> HeaderT:
    """Header of a message that must be of topic ``name``; its buffers are left alone.

    Raises:
        CodecError: another topic, or a bad header.
    """
    actual = topic_name(parts)
    if actual != name:
        raise CodecError(f"expected a message of topic '{name}', got '{actual}'")
    return unpack_header(parts[1], kind, f"{name} message")


def open_plain(parts: Parts, name: str, kind: type[HeaderT]) -> HeaderT:
    """Header of a message without buffers.

    Raises:
        CodecError: another topic, a bad header, or buffers.
    """
    header = open_header(parts, name, kind)
    if len(parts) != 2:
        raise CodecError(f"{name} message: has no buffers, got {len(parts) - 2}")
    return header


def check_source(parts: Parts, source: str) -> None:
    """Refuse a message whose topic names another source than its header.

    Raises:
        CodecError: naming both.
    """
    _, in_topic = parse_topic(bytes(parts[0]))
    if in_topic != source:
        raise CodecError(f"topic {bytes(parts[0])!r} carries a message of '{source}'")


def open_buffers(parts: Parts, sizes: list[int], what: str) -> Parts:
    """Buffers of a message, which must have the sizes that its header announces.

    Raises:
        CodecError: naming both.
    """
    actual = [len(p) for p in parts[2:]]
    if actual != sizes:
        raise CodecError(f"{what}: the header announces buffers of {sizes} bytes, got {actual}")
    return parts[2:]
