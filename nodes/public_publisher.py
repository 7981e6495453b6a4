"""A node's publisher that can also be subscribed to at a fixed endpoint, by other programs and machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semantic_mapper.transport.keys import load_keys
from semantic_mapper.transport.messages import Buffer
from semantic_mapper.transport.sockets import Publisher


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
