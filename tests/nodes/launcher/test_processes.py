"""Node processes: started, restarted, ended, and nothing left behind; real processes and real limits."""

import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RLIMIT_NOFILE, getrlimit, setrlimit

import pytest
import structlog.testing

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.launcher import processes
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.nodes.launcher.liveness import ProgressLimit
from semantic_mapper.nodes.launcher.processes import ManagedProcess, NodeProcess
from semantic_mapper.nodes.node import read_job
from semantic_mapper.nodes.options import NodeJob
from tests.nodes.support import eventually

WORD = "a-word-that-others-must-not-read"
LAUNCH = """
restart = "{restart}"
[[node]]
name = "eye"
kind = "camera"
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


def test_a_node_that_cannot_start_is_tried_again(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "BACKOFF_MAX_S", 0.01)
    before, start = open_files(), starter(tmp_path, log)
    with files(0):
        eye, other = start(), start()
        assert eye.process is None and eye.runs and eye.state == "starting" and eye.restarts == 1
        assert "could not be started: [Errno 24]" in eye.warnings[0]
        time.sleep(0.05)
        eye.look_after(last=False)
        assert eye.process is None and eye.restarts == 2
        other.look_after(last=True)
        assert "could not be started" in other.failure and "had not been restarted yet" in other.failure
    assert open_files() == before
    time.sleep(0.05)
    eye.look_after(last=False)
    assert eye.process is not None and eye.process.exit_code() is None
    eye.close()
    assert open_files() == before


def test_pauses_double_up_to_their_limit(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "BACKOFF_S", 0.001)
    monkeypatch.setattr(processes, "BACKOFF_MAX_S", 0.008)
    start = starter(tmp_path, log)
    with files(0), structlog.testing.capture_logs() as logs:
        eye = start()
        while eye.restarts < 6:
            eye.look_after(last=False)
    pauses = [entry["in_s"] for entry in logs if entry["event"] == "node_restarts"]
    assert pauses == [0.001, 0.002, 0.004, 0.008, 0.008, 0.008]


def test_a_node_is_given_up_with_the_reason_where_it_must_not_restart(log: Path, tmp_path: Path) -> None:
    start = starter(tmp_path, log, restart="never")
    with files(0):
        eye = start()
    assert not eye.runs and eye.state == "ended"
    assert eye.failure.startswith("node 'eye' (camera) could not be started: [Errno 24]")
    eye = start()
    assert eye.process is not None
    os.kill(eye.process.pid, signal.SIGKILL)
    assert eye.process.wait(30)
    eye.look_after(last=False)
    assert "'eye' (camera) ended: killed by SIGKILL" in eye.failure
    eye.close()


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
            time.sleep(0.25)  # turns are written five times a second at most
            context.heartbeat.turn()
            step += 1
        time.sleep(0.01)

run_node(CameraOptions, work)
"""


def test_a_node_is_killed_where_it_is_stuck_not_slow(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, limit_s = 1000.0, 15.0

    def interpreter(kind: str, job: int, beats: int) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-I", "-c", WRITER, f"fd:{job}"]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, pass_fds=(beats, job))

    monkeypatch.setattr(processes, "_start_interpreter", interpreter)
    monkeypatch.setattr(processes, "ProgressLimit", lambda s, cpu_s: ProgressLimit(s, lambda: 0.0, lambda: now_s))
    (tmp_path / "room.mcap").symlink_to(log)
    eye = starter(tmp_path, tmp_path / "room.mcap", restart="never")()
    assert eye.process is not None
    beat = eye.process.heartbeat
    assert eventually(lambda: beat.poll() or beat.ready, 60), eye.process.tail
    eye.request_stop()
    assert eventually(lambda: beat.poll() or beat.ending, 60)
    for step in range(5):  # four times the limit in all
        now_s += 0.8 * limit_s
        assert eye.makes_progress(limit_s)
        before = beat.turns
        (tmp_path / f"step-{step}").touch()
        assert eventually(lambda n=before: beat.poll() or beat.turns > n, 60)
        assert eye.makes_progress(limit_s)
    now_s += 1.1 * limit_s
    assert not eye.makes_progress(limit_s)
    eye.kill_overdue(limit_s)
    assert "killed by SIGKILL (it did not end, and made no progress for 15 s)" in eye.failure
    eye.close()


def test_a_job_is_seen_by_its_node_and_in_no_list_of_processes(tmp_path: Path) -> None:
    long = "x" * 200_000  # more than one argument or a pipe holds
    options = {"log": f"{tmp_path}/{WORD}.mcap"}
    child = NodeProcess("camera", NodeJob(name="eye", options=options, endpoints={"other": long}))
    try:
        for name in ("cmdline", "environ"):
            assert WORD not in Path(f"/proc/{child.pid}/{name}").read_text(errors="replace")
        assert child.wait(60)
        assert WORD in child.describe_end(), "it knows where its log is"
    finally:
        child.close()
    for argument in ("fd:99999", "{"):
        with pytest.raises(ConfigError, match="must be JSON, or fd:N"):
            read_job(argument)
