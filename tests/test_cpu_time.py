"""A quick test that uses too much CPU fails where a limit is given; its children count, and slow tests do not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TESTS = """
import subprocess, sys, time, pytest

BUSY = "import time\\nwhile time.process_time() < 0.5: pass"

@pytest.fixture(scope="module")
def shared():
    begun = time.process_time()
    while time.process_time() < begun + 0.5: pass

def test_fixture(shared): pass
def test_after(shared): pass
def test_child(): subprocess.run([sys.executable, "-c", BUSY], check=True)
def test_idle(): time.sleep(0.6)
@pytest.mark.slow
def test_slow(): subprocess.run([sys.executable, "-c", BUSY], check=True)
"""


@pytest.mark.parametrize("limit", [[], ["--cpu-limit", "0.2"]], ids=["no limit", "a limit"])
def test_cpu_seconds_of_setup_and_children_count_and_sleep_does_not(tmp_path: Path, limit: list[str]) -> None:
    (tmp_path / "test_it.py").write_text(TESTS, encoding="utf-8")
    words = [sys.executable, "-m", "pytest", "-c", "pyproject.toml", "-p", "tests.cpu_time", *limit, str(tmp_path)]
    done = subprocess.run([*words, "-p", "no:cacheprovider"], cwd=ROOT, capture_output=True, text=True)
    failed = {line.split("::")[1].split(" ")[0] for line in done.stdout.splitlines() if line.startswith("ERROR")}
    assert failed == ({"test_fixture", "test_child"} if limit else set()), done.stdout
    assert done.returncode == bool(limit) and ("the costliest" in done.stdout) == bool(limit)
