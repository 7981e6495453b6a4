"""A launcher that gets no process, no file and no thread goes on, and tries again; real processes and real limits."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RLIMIT_NOFILE, getrlimit, setrlimit

import pytest

from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.supervisor import node_process as process_module
from semantic_mapper.nodes.supervisor.launch_config import load_launch
from semantic_mapper.nodes.supervisor.managed_process import ManagedProcess
from semantic_mapper.nodes.supervisor.node_process import NodeProcess

LAUNCH = """
[[node]]
name = "eye"
kind = "camera"
restart = "{restart}"
backoff_s = 0.01
backoff_max_s = 0.01
[node.options]
log = "{log}"
mode = "realtime"
"""


@contextmanager
def files(limit: int) -> Iterator[None]:
    """No file may be opened whose number is not below the limit."""
    before = getrlimit(RLIMIT_NOFILE)
    setrlimit(RLIMIT_NOFILE, (limit, before[1]))
    try:
        yield
    finally:
        setrlimit(RLIMIT_NOFILE, before)


def open_files() -> int:
    gc.collect()  # what failures hold, and what other tests left
    return len(os.listdir("/proc/self/fd"))


def starter(tmp_path: Path, log: Path, *, restart: str = "on-failure") -> Callable[[], ManagedProcess]:
    """What starts the node; all that reads files is done."""
    path = tmp_path / "launch.toml"
    path.write_text(LAUNCH.format(restart=restart, log=log))
    launch = load_launch(path)
    endpoints = {name: f"ipc://{tmp_path}/{name}" for name in launch.sockets()}
    return lambda: ManagedProcess(launch.nodes[0], launch, endpoints, str(tmp_path))


def test_a_node_that_cannot_be_started_is_tried_again(log: Path, tmp_path: Path) -> None:
    before, start = open_files(), starter(tmp_path, log)
    with files(0):
        eye = start()
        assert eye.process is None and eye.runs and eye.state == "starting" and eye.restarts == 1
        assert "could not be started: [Errno 24]" in eye.warnings[0]
        time.sleep(0.05)
        eye.look_after(last=False)
        assert eye.process is None and eye.restarts == 2
    assert open_files() == before
    time.sleep(0.05)
    eye.look_after(last=False)
    assert eye.process is not None and eye.process.exit_code() is None
    eye.close()
    assert open_files() == before


def test_a_node_that_is_not_to_come_back_is_given_up_with_the_reason(log: Path, tmp_path: Path) -> None:
    start = starter(tmp_path, log, restart="never")
    with files(0):
        eye = start()
    assert not eye.runs and eye.state == "ended"
    assert eye.failure.startswith("node 'eye' (camera) could not be started: [Errno 24]")
    eye.look_after(last=True)
    eye.close()


def test_a_launch_that_ends_says_what_could_not_be_started(log: Path, tmp_path: Path) -> None:
    start = starter(tmp_path, log)
    with files(0):
        eye = start()
        eye.look_after(last=True)
    assert "could not be started" in eye.failure and "had not been restarted yet" in eye.failure


@pytest.mark.slow
def test_wherever_a_start_fails_nothing_is_left_behind(log: Path) -> None:
    job = NodeJob(name="eye", options={"log": str(log)})
    highest = max(map(int, os.listdir("/proc/self/fd")))
    fillers = []  # so that all files from now on have the numbers after it
    while not fillers or fillers[-1] < highest:
        fillers.append(os.open(os.devnull, os.O_RDONLY))
    before, failures = open_files(), 0
    try:
        for more in range(1, 30):
            with files(fillers[-1] + more):
                try:
                    child = NodeProcess("camera", job)
                except OSError:
                    failures += 1
                    child = None
            if child is not None:
                child.close()
                break
            assert open_files() == before, more
        assert failures >= 4 and child is not None, "pipe, job, process"
        assert open_files() == before
    finally:
        for fd in fillers:
            os.close(fd)


def test_without_a_thread_no_process_is_left_behind(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, others, started = open_files(), children(), []

    def no_thread(thread: threading.Thread) -> None:
        started.extend(children() - others)  # others: what other tests left to this process, as a resource tracker
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", no_thread)
        with pytest.raises(OSError, match="no thread that reads what 'eye' says"):
            NodeProcess("camera", NodeJob(name="eye", options={"log": str(log)}))
    assert len(started) == 1 and not children() - others
    assert open_files() == before


def children() -> set[int]:
    """Process ids of this process's children, those that ended and were not waited for among them."""
    return {int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and parent(p) == os.getpid()}


def parent(process: Path) -> int:
    try:
        return int((process / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1])
    except OSError:
        return 0


def test_a_process_that_does_not_die_holds_nobody_up(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_module, "KILL_S", 0.1)
    child = NodeProcess("camera", NodeJob(name="eye", options={"log": str(log)}))
    monkeypatch.setattr(child._process, "send_signal", lambda signum: None)  # as where the kernel waits for a device
    closing = threading.Thread(target=child.close, daemon=True)
    closing.start()
    closing.join(20)
    held_up = closing.is_alive()
    os.kill(child.pid, signal.SIGKILL)
    assert child.wait(20) and not held_up
