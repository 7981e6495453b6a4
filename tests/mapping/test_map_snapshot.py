"""A map is saved as it was at one moment, whatever happens to it meanwhile."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import MapError
from semantic_mapper.mapping import blocks, map_snapshot
from semantic_mapper.mapping.block_grid import LEAST_RESIDENT, BlockGrid
from semantic_mapper.mapping.blocks import BlockValues, pack_keys
from semantic_mapper.mapping.map_file import MapManifest, describe_map
from semantic_mapper.mapping.map_snapshot import FrozenMap
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.rendered_views import LABELS, small_map
from tests.mapping.test_blocks import CLASSES, some_blocks
from tests.mapping.test_paging import MEMORY_MB, walk
from tests.mapping.test_voxel_map import same

BLOCKS = 700
KEYS = pack_keys(np.stack(np.unravel_index(np.arange(BLOCKS), (10, 10, 7)), axis=1).astype(np.int32))


def filled_grid(memory_bytes: int) -> BlockGrid:
    grid = BlockGrid(0.02, CLASSES, 64, 10_000, memory_bytes)
    for start in range(0, BLOCKS, 200):
        part = KEYS[start : start + 200]
        grid.fill(part, some_blocks(len(part), start))
    return grid


def snapshot_of(grid: BlockGrid) -> FrozenMap:
    manifest = MapManifest(config=VoxelMapConfig(), label_set=LABELS, frames=1, last_stamp_ns=0)
    return FrozenMap(grid, threading.Lock(), manifest, (), b"")


@pytest.mark.parametrize("most_in_memory", [map_snapshot.MOST_IN_MEMORY, 30], ids=["copies in memory", "on disk"])
@pytest.mark.parametrize("memory_bytes", [0, 1], ids=["in memory", "most blocks on disk"])
def test_a_snapshot_does_not_change_with_the_grid(
    memory_bytes: int, most_in_memory: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_snapshot, "MOST_IN_MEMORY", most_in_memory)
    monkeypatch.setattr(map_snapshot, "CHUNK_BLOCKS", 100)
    grid = filled_grid(memory_bytes)
    assert grid.stored_count >= BLOCKS - LEAST_RESIDENT if memory_bytes else grid.stored_count == 0
    before = grid.read(KEYS)
    new = pack_keys(np.array([[-5, 0, 0], [3, 3, 90], [50, 0, 0]], np.int32))
    snapshot = snapshot_of(grid)

    def changing(last: bool) -> Iterator[BlockValues]:
        for _, values in snapshot.parts(last=last):
            yield values
            keys = np.sort(np.append(rng.choice(KEYS, 120, replace=False), new))
            grid.fill(keys, some_blocks(len(keys), 9999))

    for last in (False, True):
        parts = list(changing(last))
        now = grid.read(KEYS)
        for n, name in enumerate(BlockValues._fields):
            assert b"".join(part[n].tobytes() for part in parts) == before[n].tobytes() != now[n].tobytes(), name
    snapshot.close()
    assert not grid.watchers and grid.block_count == BLOCKS + 3


def test_a_full_disk_fails_the_snapshot_and_not_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = filled_grid(0)

    def tiny(*arguments: object, **options: object) -> sqlite3.Connection:
        database = connect(*arguments, **options)  # type: ignore[call-overload]
        database.execute("PRAGMA max_page_count = 4")
        return database

    connect = sqlite3.connect
    monkeypatch.setattr(map_snapshot, "MOST_IN_MEMORY", 20)
    monkeypatch.setattr(blocks.sqlite3, "connect", tiny)
    snapshot = snapshot_of(grid)
    changed = some_blocks(100, 5)
    grid.fill(KEYS[300:400], changed)
    assert grid.read(KEYS[300:400]).tsdf.tobytes() == changed.tsdf.tobytes()
    with pytest.raises(MapError, match="full"):
        next(snapshot.parts())
    snapshot.close()


def test_a_map_that_is_saved_while_it_grows_is_that_of_one_frame(tmp_path: Path) -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=MEMORY_MB)
    walk(voxel_map, 5)
    path = tmp_path / "map.npz"
    saver = threading.Thread(target=voxel_map.save, args=(path,))
    saver.start()
    walk(voxel_map, 4, first=3)  # back to what is there already, and on
    saver.join()
    saved = describe_map(path).frames
    reference = small_map(voxel_size_m=0.01)
    walk(reference, 5)
    walk(reference, saved - 5, first=3)
    assert same(VoxelMap.load(path, memory_mb=0).block_state(), reference.block_state())
