from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from semantic_mapper.nodes.fleet import scratch
from semantic_mapper.nodes.fleet.scratch import DiskError, scratch_root, task_folder


@pytest.fixture(autouse=True)
def _own_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch.tempfile, "gettempdir", lambda: str(tmp_path))


def test_the_folder_is_private_and_goes_with_the_task() -> None:
    with task_folder(10, 0) as folder:
        (folder / "x").write_bytes(b"x")
        assert folder.stat().st_mode & 0o077 == 0
    assert not folder.exists()


def test_a_task_waits_until_there_is_room() -> None:
    order = []

    def second() -> None:
        with task_folder(60, 100):
            order.append("second")

    with task_folder(60, 100):
        thread = threading.Thread(target=second)
        thread.start()
        time.sleep(1.2)
        order.append("first")
    thread.join(30)
    assert order == ["first", "second"]


def test_a_task_that_never_fits_is_refused() -> None:
    with pytest.raises(DiskError, match="--worker-disk"), task_folder(200, 100):
        pass


def test_what_a_killed_task_has_left_is_removed() -> None:
    context = multiprocessing.get_context("fork")
    ready = context.Event()

    def hold() -> None:
        with task_folder(90, 100) as folder:
            (folder / "big").write_bytes(b"x")
            ready.set()
            time.sleep(60)

    process = context.Process(target=hold)
    process.start()
    assert ready.wait(30) and process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert any(p.is_dir() for p in scratch_root().iterdir())
    with task_folder(90, 100) as folder:
        assert [p for p in scratch_root().iterdir() if p.is_dir()] == [folder]
