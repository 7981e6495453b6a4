"""A client of Foxglove's websocket protocol (subprotocol foxglove.sdk.v1)."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Collection
from contextlib import ExitStack
from types import TracebackType
from typing import NamedTuple, Self

from websockets.sync.client import connect
from websockets.typing import Subprotocol

MESSAGE_DATA = 1  # opcode; then the subscription's id and the log time, little-endian, and the message


class Received(NamedTuple):
    """One message: its topic, log time in nanoseconds, and the encoded message itself."""

    topic: str
    log_time_ns: int
    data: bytes


class FoxgloveClient:
    """Subscribes to topics as soon as a server has them; a context manager.

    Args:
        url: Of the server, ``ws://127.0.0.1:8765``.
        topics: By name; None = all.
    """

    def __init__(self, url: str, topics: Collection[str] | None = None) -> None:
        self._topics = topics
        self._topic_of: dict[int, str] = {}  # by subscription
        self._end = ExitStack()
        opened = connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, compression=None)
        self._socket = self._end.enter_context(opened)

    def receive(self, timeout_s: float) -> Received | None:
        """The next message; None where none came in time."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                message = self._socket.recv(timeout=max(0.0, deadline - time.monotonic()))
            except TimeoutError:
                return None
            if isinstance(message, str):
                said = json.loads(message)
                if said["op"] == "advertise":
                    self._subscribe(said["channels"])
            elif message[0] == MESSAGE_DATA:
                subscription, log_time_ns = struct.unpack_from("<IQ", message, 1)
                return Received(self._topic_of[subscription], log_time_ns, message[13:])

    def close(self) -> None:
        """Disconnect."""
        self._end.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _subscribe(self, channels: list[dict[str, str]]) -> None:
        wanted = [c for c in channels if self._topics is None or c["topic"] in self._topics]
        subscriptions: list[dict[str, object]] = []
        for channel in wanted:
            number = len(self._topic_of)
            self._topic_of[number] = channel["topic"]
            subscriptions.append({"id": number, "channelId": channel["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
