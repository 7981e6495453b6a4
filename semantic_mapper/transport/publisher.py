"""The sending end of a topic: an XPUB socket that knows its subscribers."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Literal

import zmq

from semantic_mapper.errors import CodecError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.endpoints import EndpointLock, bind, check_bind
from semantic_mapper.transport.framing import Buffer
from semantic_mapper.transport.security import Keys, secure_server
from semantic_mapper.transport.topics import TOPICS, Topic, subscription

SYNC_PREFIX = b"sync/"  # a subscription to sync/TOKEN/ is answered by that very topic: "I have heard you"
_PUMP_PERIOD_S = 0.02
_SEND_SLICE_MS = 100
_LATE_S = 0.1  # subscriptions of one socket come in no order; an end must not arrive before what it ends
_MAX_SUBSCRIPTIONS = 4096  # what a stranger's subscriptions may cost us
_MAX_EVENTS = 256  # heard at a time: a stranger who subscribes without end must not hold up what is published

log = get_logger(__name__)


class Publisher:
    """Binds an endpoint and sends encoded messages to whoever subscribes. Any thread may call any method.

    Args:
        endpoint: ``ipc://PATH`` or ``tcp://ADDRESS:PORT`` (``*`` as port: any free one, see ``endpoint``).
        policy: Toward a subscriber that does not keep up. "drop" (live): it loses messages. "block" (replay,
            recording): ``publish`` waits for it, so that nothing is lost.
        hwm: Messages that may wait for each subscriber.
        keys: Encrypt, and let in only their peers; needed where other machines could connect.
        linger_ms: How long ``close`` waits for the last messages to be delivered.

    Raises:
        TransportError: the endpoint is taken, cannot be bound, or could be reached from other machines and there are
            no keys.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        policy: Literal["drop", "block"] = "drop",
        hwm: int = 16,
        linger_ms: int = 2000,
        keys: Keys | None = None,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
    ) -> None:
        check_bind(endpoint, keys)
        self._endpoint_lock = EndpointLock(endpoint)
        self._mutex = threading.Lock()  # a zmq socket may change threads only across a memory barrier
        self._counts: Counter[bytes] = Counter()
        self._latched: dict[bytes, list[Buffer]] = {}
        self._late: dict[bytes, float] = {}  # latched ends that newcomers get yet, and when
        self._owed: list[Sequence[Buffer]] = []  # answers to subscriptions that found a full queue
        self._closed = threading.Event()
        self.published = 0
        self._socket = (context or zmq.Context.instance()).socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, linger_ms)
        self._socket.setsockopt(zmq.SNDHWM, hwm)
        self._socket.setsockopt(zmq.SNDTIMEO, _SEND_SLICE_MS)
        self._socket.setsockopt(zmq.MAXMSGSIZE, 1024)  # subscribers send nothing but subscriptions
        self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)  # tell of every (un)subscription, so that they can be counted
        self._socket.setsockopt(zmq.XPUB_NODROP, int(policy == "block"))
        if keys is not None:
            secure_server(self._socket, keys)
        self.endpoint = bind(self._socket, endpoint, self._endpoint_lock)
        self._pump_thread = threading.Thread(target=self._pump, name=f"publisher {endpoint}", daemon=True)
        self._pump_thread.start()

    def publish(self, parts: Sequence[Buffer], timeout_s: float = 30.0) -> None:
        """Send one encoded message. The parts must not be changed afterwards.

        Raises:
            TransportError: closed; or policy "block" and a subscriber did not make room within ``timeout_s``.
            CodecError: fewer than two parts.
        """
        if len(parts) < 2:
            raise CodecError(f"a message has at least topic and header, got {len(parts)} parts")
        topic = bytes(parts[0])
        deadline = time.monotonic() + timeout_s
        while True:
            with self._mutex:
                self._check_open()
                self._drain()
                if self._try_send(parts):
                    self.published += 1
                    self._latch(topic, parts)
                    return
            self._closed.wait(0.001)  # let other threads have the socket
            if time.monotonic() > deadline:
                with self._mutex:
                    self._latch(topic, parts)  # who comes later, or is reminded, gets it yet
                raise TransportError(
                    f"{self.endpoint}: a subscriber of {topic.decode(errors='replace')} has taken nothing for "
                    f"{timeout_s:g} s; it hangs or is too slow for a lossless stream"
                )

    def remind(self, name: str) -> None:
        """Send the latched messages of a topic once more, for those who had no room for them; waits for nobody."""
        with self._mutex:
            self._check_open()
            self._drain()
            for topic, parts in self._latched.items():
                if topic.startswith(subscription(name)):
                    self._try_send(parts, zmq.NOBLOCK)

    def subscribers(self, name: str, source: str | None = None) -> int:
        """How many subscriptions a message of this topic reaches."""
        topic = subscription(name, source)
        with self._mutex:
            self._check_open()
            self._drain()
            return sum(count for prefix, count in self._counts.items() if topic.startswith(prefix))

    def wait_for_subscribers(self, name: str, count: int = 1, timeout_s: float = 10.0) -> None:
        """Block until ``count`` subscriptions to topic ``name`` have arrived, so that no one misses the first message.

        Raises:
            TransportError: too few within ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while (there := self.subscribers(name)) < count:
            if time.monotonic() > deadline:
                raise TransportError(
                    f"{self.endpoint}: {there} of {count} subscribers of '{name}' after {timeout_s:g} s; "
                    "is the other node running, and does it connect to this endpoint?"
                )
            self._closed.wait(0.005)

    def close(self) -> None:
        """Deliver what is still waiting (at most ``linger_ms``), then free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._pump_thread.join()
        with self._mutex:
            self._socket.close()
        self._endpoint_lock.release()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise TransportError(f"{self.endpoint}: the publisher is closed")

    def _pump(self) -> None:
        """Hear subscriptions also while nothing is published."""
        while not self._closed.wait(_PUMP_PERIOD_S):
            with self._mutex:
                self._drain()

    def _drain(self) -> None:
        owed, self._owed = self._owed, []
        for parts in owed:
            self._answer(parts)
        self._answer_late()
        for _ in range(_MAX_EVENTS):
            try:
                event = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            if event[:1] == b"\x01":
                self._on_subscribed(event[1:])
            elif event[:1] == b"\x00":
                self._counts[event[1:]] -= 1
                if self._counts[event[1:]] <= 0:
                    del self._counts[event[1:]]

    def _on_subscribed(self, prefix: bytes) -> None:
        if prefix not in self._counts and len(self._counts) >= _MAX_SUBSCRIPTIONS:
            log.warning("subscription_ignored", endpoint=self.endpoint, reason="too many different topics")
            return
        self._counts[prefix] += 1
        for topic, parts in self._latched.items():
            if topic.startswith(prefix):
                row = _row(topic)
                if row is not None and row.closes:
                    self._late[topic] = time.monotonic() + _LATE_S
                else:
                    self._answer(parts)
        if prefix.startswith(SYNC_PREFIX):
            self._answer([prefix, b""])

    def _latch(self, topic: bytes, parts: Sequence[Buffer]) -> None:
        row = _row(topic)
        if row is None or not row.latched:
            return
        self._latched[topic] = list(parts)
        for other in TOPICS.values():
            if other.closes == row.name:  # a stream that begins has not ended
                ended = other.name.encode() + topic[len(row.name) :]
                self._latched.pop(ended, None)
                self._late.pop(ended, None)

    def _answer_late(self) -> None:
        now = time.monotonic()
        for topic in [topic for topic, due in self._late.items() if due <= now]:
            del self._late[topic]
            self._answer(self._latched[topic])

    def _answer(self, parts: Sequence[Buffer]) -> None:
        if not self._try_send(parts, zmq.NOBLOCK) and len(self._owed) < _MAX_SUBSCRIPTIONS:
            self._owed.append(parts)

    def _try_send(self, parts: Sequence[Buffer], flags: int = 0) -> bool:
        try:
            self._socket.send_multipart(parts, flags, copy=False)
        except zmq.Again:
            return False
        except BaseException:  # Ctrl-C between two parts: end the message, or the next one would be glued to it
            self._socket.send(b"", zmq.NOBLOCK)
            raise
        return True


def _row(topic: bytes) -> Topic | None:
    return TOPICS.get(topic.partition(b"/")[0].decode("ascii", errors="replace"))
