"""The two ends of question and answer: ``QueryServer`` (ROUTER) and ``QuerySocket`` (REQ, made again when lost)."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from typing import Self

import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.endpoints import EndpointLock, bind, check_bind, check_connect
from semantic_mapper.transport.keys import Keys, ServerIdentity, secure_client, secure_server
from semantic_mapper.transport.messages import MAX_HEADER_BYTES, MAX_PART_BYTES, MAX_PARTS, Buffer
from semantic_mapper.transport.sockets import receive_bounded

MAX_REQUEST_BYTES = 10_000_000  # of a part: 65,536 poses, and some room; a client that sends more is cut off
_QUESTION_PARTS = 5  # who asks, the empty part that REQ sockets put first, and a question's three
_WAITING = 64  # questions and answers that may wait for each client


class QueryServer:
    """Binds an endpoint, receives questions and sends answers. One thread uses it; any thread may ``wake`` that one.

    A client that does not take its answers loses them; nothing here ever waits for a client.

    Args:
        endpoint: ``ipc://PATH`` or ``tcp://ADDRESS:PORT`` (``*`` as port: any free one, see ``endpoint``).
        keys: Encrypt, and let in only their peers; needed where other machines could connect.

    Raises:
        TransportError: the endpoint is taken, cannot be bound, or could be reached from other machines and there are
            no keys.
    """

    def __init__(self, endpoint: str, *, keys: Keys | None = None) -> None:
        check_bind(endpoint, keys)
        self._endpoint_lock = EndpointLock(endpoint)
        self._socket = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 200)
        self._socket.setsockopt(zmq.RCVHWM, _WAITING)
        self._socket.setsockopt(zmq.SNDHWM, _WAITING)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
        if keys is not None:
            secure_server(self._socket, keys)
        self.endpoint = bind(self._socket, endpoint, self._endpoint_lock)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._wake, zmq.POLLIN)

    def wake(self) -> None:
        """End the present or the next ``wait``."""
        os.eventfd_write(self._wake, 1)

    def wait(self, timeout_s: float) -> None:
        """Until there is a question, somebody calls ``wake``, or the time is over."""
        ready = dict(self._poller.poll(int(timeout_s * 1000)))
        if self._wake in ready:
            os.eventfd_read(self._wake)

    def receive(self) -> tuple[bytes, list[bytes]] | None:
        """Who asks, and the parts of the question; None where nobody does. One that is too large has a part too many,
        or lacks its last ones."""
        try:
            (sender, *parts), _ = receive_bounded(
                self._socket,
                max_parts=_QUESTION_PARTS + 1,
                max_bytes=MAX_REQUEST_BYTES + MAX_HEADER_BYTES,
                flags=zmq.NOBLOCK,
            )
        except zmq.Again:
            return None
        return sender, parts[1:] if parts[:1] == [b""] else parts

    def send(self, client: bytes, parts: Sequence[Buffer]) -> None:
        """Answer a client; where it is gone, the answer is, too."""
        try:
            self._socket.send_multipart([client, b"", *parts], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return

    def close(self) -> None:
        """Free the endpoint."""
        self._socket.close()
        os.close(self._wake)
        self._endpoint_lock.release()


class QuerySocket:
    """Asks a ``QueryServer``. Any thread may ask; questions wait for each other.

    Where no answer comes in time the socket is thrown away and the question sent again through a new one, so that a
    server that was restarted is found again. Questions change nothing, so to ask twice does no harm; a request that
    does carries an id, and a server that has seen it only answers.

    Args:
        endpoint: Where the server listens.
        timeout_s: How long to wait for an answer each time.
        attempts: How often to ask.
        identity: Of a server that has keys.

    Raises:
        TransportError: an invalid endpoint, or of another machine whose identity is not given, or a server that
            is not among the peers.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        timeout_s: float,
        attempts: int,
        identity: ServerIdentity | None = None,
    ) -> None:
        check_connect(endpoint, identity)
        self.endpoint = endpoint
        self._timeout_s = timeout_s
        self._attempts = attempts
        self._identity = identity
        self._lock = threading.Lock()
        self._closed = False
        self._socket = self._connect()

    def ask(self, parts: Sequence[Buffer]) -> list[bytes]:
        """The parts of the answer.

        Raises:
            TransportError: closed, nobody has answered, or the answer is beyond all limits.
        """
        with self._lock:
            for _ in range(self._attempts):
                if self._closed:
                    raise TransportError(f"{self.endpoint}: the client is closed")
                answer = self._ask_once(parts)
                if answer is not None:
                    return answer
        raise TransportError(
            f"{self.endpoint}: no answer within {self._attempts} x {self._timeout_s:g} s; is a mapper running, and "
            "does it answer questions there (option `query`)?"
            + ("" if self._identity is None else " Does it know this machine's key, and is its own the one we have?")
        )

    def close(self) -> None:
        """Free the socket. Harmless when repeated."""
        with self._lock:
            self._closed = True
            self._socket.close(linger=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask_once(self, parts: Sequence[Buffer]) -> list[bytes] | None:
        answered = False
        try:
            self._socket.send_multipart(parts, copy=False)
            answered = bool(self._socket.poll(int(self._timeout_s * 1000), zmq.POLLIN))
            if not answered:
                return None
            answer, trouble = receive_bounded(self._socket, max_bytes=MAX_PARTS * MAX_PART_BYTES)
            if trouble:
                raise TransportError(f"{self.endpoint}: {trouble}")
            return answer
        except zmq.Again:
            return None
        finally:  # also after Ctrl-C: a REQ socket that has sent can only wait for that answer
            if not answered:
                self._socket.close(linger=0)
                self._socket = self._connect()

    def _connect(self) -> zmq.Socket[bytes]:
        socket = zmq.Context.instance().socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, int(self._timeout_s * 1000))
        socket.setsockopt(zmq.MAXMSGSIZE, MAX_PART_BYTES)
        socket.setsockopt(zmq.RECONNECT_IVL, 50)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        try:
            if self._identity is not None:
                secure_client(socket, self._identity)
            socket.connect(self.endpoint)
        except TransportError:
            socket.close(linger=0)
            raise
        except zmq.ZMQError as error:
            socket.close(linger=0)
            raise TransportError(f"{self.endpoint}: cannot be connected to: {error}") from error
        return socket
