"""What a node publishes: to its launch and to others, and what it says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import structlog

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.keys import load_keys
from semantic_mapper.transport.messages import Buffer, Status
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


class PublicPublisher(Publisher):
    """Sends every message to two endpoints; who does not keep up at the second one loses messages.

    Args:
        endpoint: Of the node, among those of its launch.
        public: The fixed one, ``ipc://PATH`` or ``tcp://ADDRESS:PORT``; empty = none.
        keys: Folder of keys: what goes out there is encrypted, and sent to its peers alone; empty = none.
        linger_ms: See ``Publisher``.

    Raises:
        TransportError: see ``Publisher``; other machines could reach the second one, and there are no keys.
    """

    def __init__(self, endpoint: str, public: str, keys: str, *, linger_ms: int = 2000) -> None:
        self._public: Publisher | None = None
        if public:
            known = load_keys(Path(keys).expanduser()) if keys else None
            self._public = Publisher(public, keys=known, linger_ms=linger_ms)
        try:
            super().__init__(endpoint, linger_ms=linger_ms)
        except BaseException:
            if self._public is not None:
                self._public.close()
            raise

    @property
    def public_endpoint(self) -> str:
        """The second endpoint as ZeroMQ names it; empty = none."""
        return "" if self._public is None else self._public.endpoint

    def publish(self, parts: Sequence[Buffer], timeout_s: float = 30.0) -> None:
        """As of ``Publisher``."""
        super().publish(parts, timeout_s)
        if self._public is not None:
            self._public.publish(parts, timeout_s)

    def close(self) -> None:
        """As of ``Publisher``."""
        super().close()
        if self._public is not None:
            self._public.close()
