"""The two ends of question and answer: ``QueryServer`` (ROUTER) and ``QuerySocket`` (REQ, made again when lost)."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from typing import Self

import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.endpoints import ServerSocket, client_socket
from semantic_mapper.transport.keys import Keys, ServerIdentity
from semantic_mapper.transport.messages import MAX_HEADER_BYTES, MAX_PART_BYTES, MAX_PARTS, Buffer
from semantic_mapper.transport.sockets import receive_bounded

MAX_REQUEST_BYTES = 10_000_000  # of a part: 65,536 poses, and some room; a client that sends more is cut off
_QUESTION_PARTS = 5  # who asks, the empty part that REQ sockets put first, and a question's three
_WAITING = 64  # questions and answers that may wait for each client
_SERVER_OPTIONS = {zmq.LINGER: 200, zmq.RCVHWM: _WAITING, zmq.SNDHWM: _WAITING, zmq.MAXMSGSIZE: MAX_REQUEST_BYTES}
_CLIENT_OPTIONS = {zmq.LINGER: 0, zmq.MAXMSGSIZE: MAX_PART_BYTES, zmq.RECONNECT_IVL: 50, zmq.RECONNECT_IVL_MAX: 1000}


class QueryServer(ServerSocket):
    """Binds an endpoint, receives questions and sends answers. One thread uses it; any thread may ``wake`` that one.

    A client that does not take its answers loses them; nothing here ever waits for a client. Arguments and errors as
    of ``ServerSocket``.
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
        TransportError: see ``client_socket``.
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
            self._socket.close()

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
                self._socket.close()
                self._socket = self._connect()

    def _connect(self) -> zmq.Socket[bytes]:
        options = {**_CLIENT_OPTIONS, zmq.SNDTIMEO: int(self._timeout_s * 1000)}
        socket = client_socket(zmq.REQ, [self.endpoint], self._identity, options)
        try:
            socket.connect(self.endpoint)
        except zmq.ZMQError as error:
            socket.close()
            raise TransportError(f"{self.endpoint}: cannot be connected to: {error}") from error
        return socket
