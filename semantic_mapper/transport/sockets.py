"""Sockets of topics: ``Publisher``, and the two ways to subscribe, ``NewestSubscriber`` and ``LosslessSubscriber``; and
the two ends of question and answer: ``QueryServer`` (ROUTER) and ``QuerySocket`` (REQ, made again when lost)."""

import os
import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Literal, cast

import zmq
from zmq.utils.monitor import recv_monitor_message

from semantic_mapper.errors import CodecError, TransportError
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.codec import decode, read_envelope
from semantic_mapper.transport.endpoints import Closing, ServerSocket, client_socket
from semantic_mapper.transport.keys import Keys, ServerIdentity
from semantic_mapper.transport.messages import (
    MAX_HEADER_BYTES,
    MAX_KEYFRAME_BYTES,
    MAX_PART_BYTES,
    MAX_PARTS,
    MAX_WEIGHTS_BYTES,
    TOPICS,
    Buffer,
    Message,
    Parts,
    subscription,
)
from semantic_mapper.types import MAX_PIXELS

MAX_MESSAGE_BYTES = 10 * MAX_PIXELS + 2 * MAX_HEADER_BYTES  # a frame's colours, depth and labels, none packed
_OF_TOPIC = {"keyframe": MAX_KEYFRAME_BYTES, "weights": MAX_WEIGHTS_BYTES + 2 * MAX_HEADER_BYTES}
SYNC_PREFIX = b"sync/"  # a subscription to sync/TOKEN/ is answered by that very topic: "I have heard you"
_LATCHED = {row.name.encode(): row.closes.encode() for row in TOPICS.values() if row.latched}  # and what they end
_PUMP_PERIOD_S = 0.02
_SEND_SLICE_MS = 100
_LATE_S = 0.1  # subscriptions of one socket come in no order; an end must not arrive before what it ends
_MAX_SUBSCRIPTIONS = 4096  # what an unknown client's subscriptions may cost us
_MAX_EVENTS = 256  # heard at a time: an unknown client that subscribes without end must not hold up what is published
_POLL_MS = 50
_SUBSCRIBER_OPTIONS = {
    zmq.LINGER: 0,
    zmq.RECONNECT_IVL: 50,
    zmq.RECONNECT_IVL_MAX: 200,  # a node that was restarted is found at once
    # A machine that is gone is found out within 5 s; a process that is gone at once, by the kernel. Not ZeroMQ's own
    # heartbeats: they take a reader that does not keep up for a dead peer, and where its queue was full when they cut
    # the connection, libzmq aborts the process (4.3.5: "Assertion failed: _input_stopped").
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 2,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 3,
}
_MAX_SLOTS = 256  # cameras and nodes that a mailbox serves; an unknown client's invented ones stop here
MAX_REQUEST_BYTES = 10_000_000  # of a part: 65,536 poses, and some room; a client that sends more is cut off
_QUESTION_PARTS = 5  # who asks, the empty part that REQ sockets put first, and a question's three
_WAITING = 64  # questions and answers that may wait for each client
_SERVER_OPTIONS = {zmq.LINGER: 200, zmq.RCVHWM: _WAITING, zmq.SNDHWM: _WAITING, zmq.MAXMSGSIZE: MAX_REQUEST_BYTES}
_CLIENT_OPTIONS = {zmq.LINGER: 0, zmq.MAXMSGSIZE: MAX_PART_BYTES, zmq.RECONNECT_IVL: 50, zmq.RECONNECT_IVL_MAX: 1000}
_KEYS_DIFFER = " Does it know this machine's key, and is its own the one we have?"
_GIVEN_UP_S = 0.3  # ZeroMQ says at once whether it tries again
_TRIES_AGAIN = (zmq.EVENT_CONNECT_RETRIED, zmq.EVENT_CONNECT_DELAYED, zmq.EVENT_CONNECTED)
_EVENTS = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED | sum(_TRIES_AGAIN)


log = get_logger(__name__)


