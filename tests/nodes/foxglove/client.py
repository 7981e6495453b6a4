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
        self._channels: list[int] = []  # likewise, the server's numbers
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
                elif said["op"] == "status" and "Unknown channel" in said["message"]:
                    # the SDK advertises a channel an instant before a client may subscribe to it
                    self._ask(int(said["message"].rsplit(maxsplit=1)[1]))
            elif message[0] == MESSAGE_DATA:
                subscription, log_time_ns = struct.unpack_from("<IQ", message, 1)
                return Received(self._topic_of[subscription], log_time_ns, message[13:])

    def _subscribe(self, channels: list[dict[str, str]]) -> None:
        wanted = [c for c in channels if self._topics is None or c["topic"] in self._topics]
        first = len(self._channels)
        self._topic_of += [channel["topic"] for channel in wanted]
        self._channels += [int(channel["id"]) for channel in wanted]
        self._ask(*self._channels[first:])

    def _ask(self, *channels: int) -> None:
        wanted = [{"id": self._channels.index(channel), "channelId": channel} for channel in channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
