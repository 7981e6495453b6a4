"""Processes that save maps are killed at any moment, and what they leave is a whole map."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from semantic_mapper.mapping.files.map_file import describe_map
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.files.crash_child import map_and_save, save_where_files_stay_small, start_child
from tests.mapping.rendered_views import small_map
from tests.mapping.storage.test_paging import walk
from tests.mapping.test_voxel_map import fuse_sphere, same

SAVERS_KILLED = 47
MAPPERS_KILLED = 3


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """A map, and what two more frames make of it, and two more."""
    voxel_map = small_map(voxel_size_m=0.03)
    paths = [tmp_path / f"frames-{count}.npz" for count in (3, 5, 7)]
    for frames, path in zip((3, 2, 2), paths, strict=True):
        fuse_sphere(voxel_map, frames)
        voxel_map.save(path)
    return paths


@pytest.mark.slow
def test_a_killed_mapper_with_blocks_on_disk_leaves_the_map_of_some_frame(tmp_path: Path) -> None:
    reference = small_map(voxel_size_m=0.01)
    rng = random.Random(1)
    left: list[tuple[int, Path]] = []
    for n in range(MAPPERS_KILLED):
        out = tmp_path / f"map{n}.npz"
        process, link = start_child(map_and_save, out)
        while not link.recv():  # until a map with blocks on disk was saved
            pass
        time.sleep(rng.uniform(0, 0.7))
        process.kill()
        process.join()
        left.append((describe_map(out).frames, out))
    for frames, out in sorted(left):
        walk(reference, frames - reference.frames, first=reference.frames)
        assert same(VoxelMap.load(out).block_state(), reference.block_state()), f"{out} after {frames} frames"


def test_a_full_disk_is_told_and_the_old_map_stays(maps: list[Path], tmp_path: Path) -> None:
    old, new, other = maps
    before = old.read_bytes()
    process, link = start_child(save_where_files_stay_small, new, old, len(before) // 2)
    assert "cannot write the map: File too large" in link.recv()
    process.join()
    assert old.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in (old, new, other))
