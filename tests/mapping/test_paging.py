"""A map whose voxels do not all fit in memory is the very map that they make where they do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import look_at
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, small_map, sure
from tests.mapping.test_blocks import files_at_most
from tests.mapping.test_voxel_map import same

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


def test_a_view_brings_back_what_it_sees(both: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = both
    for x in (0.0, 2.5, 5.5):
        a, b = free.ray_cast(along_the_wall(x), INTRINSICS), paged.ray_cast(along_the_wall(x), INTRINSICS)
        assert (a.depth_m > 0).mean() > 0.9
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert same(free.block_state(), paged.block_state()), "looking changes nothing"


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


WIDE = 256  # least room for blocks; the frames below touch more than that


def look_wide(voxel_map: VoxelMap) -> None:
    """Frames that touch more blocks than the least memory holds, the second one mostly the same."""
    for n, x in enumerate((0.0, 0.1, 3.0, 0.05)):
        pose = along_the_wall(x)
        voxel_map.integrate(frame(pose, seq=n), plane_depth(pose, (0.2, 0.1, 1.0), 1.0), sure(n % 3, 0.6), None)


@pytest.fixture(scope="module")
def wide() -> tuple[VoxelMap, VoxelMap]:
    """Of the same frames, without a limit and with far too low a one."""
    free, paged = small_map(voxel_size_m=0.01), small_map(voxel_size_m=0.01, memory_mb=1)
    look_wide(free)
    with capture_logs() as logs:
        look_wide(paged)
    told = [log for log in logs if log["event"] == "memory_is_short"]
    assert len(told) == 1 and told[0]["room"] == WIDE < told[0]["blocks"] / 1.2
    advised = int(re.search(r"memory_mb to (\d+) or more", told[0]["reason"]).group(1))  # type: ignore[union-attr]
    roomy = small_map(voxel_size_m=0.01, memory_mb=advised)
    with capture_logs() as logs:
        look_wide(roomy)
    assert [log["event"] for log in logs if log["event"] != "map_grows"] in ([], ["map_pages"])
    return free, paged


def test_frames_that_memory_has_no_room_for_make_the_same_map(wide: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = wide
    assert paged.memory_bytes < 0.5 * free.memory_bytes and free.block_count > 2 * WIDE
    assert (paged.frames, paged.version, paged.last_stamp_ns) == (free.frames, free.version, free.last_stamp_ns)
    assert same(free.block_state(), paged.block_state())
    for version in range(free.version + 1):
        np.testing.assert_array_equal(free.changes(version).keys, paged.changes(version).keys)


def test_a_view_that_memory_has_no_room_for_is_the_same(wide: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = wide
    oblique = look_at(np.array([-0.5, 0.4, -0.2]), np.array([0.6, -0.1, 1.0]), np.array([0.1, -1.0, 0.0]))
    for pose in (along_the_wall(0.0), along_the_wall(2.8), oblique):
        a, b = free.ray_cast(pose, INTRINSICS), paged.ray_cast(pose, INTRINSICS)
        assert (a.depth_m > 0).mean() > 0.3
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_full_disk_costs_no_block_and_mapping_goes_on_once_there_is_room() -> None:
    """The frame that has no room is refused whole; what was in the map is read and saved while the disk is full."""
    free, paged = (small_map(voxel_size_m=0.01, memory_mb=mb) for mb in (0, MEMORY_MB))
    for station in range(6):
        walk(free, 1, first=station)
        walk(paged, 1, first=station)
    with paged.locked() as grid:
        before = grid.stored_bytes
    with files_at_most(before + 200_000):
        for station in range(6, 30):
            try:
                walk(paged, 1, first=station)
            except MapError:
                break
            walk(free, 1, first=station)
        else:
            pytest.fail("the disk was never full")
        with pytest.raises(MapError, match="cannot be put on disk"):
            walk(paged, 1, first=station)
        assert paged.frames == free.frames == station and paged.version == free.version
        assert same(free.block_state(), paged.block_state())
        assert len(paged.points().xyz) == len(free.points().xyz)
    for voxel_map in (free, paged):
        walk(voxel_map, 2, first=station)
        walk(voxel_map, 2)
    assert same(free.block_state(), paged.block_state())


def test_a_frame_past_the_limit_on_blocks_is_refused_before_a_part_of_it_is_fused() -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=1, max_blocks=WIDE + 10)
    pose = along_the_wall(0.0)
    with pytest.raises(MapError, match="the map is full: 0 blocks"):
        voxel_map.integrate(frame(pose), plane_depth(pose, (0.0, 0.0, 1.0), 1.0), sure(0), None)
    assert voxel_map.block_count == voxel_map.frames == voxel_map.version == 0
