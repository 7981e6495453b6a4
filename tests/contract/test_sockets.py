"""A running mapper as any program sees it: plain ZeroMQ sockets, golden questions in, and messages that decode."""

import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from semantic_mapper.queries.questions import QUESTIONS, decode_answer
from semantic_mapper.transport.codec import decode
from semantic_mapper.transport.messages import Status
from semantic_mapper.types import MapUpdate
from tests.contract import entry_points as api
from tests.contract.golden import LOG, ROOM_SETTINGS, WEIGHTS, form, lacking, parts_of, read

LAUNCH = """
[[node]]
name = "mapper"
kind = "mapper"
[node.options]
input = "camera"
delivery = "newest"
out = "{out}"

[[node]]
name = "camera"
kind = "camera"
[node.options]
log = ""
mode = "realtime"
rate = 0.01
"""
_WIRE: dict[str, Any] = read("wire")


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, subprocess.Popen[str], Path]]:
    """Folder of the sockets, launcher, results; a frame comes every thirteen seconds."""
    folder = tmp_path_factory.mktemp("sockets")
    (folder / "up.toml").write_text(LAUNCH)
    (folder / "room.toml").write_text(ROOM_SETTINGS + "[history]\nmax_frames = 100\n")
    with tempfile.TemporaryDirectory(prefix="sm-") as place:
        values = {"camera.log": LOG, "mapper.weights": WEIGHTS, "mapper.config": folder / "room.toml"}
        values |= {"mapper.query": f"ipc://{place}/query", "mapper.publish": f"ipc://{place}/updates"}
        settings = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
        process = subprocess.Popen(
            [str(api.COMMAND), "up", str(folder / "up.toml"), *settings, "--out", str(folder / "out")],
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            yield Path(place), process, folder / "out"
        finally:
            process.kill()
            process.communicate()


def ask(place: Path, parts: list[bytes], timeout_s: float = 30.0) -> list[bytes] | None:
    """One question through a socket of its own."""
    with zmq.Context.instance().socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"ipc://{place}/query")
        socket.send_multipart(parts)
        return socket.recv_multipart() if socket.poll(int(timeout_s * 1000)) else None


def wait_for_map(place: Path, process: subprocess.Popen[str]) -> None:
    """Until the first frames are in the map."""
    parts = parts_of(_WIRE["questions"]["info"]["parts"])
    deadline = time.monotonic() + api.TIMEOUT_S
    while time.monotonic() < deadline and process.poll() is None:
        answer = ask(place, parts, 2.0)
        if answer is not None and answer[0] == b"info" and msgpack.unpackb(answer[1])["answer"]["blocks"] > 0:
            return
    raise AssertionError("no map within the time")


@pytest.mark.slow
def test_a_running_mapper_speaks_as_then(running: tuple[Path, subprocess.Popen[str], Path]) -> None:
    place, process, out = running
    wait_for_map(place, process)
    for name, question in _WIRE["questions"].items():
        kind, answer = question["kind"], ask(place, parts_of(question["parts"]))
        assert answer is not None, f"{name}: no answer"
        assert answer[0] == kind.encode(), f"{name}: {answer[:2]}"
        then = parts_of(_WIRE["answers"].get(name, _WIRE["answers"][kind])["parts"])
        assert lacking(form(msgpack.unpackb(then[1])), form(msgpack.unpackb(answer[1]))) == []
        assert len(answer) == len(then)
        decode_answer(kind, QUESTIONS[kind].answer, answer)
    strange = ask(place, [b"fly", b"\x80"])
    assert strange is not None and strange[0] == b"error"
    with zmq.Context.instance().socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        for topic in (b"map/", b"status/"):
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        socket.connect(f"ipc://{place}/updates")
        found: dict[str, Any] = {}
        deadline = time.monotonic() + 60
        while len(found) < 2 and time.monotonic() < deadline:
            if socket.poll(1000):
                parts = socket.recv_multipart()
                found[parts[0].decode()] = decode(parts)
    assert isinstance(found["map/rooms/"], MapUpdate) and isinstance(found["status/mapper/"], Status)
    assert found["map/rooms/"].label.shape == (72, 96) and found["status/mapper/"].state == "running"
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=api.TIMEOUT_S)
    assert process.returncode == 0, told
    assert (out / "summary.json").is_file() and (out / "map.npz").is_file()