def receive_bounded(
    socket: zmq.Socket[bytes], *, max_parts: int = MAX_PARTS, max_bytes: int = MAX_MESSAGE_BYTES, flags: int = 0
) -> tuple[list[bytes], str]:
    """The parts of the next message, all of which is taken off the socket, and an empty text; of a message beyond the
    limits the parts before the first that is too much, and why. ``zmq.Again`` where the flags say not to wait."""
    parts: list[bytes] = []
    count = size = 0
    while not count or socket.getsockopt(zmq.RCVMORE):
        part = cast(bytes, socket.recv(flags))
        count, size = count + 1, size + len(part)
        if count <= max_parts and size <= max_bytes:
            parts.append(part)
    if len(parts) == count:
        return parts, ""
    return parts, f"{count} parts of {size} bytes in all; a message has at most {max_parts} and {max_bytes} bytes"


class Publisher(Closing):
    """Binds an endpoint and sends encoded messages to all subscribers. Any thread may call any method.

    Raises TransportError: see ``ServerSocket``.

    Args:
        endpoint, keys: As of ``ServerSocket``.
        policy: Toward a subscriber that does not keep up. "drop" (live): it loses messages. "block" (replay,
            recording): ``publish`` waits for it, so that nothing is lost.
        hwm: Messages that may wait for each subscriber.
        linger_ms: How long ``close`` waits for the last messages to be delivered.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        policy: Literal["drop", "block"] = "drop",
        hwm: int = 16,
        linger_ms: int = 2000,
        keys: Keys | None = None,
    ) -> None:
        options = {
            zmq.LINGER: linger_ms,
            zmq.SNDHWM: hwm,
            zmq.SNDTIMEO: _SEND_SLICE_MS,
            zmq.MAXMSGSIZE: 1024,  # subscribers send nothing but subscriptions
            zmq.XPUB_VERBOSER: 1,  # tell of every (un)subscription, so that they can be counted
            zmq.XPUB_NODROP: int(policy == "block"),
        }
        self._server = ServerSocket(zmq.XPUB, endpoint, keys, options)
        self._socket, self.endpoint = self._server.socket, self._server.endpoint
        self._mutex = threading.Lock()  # a zmq socket may change threads only across a memory barrier
        self._counts: Counter[bytes] = Counter()
        self._latched: dict[bytes, Parts] = {}
        self._owed: list[tuple[float, Parts]] = []  # answers to subscriptions, and not before when
        self._closed = threading.Event()
        self._pump_thread = threading.Thread(target=self._pump, name=f"publisher {endpoint}", daemon=True)
        self._pump_thread.start()

    def publish(self, parts: Parts, timeout_s: float = 30.0) -> None:
        """Send one encoded message. The parts must not be changed afterwards. Raises TransportError: closed; or policy
        "block" and a subscriber did not make room within ``timeout_s``."""
        topic = bytes(parts[0])
        deadline = time.monotonic() + timeout_s
        while True:
            with self._in_use():
                sent, late = self._try_send(parts), time.monotonic() > deadline
                if sent or late:
                    self._latch(topic, parts)  # who comes later, or is reminded, gets it yet
            if sent:
                return
            self._closed.wait(0.001)  # let other threads have the socket
            if late:
                reader = f"a subscriber of {topic.decode(errors='replace')} has taken nothing for {timeout_s:g} s"
                raise TransportError(f"{self.endpoint}: {reader}; it hangs or is too slow for a lossless stream")

    def remind(self, name: str) -> None:
        """Send the latched messages of a topic once more, for those who had no room for them; waits for nobody."""
        with self._in_use():
            for topic, parts in self._latched.items():
                if topic.startswith(subscription(name)):
                    self._try_send(parts, zmq.NOBLOCK)

    def subscribers(self, name: str, source: str | None = None) -> int:
        """How many subscriptions a message of this topic reaches."""
        topic = subscription(name, source)
        with self._in_use():
            return sum(count for prefix, count in self._counts.items() if topic.startswith(prefix))

    def wait_for_subscribers(self, name: str, count: int = 1, timeout_s: float = 10.0, stop: object = False) -> bool:
        """Block until ``count`` subscriptions to topic ``name`` have arrived, so that no one misses the first message;
        False once ``stop`` is true before. ``TransportError`` where it takes longer than ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while (there := self.subscribers(name)) < count:
            if stop:
                return False
            if time.monotonic() > deadline:
                there_are = f"{there} of {count} subscribers of '{name}' after {timeout_s:g} s"
                raise TransportError(f"{self.endpoint}: {there_are}; does the other node run, and connect to this?")
            self._closed.wait(0.005)
        return True

    def close(self) -> None:
        """Deliver what is still waiting (at most ``linger_ms``), then free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._pump_thread.join()
        with self._mutex:
            self._server.close()

    @contextmanager
    def _in_use(self) -> Iterator[None]:
        """Hold the socket, once what subscribers have sent is heard."""
        with self._mutex:
            if self._closed.is_set():
                raise TransportError(f"{self.endpoint}: the publisher is closed")
            self._drain()
            yield

    def _pump(self) -> None:
        """Hear subscriptions also while nothing is published."""
        while not self._closed.wait(_PUMP_PERIOD_S):
            with self._mutex:
                self._drain()

    def _drain(self) -> None:
        """Hear what subscribers have sent, and answer as far as there is room."""
        for _ in range(_MAX_EVENTS):
            try:
                event = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                break
            if event[:1] == b"\x01":
                self._on_subscribed(event[1:])
            elif event[:1] == b"\x00":
                self._counts[event[1:]] -= 1
                if self._counts[event[1:]] <= 0:
                    del self._counts[event[1:]]
        now = time.monotonic()
        self._owed = [(due, parts) for due, parts in self._owed if due > now or not self._try_send(parts, zmq.NOBLOCK)]

    def _on_subscribed(self, prefix: bytes) -> None:
        if max(len(self._counts), len(self._owed)) >= _MAX_SUBSCRIPTIONS and prefix not in self._counts:
            log.warning("subscription_ignored", endpoint=self.endpoint, reason="too many different topics")
            return
        self._counts[prefix] += 1
        now = time.monotonic()
        answers = [(topic, parts) for topic, parts in self._latched.items() if topic.startswith(prefix)]
        self._owed += [(now + _LATE_S * bool(_LATCHED[topic.partition(b"/")[0]]), parts) for topic, parts in answers]
        if prefix.startswith(SYNC_PREFIX):
            self._owed.append((now, [prefix, b""]))

    def _latch(self, topic: bytes, parts: Parts) -> None:
        name, _, source = topic.partition(b"/")
        if name not in _LATCHED:
            return
        self._latched[topic] = tuple(parts)
        for ending in [ending for ending, begun in _LATCHED.items() if begun == name]:  # what begins has not ended
            ended = self._latched.pop(ending + b"/" + source, None)
            self._owed = [(due, owed) for due, owed in self._owed if owed is not ended]

    def _try_send(self, parts: Parts, flags: int = 0) -> bool:
        try:
            self._socket.send_multipart(parts, flags, copy=False)
        except zmq.Again:
            return False
        except BaseException:  # Ctrl-C between two parts: end the message, or the next one would be glued to it
            self._socket.send(b"", zmq.NOBLOCK)
            raise
        return True


def _known(topic: str) -> tuple[str, str | None]:
    name, _, source = topic.partition("/")
    if name not in TOPICS:
        raise CodecError(f"no topic '{name}'; there are {', '.join(TOPICS)}")
    return name, source or None


class _Subscriber(Closing):
    """A subscriber, as the two below are; any thread may call its methods.

    A thread of its own takes messages off the socket as they come and checks their headers; images are decoded by the
    caller of ``receive``. A bad message costs itself and nothing else: it is counted in ``rejected`` and passed over. A
    publisher that was restarted hears of the subscriptions again. Raises TransportError: an unknown topic; or see
    ``client_socket``.

    Args:
        endpoints: One publisher or several.
        topics: "frame", or "frame/CAMERA" for one source.
        identity: Of publishers that have keys.
        hwm: Messages that wait in the socket's own queue; as many wait here before a lossless one makes the publisher
            wait.
    """

    def __init__(
        self,
        endpoints: str | Sequence[str],
        topics: Sequence[str],
        *,
        identity: ServerIdentity | None = None,
        hwm: int = 16,
    ) -> None:
        self.endpoints = (endpoints,) if isinstance(endpoints, str) else tuple(endpoints)
        self.topics = tuple(topics)
        self.rejected = 0
        self._hwm = hwm
        self._changed = threading.Condition()
        # What waits to be read, in order: by topic where messages give way to newer ones, else by serial number. One
        # that replaces another keeps its place, so that an end of stream cannot overtake a frame.
        self._waiting: dict[bytes | int, list[bytes]] = {}
        self._serial = 0
        self._received_at: float | None = None
        self._sync_topic = SYNC_PREFIX + uuid.uuid4().hex.encode() + b"/"
        self._synced = 0
        self._identity = identity
        self._over = ""  # why nothing comes any more
        self._max_bytes = max(_OF_TOPIC.get(topic.partition("/")[0], MAX_MESSAGE_BYTES) for topic in self.topics)
        options = {**_SUBSCRIBER_OPTIONS, zmq.RCVHWM: hwm, zmq.MAXMSGSIZE: min(MAX_PART_BYTES, self._max_bytes)}
        try:
            prefixes = [subscription(*_known(topic)) for topic in self.topics]
            self._socket = client_socket(zmq.SUB, self.endpoints, identity, options)
        except (CodecError, TransportError) as error:
            raise TransportError(f"cannot subscribe to {self.endpoints}: {error}") from error
        self._connections = _Connections(self._socket)
        # Last: publishers hear subscriptions in order, so an answer to this one proves that all others are heard.
        for prefix in (*prefixes, self._sync_topic):
            self._socket.subscribe(prefix)
        try:
            for endpoint in self.endpoints:
                self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self._connections.close()
            raise TransportError(f"cannot subscribe to {self.endpoints}: {error}") from error
        self._thread = threading.Thread(target=self._run, name=f"subscriber {self.endpoints}", daemon=True)
        self._thread.start()

    @property
    def silent_s(self) -> float | None:
        """Seconds since the last good message; None before the first."""
        return None if self._received_at is None else time.monotonic() - self._received_at

    def connections(self) -> int:
        """Publishers that are connected right now; falls at once when one dies."""
        return self._connections.count

    def wait_until_heard(self, timeout_s: float = 10.0, stop: object = False) -> bool:
        """Block until every publisher knows of our subscriptions: what it sends from then on arrives. False once
        ``stop`` is true before. ``TransportError`` where it takes longer than ``timeout_s``."""
        count, deadline = len(self.endpoints), time.monotonic() + timeout_s
        with self._changed:
            while self._synced < count and not self._over and time.monotonic() < deadline:
                if stop:
                    return False
                self._changed.wait(min(timeout_s, _POLL_MS / 1000))
            if self._synced >= count and not self._over:
                return True
            why = f"{self._synced} of {count} publishers have answered within {timeout_s:g} s; does the other node run?"
            why = self._over or why + (_KEYS_DIFFER if self._identity else "")
            raise TransportError(f"{', '.join(self.endpoints)}: {why}")

    def receive(self, timeout_s: float | None = None) -> Message | None:
        """The message that has waited longest, decoded; None when none came in time (``timeout_s`` None: wait for
        ever).

        Bad messages are passed over until then: a flood of them holds nobody up. ``TransportError`` where the
        subscriber is closed, or nothing can come any more.
        """
        deadline, left_s = None if timeout_s is None else time.monotonic() + timeout_s, timeout_s
        while (parts := self.receive_parts(left_s)) is not None:
            try:
                return decode(parts)
            except CodecError as error:
                self._reject(error)
            if deadline is not None and (left_s := deadline - time.monotonic()) <= 0:
                break
        return None

    def receive_parts(self, timeout_s: float | None = None) -> list[bytes] | None:
        """As ``receive``, as it came over the wire, its header checked: for who may not want what is in it."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._waiting) or bool(self._over), timeout_s)
            if not self._waiting and self._over:
                raise TransportError(f"{', '.join(self.endpoints)}: {self._over}")
            if not self._waiting:
                return None
            parts = self._waiting.pop(next(iter(self._waiting)))
            self._changed.notify_all()  # there is room again
            return parts

    def close(self) -> None:
        """Stop the thread and free the socket. Harmless when repeated."""
        self._end("the subscriber is closed")
        self._thread.join()
        self._waiting.clear()

    def _end(self, why: str) -> None:
        with self._changed:
            self._over = self._over or why
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while not self._over:
                self._connections.follow()
                if self._socket.poll(_POLL_MS):
                    self._take(*receive_bounded(self._socket, max_bytes=self._max_bytes))
        except zmq.ZMQError as error:
            self._end(f"nothing is received any more: {error}; subscribe again")
        finally:
            self._connections.close()  # by the thread that used it

    def _take(self, parts: list[bytes], trouble: str) -> None:
        if parts[0].startswith(SYNC_PREFIX):
            with self._changed:
                self._synced += parts[0] == self._sync_topic
                self._changed.notify_all()
            return
        try:
            if trouble:
                raise CodecError(trouble)
            envelope = read_envelope(parts)
        except CodecError as error:
            self._reject(error)
            return
        with self._changed:
            self._put(parts, TOPICS[envelope.topic].queue)
            self._received_at = time.monotonic()
            self._changed.notify_all()

    def _put(self, parts: list[bytes], queue: str) -> None:
        """Let a good message wait to be read; ``_changed`` is held."""
        raise NotImplementedError

    def _reject(self, error: CodecError) -> None:
        self.rejected += 1
        if is_power_of_two(self.rejected):
            log.warning("message_rejected", endpoints=self.endpoints, rejected=self.rejected, error=str(error))


