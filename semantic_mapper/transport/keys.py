"""Who may connect from other machines: CURVE keys in a folder, and an allow-list of peers.

A folder of keys holds ``own.key`` and ``own.key_secret`` of this machine (certificates in ZeroMQ's own format), and in
``peers/NAME.key`` the public keys of others: those that a server lets in, and those by which a client knows a server.
With keys all messages are encrypted, and both sides have proven who they are before the first one.
"""

import os
import re
import struct
import threading
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
from zmq.auth import create_certificates, load_certificate
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils import z85

from semantic_mapper.errors import TransportError
from semantic_mapper.files import write_bytes
from semantic_mapper.log_events import get_logger, is_power_of_two

_KEY_LETTERS = 40  # of a public key as text (Z85)
_OWN, _PEERS = "own", "peers"

_log = get_logger(__name__)
_lock = threading.Lock()
_authenticators: weakref.WeakKeyDictionary[Any, ThreadAuthenticator] = weakref.WeakKeyDictionary()


def user_key_folder() -> Path:
    """Where this user's keys lie unless set otherwise."""
    config = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(config).expanduser() / "semantic-mapper" / "keys"


@dataclass(frozen=True, slots=True)
class Keys:
    """Keys of this machine; see ``load_keys``."""

    folder: Path  # where they lie
    # public, secret: 40 letters each (Z85).
    public: bytes
    secret: bytes

    def __repr__(self) -> str:  # the secret must not get into logs
        return f"Keys({str(self.folder)!r}, {self.public.decode()!r})"

    def peers(self) -> dict[str, bytes]:
        """Public keys of the peers by name, as they are in the folder now; ``TransportError`` where one is damaged."""
        return {path.stem: _load(path)[0] for path in sorted((self.folder / _PEERS).glob("*.key"))}


@dataclass(frozen=True, slots=True)
class ServerIdentity:
    """Whom a client expects at the other end."""

    keys: Keys  # of this machine, which the server has to know as one of its peers
    server: str = ""  # name of the server among the peers; empty = it has the very same keys


def server_identity(server: str = "", keys: Path | None = None) -> ServerIdentity | None:
    """Whom to expect: a peer by its name, or, where none is named, who has the very same keys; ``keys`` is their folder
    (by default this user's). None where neither is given: anybody. Raises TransportError: as of ``load_keys``."""
    return ServerIdentity(load_keys(keys or user_key_folder()), server) if server or keys else None


def make_keys(folder: Path) -> Keys:
    """Make new keys for this machine; ``TransportError`` where there are some, or the folder cannot be written."""
    if (folder / f"{_OWN}.key_secret").exists():
        raise TransportError(f"{folder}: there are keys already; peers know this machine by them. Remove them by hand")
    before = os.umask(0o077)
    try:
        (folder / _PEERS).mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        create_certificates(folder, _OWN)
    except OSError as error:
        raise TransportError(f"{folder}: keys cannot be written: {error}") from error
    finally:
        os.umask(before)
    return load_keys(folder)


def load_keys(folder: Path) -> Keys:
    """The keys of this machine; ``TransportError`` where they are missing or damaged, or others could read a secret."""
    path = folder / f"{_OWN}.key_secret"
    if not path.is_file():
        raise TransportError(f"{folder}: no keys here; make them with `semantic-mapper keys make --keys {folder}`")
    if path.stat().st_mode & 0o077:
        raise TransportError(f"{path}: others can read the secret key; `chmod 600 {path}`, or make new ones")
    public, secret = _load(path)
    if secret is None or not _is_key(secret):
        raise TransportError(f"{path}: holds no secret key; restore it, or make new keys")
    return Keys(folder, public, secret)


def allow(folder: Path, name: str, public: str) -> None:
    """Add a peer by its public key, or change its key; servers that run let it in from now on. ``TransportError`` for
    a name or a key that cannot be used."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,47}", name):
        raise TransportError(f"'{name}' cannot name a peer: use letters, digits and any of _ . -")
    if not _is_key(public.encode()):
        raise TransportError(f"'{public}' is no public key; `semantic-mapper keys show` has it")
    path = folder / _PEERS / f"{name}.key"
    certificate = f'metadata\n    name = {name}\ncurve\n    public-key = "{public}"\n'
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_bytes(path, certificate.encode(), raises=TransportError)


def forget(folder: Path, name: str) -> None:
    """Remove a peer (``TransportError`` for an unknown one); connections that it has already stay until they end."""
    path = folder / _PEERS / f"{Path(name).name}.key"  # never the key of this machine itself
    try:
        path.unlink()
    except OSError as error:
        there = ", ".join(sorted(p.stem for p in path.parent.glob("*.key"))) or "none"
        raise TransportError(f"{folder}: no peer '{name}' to forget; there are: {there}") from error


def secure_server(socket: zmq.Socket[bytes], keys: Keys) -> None:
    """Let in through a socket, to be bound yet, who has the key of a peer or the server's own, and nobody else."""
    domain = f"sm{id(socket):x}"  # of the allow-list; each socket has its own
    with _lock:
        authenticator = _authenticators.get(socket.context)
        if authenticator is None or not authenticator.is_alive():
            authenticator = ThreadAuthenticator(socket.context)
            authenticator.start()
            _authenticators[socket.context] = authenticator
        authenticator.configure_curve_callback(domain, credentials_provider=_AllowList(keys))
    socket.setsockopt_string(zmq.ZAP_DOMAIN, domain)
    socket.setsockopt(zmq.CURVE_SERVER, 1)
    socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public)
    socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)


def secure_client(socket: zmq.Socket[bytes], identity: ServerIdentity) -> None:
    """Let a socket, to be connected yet, talk to this server alone; ``TransportError`` where it is no peer."""
    peers = identity.keys.peers()
    known = {"": identity.keys.public, **peers}
    if identity.server not in known:
        there = f"there are: {', '.join(peers) or 'none'}; `semantic-mapper keys allow NAME KEY` adds one"
        raise TransportError(f"{identity.keys.folder}: no peer '{identity.server}'; {there}")
    socket.setsockopt(zmq.CURVE_SERVERKEY, known[identity.server])
    socket.setsockopt(zmq.CURVE_PUBLICKEY, identity.keys.public)
    socket.setsockopt(zmq.CURVE_SECRETKEY, identity.keys.secret)


class _AllowList:
    """Called by ZeroMQ's authenticator, on its thread, for each connection."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._refused = 0

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether the client with this key (Z85) may enter; the folder is read again, so that changes count at once."""
        try:
            allowed = key == self._keys.public or key in self._keys.peers().values()
        except TransportError as error:
            _log.error("peers_unreadable", reason=str(error))
            return False
        if not allowed:
            self._refused += 1
            if is_power_of_two(self._refused):
                _log.warning("unknown_key_refused", key=key.decode(), refused=self._refused)
        return allowed


def _load(path: Path) -> tuple[bytes, bytes | None]:
    try:
        public, secret = load_certificate(path)
    except (OSError, ValueError) as error:
        raise TransportError(f"{path}: cannot be read as a key: {error}") from error
    if not _is_key(public):
        raise TransportError(f"{path}: holds no public key; take it out of the folder, or add the peer again")
    return public, secret


def _is_key(text: bytes) -> bool:
    try:
        return len(text) == _KEY_LETTERS and len(z85.decode(text)) == 32
    except (KeyError, ValueError, struct.error):
        return False
