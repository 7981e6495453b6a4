"""A launcher that gets no process, no file and no thread goes on, and tries again; real processes and real limits."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RLIMIT_NOFILE, getrlimit, setrlimit

import pytest

from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.supervisor import managed_process as managed_module
from semantic_mapper.nodes.supervisor import node_process as process_module
from semantic_mapper.nodes.supervisor.launch_config import load_launch
from semantic_mapper.nodes.supervisor.managed_process import ManagedProcess
from semantic_mapper.nodes.supervisor.node_process import NodeProcess
from semantic_mapper.nodes.supervisor.progress import ProgressLimit
from tests.nodes.support import eventually

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


# A node that writes its results one step after the other, whenever a file says so.
WRITER = """
import sys, time
from pathlib import Path
from semantic_mapper.nodes.node import run_node
from semantic_mapper.nodes.options import CameraOptions

def work(context, options):
    context.heartbeat.ready()
    while not context.stop:
        time.sleep(0.01)
    context.heartbeat.ending()
    folder, step = Path(options.log).parent, 0
    while not (folder / "done").exists():
        if (folder / f"step-{step}").exists():
            time.sleep(0.25)  # turns are told five times a second at most
            context.heartbeat.turn()
            step += 1
        time.sleep(0.01)

run_node(CameraOptions, work)
"""


def test_a_node_that_writes_results_is_killed_where_it_is_stuck_not_where_it_is_slow(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, limit_s = 1000.0, 15.0

    def interpreter(kind: str, job: int, beats: int, output: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-I", "-c", WRITER, f"fd:{job}"]
        return subprocess.Popen(command, stdout=output, stderr=output, pass_fds=(beats, job))

    def limit(seconds: float, cpu_s: Callable[[], float]) -> ProgressLimit:
        return ProgressLimit(seconds, lambda: 0.0, lambda: now_s)

    monkeypatch.setattr(process_module, "_start_interpreter", interpreter)
    monkeypatch.setattr(managed_module, "ProgressLimit", limit)
    (tmp_path / "room.mcap").symlink_to(log)
    eye = starter(tmp_path, tmp_path / "room.mcap", restart="never")()
    assert eye.process is not None
    beat = eye.process.heartbeat
    assert eventually(lambda: beat.poll() or beat.ready, 60), eye.process.tail
    eye.ask_to_stop()
    assert eventually(lambda: beat.poll() or beat.ending, 60)
    for step in range(5):  # four times the limit in all
        now_s += 0.8 * limit_s
        assert eye.gets_on(limit_s)
        before = beat.turns
        (tmp_path / f"step-{step}").touch()
        assert eventually(lambda n=before: beat.poll() or beat.turns > n, 60)
        assert eye.gets_on(limit_s)
    now_s += 1.1 * limit_s
    assert not eye.gets_on(limit_s)
    eye.overstay(limit_s)
    assert "killed by SIGKILL (it did not end, and made no progress for 15 s)" in eye.failure
    eye.close()


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
