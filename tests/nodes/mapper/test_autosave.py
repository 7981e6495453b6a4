"""Maps are saved while frames go on, and what a killed mapper leaves is the map of some frame."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

from semantic_mapper.mapping import map_file
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS, describe_map
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.saved_map import Autosave
from tests.mapping.rendered_views import small_map
from tests.mapping.test_paging import walk
from tests.mapping.test_voxel_map import same
from tests.nodes.support import (
    REPLAY_LAUNCH,
    Running,
    eventually,
    launch_settings,
    repeated_frames,
    run_ok,
    write_config,
    write_log,
)

ALWAYS = 1e-9  # seconds


@pytest.mark.slow
@pytest.mark.usefixtures("replayed")  # kernels of the process that compiles them differ in the last bits
def test_a_killed_mapper_leaves_the_map_of_a_frame(weights: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "long.mcap", repeated_frames(400))
    config = write_config(tmp_path / "fine.toml")
    config.write_text(config.read_text().replace("voxel_size_m = 0.05", "voxel_size_m = 0.015"), encoding="utf-8")
    out, again = tmp_path / "up", tmp_path / "again"
    settings = launch_settings(log, weights, config, "mapper.save_every_s=0.3", "mapper.query=")
    with Running("up", REPLAY_LAUNCH, *settings, "--out", out) as running:
        first = int(running.wait_for_line(r"map_saved").split("frames=")[1].split()[0])
        assert eventually(lambda: describe_map(out / "map.npz").frames > first)  # another in its place
        time.sleep(0.2)
        os.kill(running.node_pid("mapper"), signal.SIGKILL)
        assert running.wait() == 1, running.text
    saved = VoxelMap.load(out / "map.npz")
    assert first < saved.frames < 400 and saved.block_count > 2 * CHUNK_BLOCKS
    assert not (out / "summary.json").exists(), "nothing says that the results are whole"
    options = ("--weights", weights, "--config", config, "--max-frames", str(saved.frames))
    run_ok("map", log, "--out", again, *options)
    assert same(saved.block_state(), VoxelMap.load(again / "map.npz").block_state())


@pytest.fixture
def slow_writing(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    """Writing a chunk waits until it is released."""
    allowed, write = threading.Semaphore(0), map_file._write_chunk

    def waiting(*arguments: object) -> object:
        allowed.acquire()
        return write(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(map_file, "_write_chunk", waiting)
    return allowed


def test_what_is_saved_is_the_map_when_the_save_began(tmp_path: Path, slow_writing: threading.Semaphore) -> None:
    voxel_map, path = small_map(voxel_size_m=0.01), tmp_path / "map.npz"
    autosave = Autosave(voxel_map, path, ALWAYS)
    autosave.follow()
    walk(voxel_map, 3)
    chunks = -(-voxel_map.block_count // CHUNK_BLOCKS)
    assert chunks > 2
    then = voxel_map.block_state()
    autosave.follow()
    for n in range(chunks):
        autosave.follow()  # one at a time
        walk(voxel_map, 1, first=n)
        slow_writing.release()
    assert eventually(lambda: autosave.saves == 1)
    saved = VoxelMap.load(path)
    assert saved.frames == 3 and same(saved.block_state(), then)
    assert not same(voxel_map.block_state(then["keys"]), then)  # type: ignore[arg-type]
    autosave.follow()
    slow_writing.release(100)
    assert eventually(lambda: autosave.saves == 2)
    assert same(VoxelMap.load(path).block_state(), voxel_map.block_state())
    before = path.stat().st_ino
    autosave.follow()
    autosave.close()
    assert (autosave.saves, path.stat().st_ino) == (2, before), "nothing has changed since"


def test_at_the_end_a_save_under_way_is_given_up(tmp_path: Path, slow_writing: threading.Semaphore) -> None:
    voxel_map, path = small_map(voxel_size_m=0.01), tmp_path / "map.npz"
    path.write_bytes(b"the one before")
    autosave = Autosave(voxel_map, path, ALWAYS)
    walk(voxel_map, 3)
    autosave.follow()
    closing = threading.Thread(target=autosave.close)
    closing.start()
    slow_writing.release()  # the first of several chunks
    closing.join(20)
    assert not closing.is_alive() and autosave.saves == 0 and not autosave.failure
    assert path.read_bytes() == b"the one before" and list(tmp_path.iterdir()) == [path]
    slow_writing.release(100)
    voxel_map.save(path)
    assert describe_map(path).frames == 3


def test_a_save_that_dies_is_reported_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    voxel_map, path = small_map(voxel_size_m=0.02), tmp_path / "map.npz"
    autosave = Autosave(voxel_map, path, ALWAYS)
    walk(voxel_map, 1)

    monkeypatch.setattr(map_file, "_write_chunk", Mock(side_effect=MemoryError("a chunk")))
    autosave.follow()
    assert eventually(lambda: autosave.failure == "MemoryError: a chunk", 20)
    assert autosave.status().warnings == ("the map was not saved: MemoryError: a chunk",)
    monkeypatch.undo()
    assert eventually(lambda: autosave.follow() or autosave.saves == 1) and not autosave.status().warnings
    assert describe_map(path).frames == 1
    autosave.close()
