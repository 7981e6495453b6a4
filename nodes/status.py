"""Publishing what a node says of itself."""

from __future__ import annotations

from typing import NamedTuple

import structlog

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import Publisher

_log = structlog.get_logger(__name__)


class PartStatus(NamedTuple):
    """What one part of a node says of itself: counts, and what does not work as it should."""

    counters: dict[str, int]
    warnings: tuple[str, ...] = ()


def publish_status(publisher: Publisher, status: Status, timeout_s: float = 30.0) -> None:
    """Publish a status; one that cannot be sent is no reason for a node to end.

    Args:
        publisher: Of the node.
        status: What it says.
        timeout_s: As of ``Publisher.publish``.

    Raises:
        TransportError: as of ``Publisher.publish``.
    """
    try:
        parts = encode(status)
    except CodecError as error:
        _log.error("status_not_reported", reason=str(error))
        return
    publisher.publish(parts, timeout_s)
