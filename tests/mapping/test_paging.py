"""A map whose voxels do not all fit in memory is the very map that they make where they do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.block_grid import EVICTED_AT_ONCE, EVICTED_SHARE, BlockGrid
from semantic_mapper.mapping.block_index import pack_keys
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64
from tests.mapping.test_voxel_map import same
from tests.mapping.views import INTRINSICS, frame, plane_depth, small_map, sure

STEP_M = 0.5
MEMORY_MB = 11  # a station's blocks and some of the one before


def along_the_wall(x: float) -> Float64:
    """A camera 1 m from the wall z = 1, ``x`` metres along it."""
    T = np.eye(4)
    T[0, 3] = x
    return T


def walk(voxel_map: VoxelMap, stations: int, first: int = 0) -> None:
    for n in range(first, first + stations):
        pose = along_the_wall(n * STEP_M)
        depth = plane_depth(pose, (0.0, 0.0, 1.0), 1.0)
        voxel_map.integrate(frame(pose, seq=n), depth, sure(n % 3, 0.6), None)


@pytest.fixture(scope="module")
def both() -> tuple[VoxelMap, VoxelMap]:
    """The same walk of 12 stations and back at the first one, without a limit and with one."""
    free, paged = small_map(voxel_size_m=0.01), small_map(voxel_size_m=0.01, memory_mb=MEMORY_MB)
    for voxel_map in (free, paged):
        walk(voxel_map, 12)
        walk(voxel_map, 2)
    return free, paged


def test_memory_stays_within_its_limit_and_nothing_is_lost(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    assert free.stored_blocks == 0 and paged.stored_blocks > 100
    assert paged.block_count == free.block_count
    assert paged.memory_bytes <= 1.05 * MEMORY_MB * 1e6 < 0.5 * free.memory_bytes
    assert same(free.block_state(), paged.block_state())


def test_points_and_mesh_are_the_same(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    for a, b in ((free.points(), paged.points()), (free.mesh(), paged.mesh())):
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_view_brings_back_what_it_sees(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    for x in (0.0, 2.5, 5.5):
        a, b = free.ray_cast(along_the_wall(x), INTRINSICS), paged.ray_cast(along_the_wall(x), INTRINSICS)
        assert (a.depth_m > 0).mean() > 0.9
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert same(free.block_state(), paged.block_state()), "looking changes nothing"


def test_what_changed_is_known_of_blocks_on_disk_too(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    for version in (0, 3, 11, 13, 14):
        np.testing.assert_array_equal(free.changed_since(version), paged.changed_since(version))
    assert len(free.changed_since(0)) == free.block_count
    assert 0 < len(free.changed_since(13)) < len(free.changed_since(12)) < free.block_count
    assert len(free.changed_since(14)) == 0


def test_a_paged_map_is_saved_whole_and_goes_on(both: tuple[VoxelMap, VoxelMap], tmp_path: Path) -> None:
    free, paged = both
    paged.save(tmp_path / "paged.npz")
    loaded = VoxelMap.load(tmp_path / "paged.npz")
    assert loaded.stored_blocks > 0 and same(loaded.block_state(), free.block_state())
    again = small_map(voxel_size_m=0.01)
    walk(again, 12)
    walk(again, 2)
    walk(again, 1, first=5)
    walk(loaded, 1, first=5)
    assert same(again.block_state(), loaded.block_state())


def test_a_frame_that_memory_has_no_room_for_is_refused_and_costs_nothing() -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=1)  # LEAST_RESIDENT blocks, which is more
    pose = along_the_wall(0.0)
    with pytest.raises(MapError, match=r"one frame touches \d+ blocks.*memory_mb"):
        voxel_map.integrate(frame(pose), plane_depth(pose, (0.0, 0.0, 1.0), 1.0), sure(0), None)
    assert voxel_map.block_count == 0 and voxel_map.frames == 0


def test_keys_between_two_corners_are_found_in_memory_and_on_disk(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    keys = free.changed_since(0)
    for low, high in ((keys.min(axis=0), keys.max(axis=0)), (np.array([10, -3, 8]), np.array([40, 4, 12]))):
        expected = keys[((keys >= low) & (keys <= high)).all(axis=1)]
        assert len(expected) > 20
        for voxel_map in (free, paged):
            np.testing.assert_array_equal(voxel_map._grid.keys_between(low, high), expected)


def test_a_large_share_leaves_at_once() -> None:
    """Sorting out what to evict looks at all blocks in memory: it must not come with every frame."""
    grid = BlockGrid(0.02, 3, 64, 10_000, memory_bytes=40_000_000)
    grid.activate(pack_keys(np.array([[0, 0, z] for z in range(grid.capacity)], np.int32)))
    assert grid.stored_count == 0
    grid.activate(pack_keys(np.array([[1, 0, 0]], np.int32)))
    assert grid.stored_count == grid.capacity // EVICTED_SHARE > EVICTED_AT_ONCE
