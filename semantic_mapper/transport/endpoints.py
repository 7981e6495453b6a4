"""Where sockets listen, ``ipc://`` in a folder of the user by default, where they may connect to, and how both begin.

Beyond this machine nothing is bound, and nothing connected to, without keys.
"""

import fcntl
import ipaddress
import os
import re
import stat
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Self

import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.files import open_unlinked
from semantic_mapper.transport.keys import Keys, ServerIdentity, secure_client, secure_server

_umask_lock = threading.Lock()
_MAX_IPC_PATH = 100  # the kernel takes 107 bytes, lock suffix aside


def default_endpoint(name: str, namespace: str = "default") -> str:
    """``ipc://`` endpoint of a node ("camera", "mapper"), the same for all processes of one user; ``namespace`` keeps
    two systems on one machine apart.

    Raises TransportError: a name that is no plain word, or no folder can be made for the sockets.
    """
    for word in (name, namespace):
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,48}", word) or word.startswith("."):
            raise TransportError(f"'{word}' cannot name an endpoint: use letters, digits and any of _ . -")
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and os.access(runtime, os.W_OK):
        folder = Path(runtime) / "semantic-mapper" / namespace
    else:
        folder = Path(tempfile.gettempdir()) / f"semantic-mapper-{os.getuid()}" / namespace
    try:
        folder.parent.mkdir(mode=0o700, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        owner = folder.parent.stat().st_uid
    except OSError as error:
        raise TransportError(f"cannot make the folder {folder} for sockets: {error}; set XDG_RUNTIME_DIR") from error
    if owner != os.getuid():  # in a shared temporary folder somebody else may have been first
        raise TransportError(f"{folder.parent} belongs to user {owner}; remove it or set XDG_RUNTIME_DIR")
    return f"ipc://{folder}/{name}"


def check_bind(endpoint: str, keys: Keys | None = None) -> None:
    """Refuse (``TransportError``) to listen where other machines could connect, unless there are keys, and peers to be
    let in; and transports other than ipc, inproc and tcp."""
    transport, address = _split(endpoint)
    if transport == "ipc" and (address[:1] in ("", "@") or len(os.fsencode(address)) > _MAX_IPC_PATH):
        raise TransportError(
            f"{endpoint}: an ipc address is a path of 1 to {_MAX_IPC_PATH} bytes (sockets of a launch lie in TMPDIR)"
        )
    if transport != "tcp" or is_loopback(address):
        return
    if keys is None:
        raise TransportError(
            f"{endpoint}: other machines could connect, which needs keys on both sides (`semantic-mapper keys make`, "
            "then the option `keys`); without them bind tcp://127.0.0.1:PORT, and tunnel it (ssh -L) from elsewhere"
        )
    if not keys.peers():
        raise TransportError(
            f"{endpoint}: nobody could connect, as {keys.folder} has no peers; `semantic-mapper keys allow NAME KEY`"
        )


def check_connect(endpoint: str, identity: ServerIdentity | None = None) -> None:
    """Refuse (``TransportError``) to take the word of another machine, unless it is known by its key; and transports
    other than ipc, inproc and tcp."""
    transport, address = _split(endpoint)
    if transport == "tcp" and identity is None and not is_loopback(address):
        raise TransportError(
            f"{endpoint}: is on another machine, and without keys anybody in the network could answer in its place. "
            "Make keys on both sides (`semantic-mapper keys make`, `keys allow NAME KEY`) and name that machine "
            "(--server NAME, or the option `server`); or tunnel it (ssh -L) and connect to tcp://127.0.0.1:PORT"
        )


def _split(endpoint: str) -> tuple[str, str]:
    transport, _, address = endpoint.partition("://")
    if transport not in ("ipc", "inproc", "tcp"):
        raise TransportError(f"{endpoint}: no endpoint; endpoints read ipc://PATH or tcp://HOST:PORT")
    return transport, address


def is_loopback(address: str) -> bool:
    """Of ``HOST:PORT``, or of what else ZeroMQ takes for one (``SOURCE;HOST:PORT``): that is never one of loopback."""
    host = address.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a wildcard or the name of an interface or host
        return False


class Closing:
    """A context manager that closes at its end."""

    def close(self) -> None:
        """Free what it holds."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ServerSocket(Closing):
    """A bound socket (``socket``), and its ``endpoint`` as ZeroMQ names it.

    The file of an ``ipc://`` socket is this user's alone from the start (mode 0600); of ``tcp://ADDRESS:PORT`` the port
    ``*`` is any free one. With ``keys`` all is encrypted, and only their peers are let in; needed where other machines
    could connect. Raises TransportError: the endpoint is taken, cannot be bound, or lacks keys.
    """

    def __init__(
        self, kind: zmq.SocketType, endpoint: str, keys: Keys | None, options: Mapping[zmq.SocketOption, int]
    ) -> None:
        check_bind(endpoint, keys)
        self._lock = _lock_path(endpoint) if endpoint.startswith("ipc://") else None
        self.socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
        for option, value in options.items():
            self.socket.setsockopt(option, value)
        if keys is not None:
            secure_server(self.socket, keys)
        with _umask_lock:  # a socket's file gets its mode by the umask alone, which all threads share
            before = os.umask(0o177)
            try:
                self.socket.bind(endpoint)
            except zmq.ZMQError as error:
                self.socket.setsockopt(zmq.LINGER, 0)
                ServerSocket.close(self)
                raise TransportError(f"{endpoint}: cannot be bound: {error}") from error
            finally:
                os.umask(before)
        self.endpoint = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def close(self) -> None:
        """Free the endpoint. The lock file stays: unlinking it would let two hold "the" lock."""
        self.socket.close()
        if self._lock is not None:
            self._lock.close()


def client_socket(
    kind: zmq.SocketType,
    endpoints: Sequence[str],
    identity: ServerIdentity | None,
    options: Mapping[zmq.SocketOption, int],
) -> zmq.Socket[bytes]:
    """A socket that is ready to be connected to these endpoints. ``TransportError``: one is invalid, or of another
    machine whose identity is not given, or a server that is no peer."""
    for endpoint in endpoints:
        check_connect(endpoint, identity)
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    for option, value in options.items():
        socket.setsockopt(option, value)
    try:
        if identity is not None:
            secure_client(socket, identity)
    except TransportError:
        socket.close()
        raise
    return socket


def _lock_path(endpoint: str) -> IO[bytes]:
    """Hold an ``ipc://`` path: ZeroMQ would silently take a living publisher's path over from it, or a file's.

    The kernel releases the lock when the process ends, however it ends.
    """
    path = Path(endpoint.removeprefix("ipc://"))
    if os.path.lexists(path) and not stat.S_ISSOCK(path.lstat().st_mode):
        raise TransportError(f"{endpoint}: a file is there that is no socket; move it, or choose another path")
    try:
        file = os.fdopen(open_unlinked(f"{path}.lock", os.O_RDWR | os.O_CREAT), "rb")
    except OSError as error:
        raise TransportError(f"{endpoint}: cannot be bound: {error}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise TransportError(
            f"{endpoint}: another process listens there already; stop it or choose another endpoint"
        ) from error
    return file