class LosslessSubscriber(_Subscriber):
    """Gets every message, in order; with a ``Publisher`` of policy "block" none is lost. Arguments: ``_Subscriber``."""

    def _put(self, parts: list[bytes], queue: str) -> None:
        self._changed.wait_for(lambda: len(self._waiting) < self._hwm or bool(self._over))
        self._serial += 1
        self._waiting[self._serial] = parts


class NewestSubscriber(_Subscriber):
    """Gets the newest message of each source: an unread one gives way to the next, and is counted in ``overwritten``.

    Messages whose topic is marked "all" in the table (info, end, ...) never give way. Arguments: ``_Subscriber``.
    """

    overwritten = 0

    def _put(self, parts: list[bytes], queue: str) -> None:
        self._serial += 1
        key = parts[0] if queue == "newest" else self._serial
        if key not in self._waiting and len(self._waiting) >= _MAX_SLOTS:
            self._reject(CodecError(f"{len(self._waiting)} sources wait to be read; no room for {parts[0]!r}"))
            return
        self.overwritten += key in self._waiting
        self._waiting[key] = parts


class _Connections:
    """Counts the connections of a socket that is not connected yet, and makes those again that ZeroMQ has given up; for
    the socket's thread."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket
        address = f"inproc://connections-{uuid.uuid4().hex}"
        socket.monitor(address, _EVENTS)
        self._monitor = socket.context.socket(zmq.PAIR)
        self._monitor.setsockopt(zmq.LINGER, 0)
        self._monitor.setsockopt(zmq.RCVHWM, 0)  # ZeroMQ's own thread would wait for us
        self._monitor.connect(address)
        self._lost: dict[str, float] = {}  # connections that are not tried again, and since when
        self.count = 0
        self._renewed = 0

    def follow(self) -> None:
        """Hear what has happened, and connect again where that is needed; often called, costs nothing."""
        while self._monitor.poll(0):
            report = recv_monitor_message(self._monitor)
            endpoint = report["endpoint"].decode(errors="replace")
            if report["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self.count += 1
            elif report["event"] == zmq.EVENT_DISCONNECTED:
                self.count = max(0, self.count - 1)
                self._lost[endpoint] = time.monotonic()
            else:
                self._lost.pop(endpoint, None)
        now = time.monotonic()
        for endpoint in [e for e, since in self._lost.items() if now - since > _GIVEN_UP_S]:
            del self._lost[endpoint]
            self._renewed += 1
            with suppress(zmq.ZMQError):  # it knows nothing of that connection any more
                self._socket.disconnect(endpoint)
            self._socket.connect(endpoint)
            if is_power_of_two(self._renewed):
                log.warning("connection_renewed", endpoint=endpoint, renewed=self._renewed)

    def close(self) -> None:
        """The socket, too."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close(linger=0)


