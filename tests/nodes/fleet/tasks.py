"""What workers do in tests of the scheduler; the folder to leave traces in comes as a tag."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from semantic_mapper.errors import LogError, StoreError
from semantic_mapper.nodes.fleet.scratch import DiskError
from semantic_mapper.nodes.fleet.worker import Outcome, Task


def note(task: Task) -> Outcome:
    """Leave a trace of every attempt."""
    _trace(task)
    return Outcome(task.url, "done")


def fail_for_bad(task: Task) -> Outcome:
    """``bad*`` always fails, ``once*`` fails at the first attempt."""
    _trace(task)
    if task.url.startswith("bad") or (task.url.startswith("once") and task.attempt == 1):
        raise LogError(f"{task.url}: cannot be read")
    return Outcome(task.url, "done")


def die_for_bad(task: Task) -> Outcome:
    """``bad*`` always kills its process, ``once*`` at the first attempt."""
    _trace(task)
    if task.url.startswith("bad") or (task.url.startswith("once") and task.attempt == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(task.url, "done")


def miss_store_once(task: Task) -> Outcome:
    """The store is away at first."""
    _trace(task)
    if task.attempt == 1 and task.url == "first":
        raise StoreError("the store is away")
    return Outcome(task.url, "done")


def miss_store(task: Task) -> Outcome:
    """The store is away for good."""
    raise StoreError("the store is away")


def refuse_company(task: Task) -> Outcome:
    """Fail where another task runs at the same time."""
    mark = Path(task.tags["traces"]) / f"running.{task.url}.{task.attempt}"
    mark.touch()
    time.sleep(0.2)
    together = len(list(mark.parent.glob("running.*")))
    mark.unlink()
    if together > 1:
        raise LogError(f"{together} at a time")
    return Outcome(task.url, "done")


def need_company(task: Task) -> Outcome:
    """Fail where no other task comes while this one runs."""
    folder = Path(task.tags["traces"])
    (folder / f"came.{task.url}").touch()
    deadline = time.monotonic() + 120
    while len(list(folder.glob("came.*"))) < 2:
        if time.monotonic() > deadline:
            raise LogError("alone")
        time.sleep(0.05)
    return Outcome(task.url, "done")


def fill_disk(task: Task) -> Outcome:
    """There is no room on this machine."""
    raise DiskError("the disk is full")


def miss_one_log(task: Task) -> Outcome:
    """``far`` cannot be reached, all others can."""
    _trace(task)
    if task.url == "far":
        raise StoreError("far: cannot be reached")
    return Outcome(task.url, "done")


def sleep_for_slow(task: Task) -> Outcome:
    """``slow`` takes for ever, all others a second."""
    time.sleep(300 if task.url == "slow" else 1)
    return Outcome(task.url, "done")


def sleep_long(task: Task) -> Outcome:
    """Run until ended."""
    _trace(task)
    time.sleep(300)
    return Outcome(task.url, "done")


def _trace(task: Task) -> None:
    (Path(task.tags["traces"]) / f"{task.url}.{task.attempt}").touch(exist_ok=False)
