"""Publishing: of what a node says of itself, and at a second endpoint for other programs and machines."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import structlog

from semantic_mapper.errors import CodecError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.keys import load_keys
from semantic_mapper.transport.messages import Buffer, NodeState, Status
from semantic_mapper.transport.sockets import Publisher

STATUS_PERIOD_S = 1.0

_log = structlog.get_logger(__name__)


class PartStatus(NamedTuple):
    """What one part of a node says of itself: counts, what does not work as it should, and ages in seconds."""

    counters: dict[str, int]
    warnings: tuple[str, ...] = ()
    ages_s: Mapping[str, float] = MappingProxyType({})


class StatusReport:
    """Publishes how a node of this name is, about once a second."""

    def __init__(self, node: str, publisher: Publisher) -> None:
        self._node = node
        self._publisher = publisher
        self._last = 0.0

    @property
    def due(self) -> bool:
        """Whether it is time to."""
        return time.monotonic() - self._last >= STATUS_PERIOD_S

    def publish(self, state: NodeState, *parts: PartStatus, timeout_s: float = 30.0) -> Status:
        """Publish it now, all parts together, as of ``Publisher.publish``; what was published. A status that cannot be
        sent is no reason for a node to end."""
        self._last = time.monotonic()
        counters = {name: count for part in parts for name, count in part.counters.items()}
        ages_s = {name: age for part in parts for name, age in part.ages_s.items()}
        warnings = tuple(warning for part in parts for warning in part.warnings if warning)
        status = Status(self._node, state, time.monotonic_ns(), counters, ages_s, warnings)
        try:
            self._publisher.publish(encode(status), timeout_s)
        except CodecError as error:
            _log.error("status_not_reported", reason=str(error))
        return status


class PublicPublisher(Publisher):
    """Sends every message to two endpoints; who does not keep up at the second one loses messages.

    The second one, ``public``, is ``ipc://PATH`` or ``tcp://ADDRESS:PORT`` (empty = none). With a folder of ``keys``,
    what goes out there is encrypted, and sent to its peers alone.
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
