"""Who has no key of a peer gets nothing, and nothing is bound beyond this machine without keys."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from semantic_mapper.errors import TransportError
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import check_connect
from semantic_mapper.transport.keys import Keys, ServerIdentity, allow, forget, load_keys, make_keys
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher, QueryServer, QuerySocket

STATUS = Status(node="mapper", state="running", stamp_ns=1)


@pytest.fixture
def robot(tmp_path: Path) -> Keys:
    return make_keys(tmp_path / "robot")


@pytest.fixture
def desk(tmp_path: Path, robot: Keys) -> Keys:
    """Knows the robot, and is known to it."""
    keys = make_keys(tmp_path / "desk")
    allow(robot.folder, "desk", keys.public.decode())
    allow(keys.folder, "robot", robot.public.decode())
    return keys


@pytest.fixture
def unknown(tmp_path: Path, robot: Keys) -> Keys:
    """Knows the robot, which does not know it."""
    keys = make_keys(tmp_path / "unknown")
    allow(keys.folder, "robot", robot.public.decode())
    return keys


@pytest.fixture
def server(robot: Keys, desk: Keys) -> Iterator[str]:
    """Answers each question with itself, where other machines can reach it."""
    with_peer = QueryServer("tcp://0.0.0.0:*", keys=robot)
    closed = threading.Event()

    def answer() -> None:
        while not closed.is_set():
            with_peer.wait(0.02)
            while (request := with_peer.receive()) is not None:
                with_peer.send(*request)

    thread = threading.Thread(target=answer)
    thread.start()
    yield with_peer.endpoint.replace("0.0.0.0", "127.0.0.1")
    closed.set()
    thread.join()
    with_peer.close()


def query(endpoint: str, identity: ServerIdentity | None, timeout_s: float = 0.4) -> list[bytes]:
    with QuerySocket(endpoint, timeout_s=timeout_s, attempts=1, identity=identity) as client:
        return client.ask([b"hello", b"there"])


def test_peers_alone_are_answered_and_come_and_go_while_the_server_runs(
    server: str, robot: Keys, desk: Keys, unknown: Keys, tmp_path: Path
) -> None:
    known = ServerIdentity(desk, "robot")
    assert query(server, known, 10) == [b"hello", b"there"]
    with (
        structlog.testing.capture_logs() as logs,
        pytest.raises(TransportError, match="Does it know this machine's key"),
    ):
        query(server, ServerIdentity(unknown, "robot"))
    refusals = [e for e in logs if e["event"] == "unknown_key_refused"]
    assert refusals and refusals[0]["key"] == unknown.public.decode()
    with pytest.raises(TransportError, match="no answer"):
        query(server, None)  # in the clear
    allow(robot.folder, "unknown", unknown.public.decode())
    assert query(server, ServerIdentity(unknown, "robot"), 10) == [b"hello", b"there"]
    forget(robot.folder, "unknown")
    with pytest.raises(TransportError, match="no answer"):
        query(server, ServerIdentity(unknown, "robot"))
    allow(desk.folder, "robot", make_keys(tmp_path / "impostor").public.decode())
    with pytest.raises(TransportError, match="no answer"):
        query(server, ServerIdentity(desk, "robot"))  # has another key than the one that is known


def test_topics_reach_peers_alone(robot: Keys, desk: Keys, unknown: Keys) -> None:
    with (
        Publisher("tcp://127.0.0.1:*", keys=robot) as publisher,
        LosslessSubscriber(publisher.endpoint, ("status",), identity=ServerIdentity(desk, "robot")) as peer,
        LosslessSubscriber(publisher.endpoint, ("status",), identity=ServerIdentity(unknown, "robot")) as other,
        LosslessSubscriber(publisher.endpoint, ("status",)) as clear,
    ):
        peer.wait_until_heard(10)
        publisher.publish(encode(STATUS))
        assert peer.receive(10) == STATUS
        assert other.receive(0.2) is None and clear.receive(0) is None
        with pytest.raises(TransportError, match="Does it know this machine's key"):
            other.wait_until_heard(0.2)
        assert publisher.subscribers("status") == 1


def test_beyond_this_machine_nothing_is_bound_without_keys_and_peers(robot: Keys) -> None:
    for kind in (QueryServer, Publisher):
        for address in ("tcp://*:5555", "tcp://0.0.0.0:*", "tcp://[::]:5555", "tcp://192.168.1.5:5555", "tcp://eth0:5"):
            with pytest.raises(TransportError, match="needs keys on both sides"):
                kind(address)
        with pytest.raises(TransportError, match=r"nobody could connect.*no peers"):
            kind("tcp://0.0.0.0:*", keys=robot)


@pytest.mark.parametrize(
    "address",
    ["tcp://robot:5570", "tcp://[fe80::1]:5570", "tcp://127.0.0.1:0;192.168.1.5:5570", "tcp://192.0.2.1:0;127.0.0.1:5"],
)
def test_beyond_this_machine_nobody_is_believed_without_keys(address: str, desk: Keys) -> None:
    for kind in (LosslessSubscriber, NewestSubscriber):
        with pytest.raises(TransportError, match=r"on another machine.*keys make.*ssh -L"):
            kind(["ipc:///tmp/well", address], ("frame",))
    with pytest.raises(TransportError, match=r"on another machine.*--server NAME"):
        QuerySocket(address, timeout_s=0.1, attempts=1)
    check_connect(address, ServerIdentity(desk, "robot"))
    check_connect("tcp://[::1]:5570")


def test_keys_are_made_once_and_only_their_user_can_read_them(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "k" / "keys")
    secret = keys.folder / "own.key_secret"
    assert load_keys(keys.folder) == keys and keys.secret.decode() not in repr(keys)
    assert (keys.folder.stat().st_mode & 0o777, secret.stat().st_mode & 0o777) == (0o700, 0o600)
    with pytest.raises(TransportError, match="there are keys already"):
        make_keys(keys.folder)
    secret.chmod(0o644)
    with pytest.raises(TransportError, match="others can read the secret key"):
        load_keys(keys.folder)


def test_bad_keys_and_names_are_refused(tmp_path: Path, robot: Keys) -> None:
    with pytest.raises(TransportError, match="no keys here; make them"):
        load_keys(tmp_path / "nowhere")
    for name in ("", "../evil", "a b", ".hidden", "x" * 60):
        with pytest.raises(TransportError, match="cannot name a peer"):
            allow(robot.folder, name, robot.public.decode())
    for key in ("", "ö" * 40, robot.public.decode()[:-1], robot.public.decode() + "a", "#" * 40):
        with pytest.raises(TransportError, match="is no public key"):
            allow(robot.folder, "desk", key)
    with pytest.raises(TransportError, match="no peer 'nobody' to forget; there are: none"):
        forget(robot.folder, "nobody")
    with pytest.raises(TransportError, match="no peer 'robot'"):
        QuerySocket("tcp://127.0.0.1:1", timeout_s=0.1, attempts=1, identity=ServerIdentity(robot, "robot"))
    (robot.folder / "peers" / "broken.key").write_text("nothing in here", encoding="utf-8")
    with pytest.raises(TransportError, match=r"broken\.key"):
        robot.peers()
