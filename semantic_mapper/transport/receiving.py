"""Multipart messages taken off a socket with a limit to their parts and to the bytes in all of them.

A socket's MAXMSGSIZE bounds one part alone. ZeroMQ itself holds a message back until its last part has come, however
many there are; here no more of it is kept than any message of ours may have.
"""

from __future__ import annotations

from typing import cast

import zmq

from semantic_mapper.transport.framing import MAX_PARTS
from semantic_mapper.transport.headers import MAX_HEADER_BYTES
from semantic_mapper.transport.messages import MAX_KEYFRAME_BYTES, MAX_WEIGHTS_BYTES
from semantic_mapper.types import MAX_PIXELS

MAX_MESSAGE_BYTES = 10 * MAX_PIXELS + 2 * MAX_HEADER_BYTES  # a frame's colours, depth and labels, none packed
_OF_TOPIC = {"keyframe": MAX_KEYFRAME_BYTES, "weights": MAX_WEIGHTS_BYTES + 2 * MAX_HEADER_BYTES}


def max_bytes(topic: str) -> int:
    """What a message of a topic, or of one that begins so, may take, all of its parts together."""
    return _OF_TOPIC.get(topic.partition("/")[0], MAX_MESSAGE_BYTES)


def receive_bounded(
    socket: zmq.Socket[bytes], *, max_parts: int = MAX_PARTS, max_bytes: int = MAX_MESSAGE_BYTES, flags: int = 0
) -> tuple[list[bytes], str]:
    """The next message, all of which is taken off the socket.

    Returns:
        Its parts and an empty text; of a message beyond the limits those before the first that is too much, and why.

    Raises:
        zmq.Again: there is none, and the flags say not to wait.
    """
    parts: list[bytes] = []
    count = size = 0
    while not count or socket.getsockopt(zmq.RCVMORE):
        part = cast(bytes, socket.recv(flags))
        count, size = count + 1, size + len(part)
        if count <= max_parts and size <= max_bytes:
            parts.append(part)
    if len(parts) == count:
        return parts, ""
    return parts, f"{count} parts of {size} bytes in all; a message has at most {max_parts} and {max_bytes} bytes"
