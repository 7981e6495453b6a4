"""Publishing what a node says of itself."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple

import structlog

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import NodeState, Status
from semantic_mapper.transport.sockets import Publisher

STATUS_PERIOD_S = 1.0

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


class StatusReport:
    """Publishes how a node is, about once a second.

    Args:
        node: Its name.
        publisher: Where.
    """

    def __init__(self, node: str, publisher: Publisher) -> None:
        self._node = node
        self._publisher = publisher
        self._last = 0.0

    @property
    def due(self) -> bool:
        """Whether it is time to."""
        return time.monotonic() - self._last >= STATUS_PERIOD_S

    def publish(
        self, state: NodeState, counters: Mapping[str, int], ages_s: Mapping[str, float], degraded: tuple[str, ...]
    ) -> Status:
        """Publish it now; what was published."""
        self._last = time.monotonic()
        status = Status(self._node, state, time.monotonic_ns(), dict(counters), dict(ages_s), degraded)
        publish_status(self._publisher, status)
        return status