class QueryServer(ServerSocket):
    """Binds an endpoint, receives questions and sends answers. One thread uses it; any thread may ``wake`` that one.

    A client that does not take its answers loses them; nothing here ever waits for a client. Errors: ``ServerSocket``.
    """

    def __init__(self, endpoint: str, *, keys: Keys | None = None) -> None:
        super().__init__(zmq.ROUTER, endpoint, keys, _SERVER_OPTIONS)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._poller = zmq.Poller()
        self._poller.register(self.socket, zmq.POLLIN)
        self._poller.register(self._wake, zmq.POLLIN)

    def wake(self) -> None:
        """End the present or the next ``wait``."""
        os.eventfd_write(self._wake, 1)

    def wait(self, timeout_s: float) -> None:
        """Until there is a question, somebody calls ``wake``, or the time is over."""
        if self._wake in dict(self._poller.poll(int(timeout_s * 1000))):
            os.eventfd_read(self._wake)

    def receive(self) -> tuple[bytes, list[bytes]] | None:
        """Who asks, and the parts of the question; None where nobody does. One that is too large has a part too many,
        or lacks its last ones."""
        limit = MAX_REQUEST_BYTES + MAX_HEADER_BYTES
        try:
            (sender, *parts), _ = receive_bounded(
                self.socket, max_parts=_QUESTION_PARTS + 1, max_bytes=limit, flags=zmq.NOBLOCK
            )
        except zmq.Again:
            return None
        return sender, parts[1:] if parts[:1] == [b""] else parts

    def send(self, client: bytes, parts: Sequence[Buffer]) -> None:
        """Answer a client; where it is gone, the answer is, too."""
        try:
            self.socket.send_multipart([client, b"", *parts], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return

    def close(self) -> None:
        """Free the endpoint."""
        super().close()
        os.close(self._wake)


class QuerySocket(Closing):
    """Asks a ``QueryServer``. Any thread may ask; questions wait for each other.

    Where no answer comes in time the socket is thrown away and the question sent again through a new one, so that a
    server that was restarted is found again. Questions change nothing, so to ask twice does no harm; a request that
    does carries an id, and a server that has seen it only answers. It gets the question ``attempts`` times and given
    ``timeout_s`` for each answer. Raises TransportError: see ``client_socket``.
    """

    def __init__(
        self, endpoint: str, *, timeout_s: float, attempts: int, identity: ServerIdentity | None = None
    ) -> None:
        self.endpoint = endpoint
        self._timeout_s = timeout_s
        self._attempts = attempts
        self._identity = identity
        self._lock = threading.Lock()
        self._closed = False
        self._socket = self._connect()

    def ask(self, parts: Sequence[Buffer]) -> list[bytes]:
        """The parts of the answer. Raises TransportError: closed, no answer, or one beyond all limits."""
        with self._lock:
            for _ in range(self._attempts):
                if self._closed:
                    raise TransportError(f"{self.endpoint}: the client is closed")
                answered = False
                try:
                    self._socket.send_multipart(parts, copy=False)
                    answered = bool(self._socket.poll(int(self._timeout_s * 1000), zmq.POLLIN))
                    if answered:
                        answer, trouble = receive_bounded(self._socket, max_bytes=MAX_PARTS * MAX_PART_BYTES)
                        if trouble:
                            raise TransportError(f"{self.endpoint}: {trouble}")
                        return answer
                except zmq.Again:
                    continue
                finally:  # also after Ctrl-C: a REQ socket that has sent can only wait for that answer
                    if not answered:
                        self._socket.close()
                        self._socket = self._connect()
        raise TransportError(
            f"{self.endpoint}: no answer within {self._attempts} x {self._timeout_s:g} s; is a mapper running, and "
            f"does it answer questions there (option `query`)?{_KEYS_DIFFER if self._identity else ''}"
        )

    def close(self) -> None:
        """Free the socket. Harmless when repeated."""
        with self._lock:
            self._closed = True
            self._socket.close()

    def _connect(self) -> zmq.Socket[bytes]:
        options = {**_CLIENT_OPTIONS, zmq.SNDTIMEO: int(self._timeout_s * 1000)}
        socket = client_socket(zmq.REQ, [self.endpoint], self._identity, options)
        try:
            socket.connect(self.endpoint)
        except zmq.ZMQError as error:
            socket.close()
            raise TransportError(f"{self.endpoint}: cannot be connected to: {error}") from error
        return socket
