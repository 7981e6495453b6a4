"""What a launcher knows of a node from its heartbeats, and limits that count while nothing gets on."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from semantic_mapper.nodes.launcher import liveness
from semantic_mapper.nodes.launcher.liveness import (
    ENDING,
    FRAME,
    RUNNING,
    STARTING,
    TURN,
    HeartbeatMonitor,
    ProgressLimit,
    is_active,
)
from tests.nodes.support import eventually

LIMIT_S = 300.0
SLEEPS = "import time; print(flush=True); time.sleep(600)"
BUSY = "print(flush=True)\nwhile True: pass"


def test_launcher_knows_from_the_pipe_how_far_a_node_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr(liveness, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    read, write = os.pipe()
    monitor = HeartbeatMonitor(read, os.getpid(), 30.0)
    monitor.poll()
    os.write(write, STARTING)
    monitor.poll()
    assert not monitor.ready and monitor.stalled_s is None
    os.write(write, RUNNING + TURN + RUNNING)
    monitor.poll()
    assert monitor.ready and not monitor.ending and monitor.stalled_s == 0 and monitor.frame_age_s is None
    now_s[0] += 2
    os.write(write, RUNNING + FRAME + FRAME)  # lives, but its main loop does not come round
    monitor.poll()
    assert (monitor.silent_s, monitor.stalled_s, monitor.frames, monitor.frame_age_s) == (0, 2, 2, 0)
    os.write(write, ENDING)
    monitor.poll()
    assert monitor.ready and monitor.ending and monitor.stalled_s is None
    os.close(write)
    monitor.poll()  # has ended: no sign of life
    os.close(read)


@pytest.mark.parametrize(
    ("program", "stopped", "hangs"), [(SLEEPS, False, True), (BUSY, False, False), (BUSY, True, True)]
)
def test_a_frozen_process_is_no_busy_one(
    program: str, stopped: bool, hangs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(liveness, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"\n"
    if stopped:
        process.send_signal(signal.SIGSTOP)
    if hangs:
        assert eventually(lambda: not is_active(process.pid), 30)
    read, write = os.pipe()
    monitor = HeartbeatMonitor(read, process.pid, 0.2)
    os.write(write, RUNNING)
    assert not monitor.find_hang(stopping=False)
    now_s[0] += 0.15
    assert not monitor.find_hang(stopping=False), "it is not silent for long enough"
    now_s[0] += 0.2
    assert bool(monitor.find_hang(stopping=False)) == hangs
    os.write(write, RUNNING)
    assert not monitor.find_hang(stopping=False), "it lives"
    process.kill()
    process.wait()
    os.close(write)
    os.close(read)


HUNG = """
import ctypes, sys
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
heartbeat = HeartbeatWriter(int(sys.argv[1]), 1)
heartbeat.start()
heartbeat.ready()
print("beats", flush=True)
ctypes.PyDLL(None).sleep(600)  # keeps the interpreter's lock: no thread runs, no Python handler either
"""


def test_kernel_ends_a_process_that_hangs_with_all_its_threads() -> None:
    read, write = os.pipe()
    hung = subprocess.Popen([sys.executable, "-c", HUNG, str(write)], pass_fds=(write,), stdout=subprocess.PIPE)
    os.close(write)
    assert hung.stdout is not None and hung.stdout.readline() == b"beats\n"
    assert hung.wait(60) == -signal.SIGALRM
    os.close(read)  # only now: it cannot have heard of that


@dataclass
class Process:
    """Its time on the clock and on the processor."""

    now_s: float = 1000.0
    cpu_s: float = 7.0

    def limit(self) -> ProgressLimit:
        return ProgressLimit(LIMIT_S, lambda: self.cpu_s, lambda: self.now_s)

    def runs_until(self, limit: ProgressLimit, *, within_s: float, cpu: float, mark_every_s: float = 0.0) -> float:
        """Seconds until it is given up; ``within_s`` where it is not. It has the fraction ``cpu`` of a core."""
        for second in range(round(within_s)):
            self.now_s += 1
            self.cpu_s += cpu
            if limit.exceeded(second // mark_every_s if mark_every_s else None):
                return second
        return within_s


def test_what_gets_on_may_take_as_long_as_it_likes_and_what_does_not_is_given_up_at_the_limit() -> None:
    process = Process()
    limit = process.limit()
    for cpu, mark_every_s in ((0.0, 280), (0.02, 0), (0.5, 100)):
        assert process.runs_until(limit, within_s=9000, cpu=cpu, mark_every_s=mark_every_s) == 9000
    for cpu in (0.0, 0.0005, 1.0):  # does nothing, writes heartbeats alone, computes for ever
        process = Process()
        limit = process.limit()
        assert process.runs_until(limit, within_s=1000, cpu=0.5, mark_every_s=100) == 1000
        assert LIMIT_S <= process.runs_until(limit, within_s=9000, cpu=cpu) <= 1.1 * LIMIT_S
