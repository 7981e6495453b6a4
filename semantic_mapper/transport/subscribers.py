"""The receiving ends of topics: "newest wins" for live work, lossless for replay and recording."""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Sequence
from types import TracebackType

import zmq

from semantic_mapper.errors import CodecError, TransportError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.codec import decode, read_envelope
from semantic_mapper.transport.connections import Connections
from semantic_mapper.transport.endpoints import check_connect
from semantic_mapper.transport.framing import MAX_PART_BYTES
from semantic_mapper.transport.messages import Message
from semantic_mapper.transport.publisher import SYNC_PREFIX
from semantic_mapper.transport.receiving import max_bytes, receive_bounded
from semantic_mapper.transport.security import ServerIdentity, secure_client
from semantic_mapper.transport.topics import TOPICS, subscription

_POLL_MS = 50
# A machine that is gone is found out within 5 s; a process that is gone at once, by the kernel.
_KEEPALIVE = ((zmq.TCP_KEEPALIVE_IDLE, 2), (zmq.TCP_KEEPALIVE_INTVL, 1), (zmq.TCP_KEEPALIVE_CNT, 3))
_MAX_SLOTS = 256  # cameras and nodes that a mailbox serves; a stranger's invented ones stop here

log = get_logger(__name__)


class _Subscriber:
    """What both subscribers share: the socket, its subscriptions, the handshake, and the counting of bad messages."""

    def __init__(
        self,
        endpoints: str | Sequence[str],
        topics: Sequence[str],
        hwm: int,
        identity: ServerIdentity | None,
        context: zmq.Context[zmq.Socket[bytes]] | None,
    ) -> None:
        self.endpoints = (endpoints,) if isinstance(endpoints, str) else tuple(endpoints)
        self.topics = tuple(topics)
        self.rejected = 0
        self.last_error: CodecError | None = None
        self._received_at: float | None = None
        self._sync_topic = SYNC_PREFIX + uuid.uuid4().hex.encode() + b"/"
        self._synced = 0
        self._identity = identity
        self._closed = threading.Event()
        self._socket = (context or zmq.Context.instance()).socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, hwm)
        self._max_bytes = max(map(max_bytes, self.topics))
        self._socket.setsockopt(zmq.MAXMSGSIZE, min(MAX_PART_BYTES, self._max_bytes))
        self._socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 200)  # a node that was started anew is found at once
        # Not ZeroMQ's own heartbeats: they take a reader that does not keep up for a dead peer, and where its queue was
        # full when they cut the connection, libzmq aborts the process (4.3.5: "Assertion failed: _input_stopped").
        self._socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
        for option, seconds_or_probes in _KEEPALIVE:
            self._socket.setsockopt(option, seconds_or_probes)
        self._connections = Connections(self._socket)

    def _connect(self) -> None:
        try:
            for endpoint in self.endpoints:
                check_connect(endpoint, self._identity)
            if self._identity is not None:
                secure_client(self._socket, self._identity)
            for topic in self.topics:
                self._socket.subscribe(_prefix(topic))
            # Last: publishers hear subscriptions in order, so an answer to this one proves that all others are heard.
            self._socket.subscribe(self._sync_topic)
            for endpoint in self.endpoints:
                self._socket.connect(endpoint)
        except (zmq.ZMQError, CodecError, TransportError) as error:
            self._connections.close()
            self._socket.close(linger=0)
            raise TransportError(f"cannot subscribe to {self.endpoints}: {error}") from error

    @property
    def silent_s(self) -> float | None:
        """Seconds since the last good message; None before the first."""
        return None if self._received_at is None else time.monotonic() - self._received_at

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the socket."""
        raise NotImplementedError

    def _take_off(self) -> list[bytes] | None:
        """The message that waits; None where it has too much in it."""
        parts, trouble = receive_bounded(self._socket, max_bytes=self._max_bytes)
        if trouble:
            self._reject(CodecError(trouble))
        return None if trouble else parts

    def _is_sync(self, parts: Sequence[bytes]) -> bool:
        if not parts[0].startswith(SYNC_PREFIX):
            return False
        self._synced += parts[0] == self._sync_topic
        return True

    def _reject(self, error: CodecError) -> None:
        """A bad message costs itself and nothing else: count it, tell of it (each power of two), go on."""
        self.rejected += 1
        self.last_error = error
        if self.rejected & (self.rejected - 1) == 0:
            log.warning("message_rejected", endpoints=self.endpoints, rejected=self.rejected, error=str(error))

    def _check_open(self) -> None:
        if self._closed.is_set():
            raise TransportError(f"{self.endpoints}: the subscriber is closed")

    def _not_ready(self, timeout_s: float) -> TransportError:
        return TransportError(
            f"{self._synced} of {len(self.endpoints)} publishers at {', '.join(self.endpoints)} have answered within "
            f"{timeout_s:g} s; is the other node running?"
            + ("" if self._identity is None else " Does it know this machine's key, and is its own the one we have?")
        )


class LosslessSubscriber(_Subscriber):
    """Gets every message, in order; with a ``Publisher`` of policy "block" none is lost. Any thread may call it.

    A publisher that was restarted hears of the subscriptions again as soon as somebody waits in ``receive``.

    Args:
        endpoints: One publisher or several.
        topics: "frame", or "frame/CAMERA" for one source.
        identity: Of publishers that have keys.
        hwm: Messages that wait here before the publisher is made to wait.

    Raises:
        TransportError: an endpoint that is none, or of another machine whose identity is not given, or a server that
            is not among the peers.
    """

    def __init__(
        self,
        endpoints: str | Sequence[str],
        topics: Sequence[str],
        *,
        hwm: int = 16,
        identity: ServerIdentity | None = None,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
    ) -> None:
        super().__init__(endpoints, topics, hwm, identity, context)
        self._mutex = threading.Lock()
        self._connect()
        self._early: deque[list[bytes]] = deque()  # arrived during ``wait_until_heard``

    def __enter__(self) -> LosslessSubscriber:
        return self

    def wait_until_heard(self, timeout_s: float = 10.0) -> None:
        """Block until every publisher knows of our subscriptions; what it sends from then on arrives.

        Raises:
            TransportError: not within ``timeout_s``.
        """
        deadline = time.monotonic() + timeout_s
        while self._synced < len(self.endpoints):
            parts = self._receive_raw(_POLL_MS)
            if parts is not None and not self._is_sync(parts):
                self._early.append(parts)
            if time.monotonic() > deadline:
                raise self._not_ready(timeout_s)

    def connections(self) -> int:
        """Publishers that are connected right now; falls at once when one dies.

        Raises:
            TransportError: closed.
        """
        with self._mutex:
            self._check_open()
            return self._connections.connected()

    def receive_parts(self, timeout_s: float | None = None) -> list[bytes] | None:
        """Next message as it came over the wire, its header checked; None when none came in time.

        Bad ones are counted in ``rejected`` and passed over until the time is over: a flood of them holds nobody up.

        Args:
            timeout_s: None = wait for ever.

        Raises:
            TransportError: closed.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_ms = _POLL_MS if deadline is None else max(0.0, deadline - time.monotonic()) * 1e3
            parts = self._early.popleft() if self._early else self._receive_raw(min(_POLL_MS, left_ms))
            if parts is not None and not self._is_sync(parts):
                try:
                    read_envelope(parts)
                except CodecError as error:
                    self._reject(error)
                else:
                    self._received_at = time.monotonic()
                    return parts
            if _is_over(deadline):
                return None

    def receive(self, timeout_s: float | None = None) -> Message | None:
        """Next message, decoded; None when none came in time. Bad ones are passed over as in ``receive_parts``.

        Raises:
            TransportError: closed.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            parts = self.receive_parts(left)
            if parts is None:
                return None
            try:
                return decode(parts)
            except CodecError as error:
                self._reject(error)
            if _is_over(deadline):
                return None

    def close(self) -> None:
        """Free the socket. Harmless when repeated."""
        with self._mutex:
            if self._closed.is_set():
                return
            self._closed.set()
            self._connections.close()
            self._socket.close(linger=0)

    def _receive_raw(self, poll_ms: float) -> list[bytes] | None:
        with self._mutex:
            self._check_open()
            self._connections.mend()
            if not self._socket.poll(math.ceil(poll_ms)):
                return None
            return self._take_off()


class NewestSubscriber(_Subscriber):
    """Gets the newest message of each source: an unread one gives way to the next, and is counted.

    A thread of its own takes messages off the socket as they come and checks their headers; images are decoded by
    whoever calls ``receive``. Messages whose topic is marked "all" in the table (info, end, ...) never give way.

    Args:
        endpoints: One publisher or several.
        topics: "frame", or "frame/CAMERA" for one source.
        identity: Of publishers that have keys.

    Raises:
        TransportError: an endpoint that is none, or of another machine whose identity is not given, or a server that
            is not among the peers.
    """

    def __init__(
        self,
        endpoints: str | Sequence[str],
        topics: Sequence[str],
        *,
        identity: ServerIdentity | None = None,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
    ) -> None:
        super().__init__(endpoints, topics, 16, identity, context)
        self._changed = threading.Condition()
        self._slots: dict[tuple[bytes, int], list[bytes]] = {}  # (topic, 0), or (topic, serial) where none gives way
        self._serial = 0
        self.overwritten = 0
        self._failure: zmq.ZMQError | None = None  # of the thread that takes messages off the socket
        self._connect()
        self._thread = threading.Thread(target=self._run, name=f"subscriber {self.endpoints}", daemon=True)
        self._thread.start()

    def __enter__(self) -> NewestSubscriber:
        return self

    def wait_until_heard(self, timeout_s: float = 10.0) -> None:
        """Block until every publisher knows of our subscriptions; what it sends from then on arrives.

        Raises:
            TransportError: not within ``timeout_s``.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._synced >= len(self.endpoints) or self._failure is not None, timeout_s)
            self._check_receiving()
            if self._synced < len(self.endpoints):
                raise self._not_ready(timeout_s)

    def receive(self, timeout_s: float | None = None) -> Message | None:
        """The newest message of the source that has waited longest; None when none came in time.

        Bad messages are counted in ``rejected`` and passed over until the time is over.

        Raises:
            TransportError: closed; or nothing can come any more, which says why.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            with self._changed:
                left = None if deadline is None else max(0.0, deadline - time.monotonic())
                self._changed.wait_for(
                    lambda: bool(self._slots) or self._closed.is_set() or self._failure is not None, left
                )
                self._check_open()
                if not self._slots:
                    self._check_receiving()
                    return None
                # A message that replaced another keeps its place, so an end of stream cannot overtake a frame.
                parts = self._slots.pop(next(iter(self._slots)))
            try:
                return decode(parts)
            except CodecError as error:
                self._reject(error)
            if _is_over(deadline):
                return None

    def close(self) -> None:
        """Stop the thread and free the socket. Harmless when repeated."""
        with self._changed:
            self._closed.set()
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                self._connections.mend()
                if self._socket.poll(_POLL_MS) and (parts := self._take_off()) is not None:
                    self._take(parts)
        except zmq.ZMQError as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()
        finally:
            self._connections.close()
            self._socket.close(linger=0)  # by the thread that used it

    def _check_receiving(self) -> None:
        if self._failure is not None:
            raise TransportError(
                f"{self.endpoints}: nothing is received any more: {self._failure}; subscribe anew"
            ) from self._failure

    def _take(self, parts: list[bytes]) -> None:
        if parts[0].startswith(SYNC_PREFIX):
            with self._changed:
                self._is_sync(parts)
                self._changed.notify_all()
            return
        try:
            envelope = read_envelope(parts)
        except CodecError as error:
            self._reject(error)
            return
        with self._changed:
            gives_way = TOPICS[envelope.topic].queue == "newest"
            self._serial += not gives_way
            key = (parts[0], 0 if gives_way else self._serial)
            if key not in self._slots and len(self._slots) >= _MAX_SLOTS:
                self._reject(CodecError(f"{len(self._slots)} sources wait to be read; no room for {parts[0]!r}"))
                return
            self.overwritten += key in self._slots
            self._slots[key] = parts
            self._received_at = time.monotonic()
            self._changed.notify_all()


def _is_over(deadline: float | None) -> bool:
    return deadline is not None and time.monotonic() >= deadline


def _prefix(topic: str) -> bytes:
    name, _, source = topic.partition("/")
    if name not in TOPICS:
        raise CodecError(f"no topic '{name}'; there are {', '.join(TOPICS)}")
    return subscription(name, source or None)
