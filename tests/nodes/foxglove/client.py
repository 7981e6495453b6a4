"""A client of Foxglove's websocket protocol (subprotocol foxglove.sdk.v1)."""

import json
import struct
import time
from collections.abc import Collection
from contextlib import ExitStack
from typing import NamedTuple

from websockets.sync.client import connect
from websockets.typing import Subprotocol

MESSAGE_DATA = 1  # opcode; then the subscription's id and the log time, little-endian, and the message


class Received(NamedTuple):
    """One message: its topic, log time in nanoseconds, and the encoded message itself."""

    topic: str
    log_time_ns: int
    data: bytes


class FoxgloveClient(ExitStack):
    """Subscribes to topics (None = all) as soon as a server has them; a context manager."""

    def __init__(self, url: str, topics: Collection[str] | None = None) -> None:
        super().__init__()
        self._topics = topics
        self._topic_of: list[str] = []  # by subscription
        self._channels: list[int] = []  # likewise, the server's numbers, which are consecutive
        self._asked_ahead = 0
        opened = connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, compression=None)
        self._socket = self.enter_context(opened)

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

    def ask_ahead(self) -> None:
        """Subscribe, once, to the next channel before it can be: as a client does that is too quick for the SDK."""
        self._asked_ahead = max(self._channels) + 1
        self._ask(99, self._asked_ahead)

    def _subscribe(self, channels: list[dict[str, str]]) -> None:
        for channel in channels:
            number = int(channel["id"])
            if (self._topics is None or channel["topic"] in self._topics) and number != self._asked_ahead:
                self._ask(len(self._channels), number)
                self._topic_of.append(channel["topic"])
                self._channels.append(number)

    def _ask(self, subscription: int, channel: int) -> None:
        wanted = [{"id": subscription, "channelId": channel}]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
