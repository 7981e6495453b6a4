"""Busy processes run beside a command, and never outlive it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.nodes.support import eventually

ROOT = Path(__file__).resolve().parents[2]
# Says who runs beside it, then waits to be told how to end.
COMMAND = (
    "import os, sys, psutil\n"
    "print(*(p.pid for p in psutil.Process(os.getppid()).children() if p.pid != os.getpid()), flush=True)\n"
    "sys.exit(int(sys.stdin.readline()))"
)


def start(count: int) -> tuple[subprocess.Popen[str], list[psutil.Process]]:
    words = [sys.executable, "-m", "tools.beside_load", str(count), sys.executable, "-c", COMMAND]
    process = subprocess.Popen(words, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    return process, [psutil.Process(int(pid)) for pid in process.stdout.readline().split()]


def test_a_command_runs_beside_busy_processes_and_gives_its_exit_code() -> None:
    process, busy = start(2)
    assert len(busy) == 2
    assert eventually(lambda: all(sum(one.cpu_times()[:2]) > 0.1 for one in busy), 60)
    process.communicate("3\n")
    assert process.returncode == 3 and not any(one.is_running() for one in busy)


def test_busy_processes_end_with_the_one_that_started_them() -> None:
    process, busy = start(1)
    process.kill()
    process.communicate()
    assert eventually(lambda: not any(map(is_alive, busy)), 60)


def is_alive(process: psutil.Process) -> bool:
    """Whether it runs; one that has ended and that nobody has waited for does not."""
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


@pytest.mark.parametrize("words", [[], ["2"], ["two", "true"]])
def test_wrong_usage_is_told(words: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", "tools.beside_load", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "COUNT COMMAND" in done.stderr
