"""The process that forks preloaded nodes: its nodes are children of the launcher, and outlive it."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from semantic_mapper.nodes.launcher import fork_server
from semantic_mapper.nodes.launcher.fork_server import ForkServer
from semantic_mapper.nodes.launcher.processes import NodeProcess, node_environment
from semantic_mapper.nodes.options import NodeJob
from tests.nodes.support import eventually


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[ForkServer]:
    monkeypatch.setenv("WATCHDOG_USEC", "1")
    made = ForkServer(node_environment())
    yield made
    made.close()
    made.close()


def job(tmp_path: Path, **options: object) -> NodeJob:
    return NodeJob(name="brain", options={"out": str(tmp_path / "out"), **options})


def start(tmp_path: Path, server: ForkServer) -> NodeProcess:
    """A mapper that waits for frames."""
    endpoints = {name: f"ipc://{tmp_path}/{name}" for name in ("brain", "camera", "query")}
    return NodeProcess("mapper", NodeJob(name="brain", options=job(tmp_path).options, endpoints=endpoints), server)


def pid_of(server: ForkServer) -> int:
    assert server._process is not None
    return server._process.pid


@pytest.mark.slow
def test_forked_nodes_are_children_of_the_launcher_and_the_server_may_die(tmp_path: Path, server: ForkServer) -> None:
    first = start(tmp_path, server)
    process = psutil.Process(first.pid)
    assert process.ppid() == os.getpid() and os.getpgid(first.pid) == first.pid
    assert b"WATCHDOG" not in Path(f"/proc/{first.pid}/environ").read_bytes()
    before = pid_of(server)
    os.kill(before, signal.SIGKILL)
    assert eventually(lambda: first.heartbeat.poll() or first.heartbeat.ready), "\n".join(first.tail)
    second = start(tmp_path / "second", server)
    assert pid_of(server) != before
    first.request_stop()
    assert first.wait(60) and first.exit_code() == 0
    second.kill()
    assert second.wait(60) and second.exit_code() == -signal.SIGKILL and second.has_failed()
    first.close()
    second.close()


@pytest.mark.slow
def test_a_frozen_server_is_replaced(tmp_path: Path, server: ForkServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server, "ANSWER_S", 0.5)
    start(tmp_path, server).close()
    before = pid_of(server)
    os.kill(before, signal.SIGSTOP)
    with pytest.raises(TimeoutError):
        start(tmp_path, server)
    assert not psutil.pid_exists(before)
    start(tmp_path, server).close()
