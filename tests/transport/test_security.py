"""Who has no key of a peer gets nothing, and nothing is bound beyond this machine without keys."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import structlog
import zmq

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import check_connect
from semantic_mapper.transport.keys import Keys, ServerIdentity, allow, forget, load_keys, make_keys
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.query_sockets import QueryServer, QuerySocket
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher

STATUS = Status(node="mapper", state="running", stamp_ns=1)


@pytest.fixture
def robot(tmp_path: Path) -> Keys:
    return make_keys(tmp_path / "robot")


@pytest.fixture
def desk(tmp_path: Path, robot: Keys) -> Keys:
    """Knows the robot, and is known to it."""
    keys = make_keys(tmp_path / "desk")
    introduce(robot, keys)
    return keys


@pytest.fixture
def stranger(tmp_path: Path, robot: Keys) -> Keys:
    """Knows the robot, which does not know it."""
    keys = make_keys(tmp_path / "stranger")
    allow(keys.folder, "robot", robot.public.decode())
    return keys


def introduce(robot: Keys, other: Keys) -> None:
    allow(robot.folder, other.folder.name, other.public.decode())
    allow(other.folder, "robot", robot.public.decode())


@pytest.fixture
def server(robot: Keys, desk: Keys) -> Iterator[str]:
    """Answers each question with itself, where other machines can reach it."""
    with_peer = QueryServer("tcp://0.0.0.0:*", keys=robot)
    closed = threading.Event()

    def answer() -> None:
        while not closed.is_set():
            with_peer.wait(0.02)
            while (asked := with_peer.receive()) is not None:
                with_peer.send(*asked)

    thread = threading.Thread(target=answer)
    thread.start()
    yield with_peer.endpoint.replace("0.0.0.0", "127.0.0.1")
    closed.set()
    thread.join()
    with_peer.close()


def ask(endpoint: str, identity: ServerIdentity | None, timeout_s: float = 0.4) -> list[bytes]:
    with QuerySocket(endpoint, timeout_s=timeout_s, attempts=1, identity=identity) as client:
        return client.ask([b"hello", b"there"])


def test_a_peer_is_answered(server: str, desk: Keys) -> None:
    assert ask(server, ServerIdentity(desk, "robot"), 10) == [b"hello", b"there"]


def test_a_stranger_is_not_answered_and_is_told_of_in_the_log(server: str, stranger: Keys, desk: Keys) -> None:
    with (
        structlog.testing.capture_logs() as logs,
        pytest.raises(TransportError, match="Does it know this machine's key"),
    ):
        ask(server, ServerIdentity(stranger, "robot"))
    refusals = [e for e in logs if e["event"] == "stranger_refused"]
    assert refusals and refusals[0]["key"] == stranger.public.decode()
    assert ask(server, ServerIdentity(desk, "robot"), 10) == [b"hello", b"there"]


def test_who_speaks_in_the_clear_is_not_answered(server: str) -> None:
    with pytest.raises(TransportError, match="no answer"):
        ask(server, None)


def test_a_server_with_another_key_than_the_one_known_is_not_talked_to(server: str, desk: Keys, tmp_path: Path) -> None:
    impostor = make_keys(tmp_path / "impostor")
    allow(desk.folder, "robot", impostor.public.decode())
    with pytest.raises(TransportError, match="no answer"):
        ask(server, ServerIdentity(desk, "robot"))


def test_peers_come_and_go_while_the_server_runs(server: str, robot: Keys, stranger: Keys, desk: Keys) -> None:
    introduce(robot, stranger)
    assert ask(server, ServerIdentity(stranger, "robot"), 10) == [b"hello", b"there"]
    forget(robot.folder, "stranger")
    with pytest.raises(TransportError, match="no answer"):
        ask(server, ServerIdentity(stranger, "robot"))


@pytest.mark.parametrize("subscriber", [LosslessSubscriber, NewestSubscriber])
def test_topics_reach_peers_alone(
    robot: Keys, desk: Keys, stranger: Keys, subscriber: type[LosslessSubscriber] | type[NewestSubscriber]
) -> None:
    with (
        Publisher("tcp://127.0.0.1:*", keys=robot) as publisher,
        subscriber(publisher.endpoint, ("status",), identity=ServerIdentity(desk, "robot")) as peer,
        subscriber(publisher.endpoint, ("status",), identity=ServerIdentity(stranger, "robot")) as other,
        subscriber(publisher.endpoint, ("status",)) as clear,
    ):
        peer.wait_until_heard(10)
        publisher.publish(encode(STATUS))
        assert peer.receive(10) == STATUS
        assert other.receive(0.2) is None and clear.receive(0) is None
        with pytest.raises(TransportError, match="Does it know this machine's key"):
            other.wait_until_heard(0.2)
        assert publisher.subscribers("status") == 1


def test_what_travels_is_encrypted(robot: Keys, desk: Keys) -> None:
    """A relay between client and server sees the bytes of the wire."""
    seen = bytearray()
    word = b"a word that nobody else may read"
    with closing(QueryServer("tcp://127.0.0.1:*", keys=robot)) as server, Relay(server.endpoint, seen) as endpoint:
        done = threading.Event()

        def answer() -> None:
            while not done.is_set():
                server.wait(0.02)
                while (asked := server.receive()) is not None:
                    server.send(*asked)

        thread = threading.Thread(target=answer)
        thread.start()
        with QuerySocket(endpoint, timeout_s=10, attempts=1, identity=ServerIdentity(desk, "robot")) as client:
            assert client.ask([word, b"x"])[0] == word
        done.set()
        thread.join()
    assert b"CURVE" in seen and len(seen) > 500 and word not in seen


def test_beyond_this_machine_nothing_is_bound_without_keys_and_peers(robot: Keys) -> None:
    for kind in (QueryServer, Publisher):
        with pytest.raises(TransportError, match="needs keys on both sides"):
            kind("tcp://0.0.0.0:*")
        with pytest.raises(TransportError, match=r"nobody could connect.*no peers"):
            kind("tcp://0.0.0.0:*", keys=robot)


@pytest.mark.parametrize(
    "address",
    [
        "tcp://robot:5570",
        "tcp://192.168.1.5:5570",
        "tcp://[fe80::1]:5570",
        "tcp://0.0.0.0:5570",
        "tcp://127.0.0.1:0;192.168.1.5:5570",
        "tcp://192.168.1.5:0;127.0.0.1:5570",
    ],
)
def test_beyond_this_machine_nobody_is_believed_without_keys(address: str) -> None:
    for kind in (LosslessSubscriber, NewestSubscriber):
        for topic in ("frame", "keyframe", "map", "status"):
            with pytest.raises(TransportError, match=r"on another machine.*keys make.*ssh -L"):
                kind(address, (topic,))
    with pytest.raises(TransportError, match="on another machine"):
        LosslessSubscriber(["ipc:///tmp/well", address], ("frame",))
    with pytest.raises(TransportError, match=r"on another machine.*--server NAME"):
        QuerySocket(address, timeout_s=0.1, attempts=1)


def test_beyond_this_machine_who_is_known_by_a_key_may_be_connected_to(desk: Keys) -> None:
    robot = ServerIdentity(desk, "robot")
    for address in ("tcp://192.0.2.1:5570", "tcp://127.0.0.1:5570", "tcp://[::1]:5570", "tcp://localhost:5570"):
        check_connect(address, robot)
    check_connect("tcp://[::1]:5570")
    check_connect("tcp://localhost:5570")
    with (
        LosslessSubscriber("tcp://127.0.0.2:1", ("status",)),
        QuerySocket("tcp://192.0.2.1:5570", timeout_s=0.1, attempts=1, identity=robot),
    ):
        pass


@pytest.mark.parametrize("address", ["udp://127.0.0.1:1", "pgm://eth0;239.192.1.1:5555", "robot:5570", ""])
def test_other_transports_are_refused(address: str) -> None:
    with pytest.raises(TransportError, match="endpoints read"):
        QuerySocket(address, timeout_s=0.1, attempts=1)


def test_keys_are_made_once_and_only_their_user_can_read_them(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "k" / "keys")
    assert load_keys(keys.folder) == keys and keys.secret.decode() not in repr(keys)
    assert (keys.folder.stat().st_mode & 0o777, (keys.folder / "own.key_secret").stat().st_mode & 0o777) == (
        0o700,
        0o600,
    )
    with pytest.raises(TransportError, match="there are keys already"):
        make_keys(keys.folder)
    assert load_keys(keys.folder) == keys
    (keys.folder / "own.key_secret").chmod(0o644)
    with pytest.raises(TransportError, match="others can read the secret key"):
        load_keys(keys.folder)


def test_bad_keys_and_names_are_refused(tmp_path: Path, robot: Keys) -> None:
    with pytest.raises(TransportError, match="no keys here; make them"):
        load_keys(tmp_path / "nowhere")
    for name in ("", "../evil", "a b", ".hidden", "x" * 60):
        with pytest.raises(TransportError, match="cannot name a peer"):
            allow(robot.folder, name, robot.public.decode())
    for key in ("", "short", "ö" * 40, robot.public.decode()[:-1], robot.public.decode() + "a", "#" * 40):
        with pytest.raises(TransportError, match="is no public key"):
            allow(robot.folder, "desk", key)
    with pytest.raises(TransportError, match="no peer 'nobody' to forget; there are: none"):
        forget(robot.folder, "nobody")
    with pytest.raises(TransportError, match="no peer 'robot'"):
        QuerySocket("tcp://127.0.0.1:1", timeout_s=0.1, attempts=1, identity=ServerIdentity(robot, "robot"))
    (robot.folder / "peers" / "broken.key").write_text("nothing in here", encoding="utf-8")
    with pytest.raises(TransportError, match=r"broken\.key"):
        robot.peers()


class Relay:
    """Passes bytes on between clients that connect and an endpoint, and keeps a copy."""

    def __init__(self, endpoint: str, seen: bytearray) -> None:
        self._port = int(endpoint.rpartition(":")[2])
        self._seen = seen

    def __enter__(self) -> str:
        self._listening = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._run, daemon=True).start()
        return f"tcp://127.0.0.1:{self._listening.getsockname()[1]}"

    def __exit__(self, *_: object) -> None:
        self._listening.close()

    def _run(self) -> None:
        near, _ = self._listening.accept()
        far = socket.create_connection(("127.0.0.1", self._port))
        threading.Thread(target=self._copy, args=(near, far), daemon=True).start()
        self._copy(far, near)

    def _copy(self, source: socket.socket, target: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                self._seen += data
                target.sendall(data)
        except OSError:
            return


def test_the_authenticator_is_shared_by_all_servers_of_a_context(robot: Keys, desk: Keys) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    before = set(threading.enumerate())
    servers = [QueryServer("tcp://127.0.0.1:*", keys=robot, context=context) for _ in range(3)]
    assert len(set(threading.enumerate()) - before) == 1
    for server in servers:
        server.close()
