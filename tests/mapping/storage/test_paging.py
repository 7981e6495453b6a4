"""A map whose voxels do not all fit in memory is the very map that they make where they do."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from structlog.testing import capture_logs

from semantic_mapper.config import VirtualViewConfig
from semantic_mapper.errors import MapError
from semantic_mapper.geometry import look_at, scale_intrinsics
from semantic_mapper.mapping.fusion.vote_fusion import add_votes
from semantic_mapper.mapping.storage.block_grid import EVICTED_AT_ONCE, EVICTED_SHARE, BlockGrid
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.block_store import BlockStore
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, small_map, sure
from tests.mapping.storage.test_block_store import files_at_most
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


WIDE = 256  # least room for blocks; the frames below touch more than that


def look_wide(voxel_map: VoxelMap) -> None:
    """Frames that touch more blocks than the least memory holds, the second one mostly the same."""
    for n, x in enumerate((0.0, 0.1, 3.0, 0.05)):
        pose = along_the_wall(x)
        voxel_map.integrate(frame(pose, seq=n), plane_depth(pose, (0.2, 0.1, 1.0), 1.0), sure(n % 3, 0.6), None)


@pytest.fixture(scope="module", params=["float32", "int16"])
def wide(request: pytest.FixtureRequest) -> tuple[VoxelMap, VoxelMap]:
    """Of the same frames, without a limit and with far too low a one."""
    kind = {"voxel_size_m": 0.01, "evidence": request.param}
    free, paged = small_map(**kind), small_map(**kind, memory_mb=1)
    look_wide(free)
    with capture_logs() as logs:
        look_wide(paged)
    told = [log for log in logs if log["event"] == "memory_is_short"]
    assert len(told) == 1 and told[0]["room"] == WIDE < told[0]["blocks"] / 1.2
    advised = int(re.search(r"memory_mb to (\d+) or more", told[0]["reason"]).group(1))  # type: ignore[union-attr]
    roomy = small_map(**kind, memory_mb=advised)
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
        np.testing.assert_array_equal(free.changed_since(version), paged.changed_since(version))


def test_a_view_cast_pixel_by_pixel_is_the_same(
    both: tuple[VoxelMap, VoxelMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    free, paged = both
    small, pose = scale_intrinsics(INTRINSICS, 12, 9), along_the_wall(2.5)
    monkeypatch.setattr(BlockGrid, "room", property(lambda grid: 1))
    np.testing.assert_array_equal(paged.ray_cast(pose, small).depth_m, free.ray_cast(pose, small).depth_m)


def test_a_view_that_memory_has_no_room_for_is_the_same(wide: tuple[VoxelMap, VoxelMap]) -> None:
    free, paged = wide
    oblique = look_at(np.array([-0.5, 0.4, -0.2]), np.array([0.6, -0.1, 1.0]), np.array([0.1, -1.0, 0.0]))
    for pose in (along_the_wall(0.0), along_the_wall(2.8), oblique):
        a, b = free.ray_cast(pose, INTRINSICS), paged.ray_cast(pose, INTRINSICS)
        assert (a.depth_m > 0).mean() > 0.3
        for name in a.__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_votes_that_memory_has_no_room_for_are_the_same(wide: tuple[VoxelMap, VoxelMap]) -> None:
    pose, config = along_the_wall(0.3), VirtualViewConfig(max_votes=5.0)
    depth = plane_depth(pose, (0.2, 0.1, 1.0), 1.0)
    rows = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
    table, before = (sure(1).reshape(-1, 3), rows), wide[0].block_state()
    touched = [add_votes(voxel_map, pose, INTRINSICS, depth, table, config) for voxel_map in wide]
    assert touched[0] == touched[1] > WIDE and wide[0].version == wide[1].version == 5
    assert same(wide[0].block_state(), wide[1].block_state()) and not same(wide[0].block_state(), before)
    np.testing.assert_array_equal(wide[0].changed_since(4), wide[1].changed_since(4))


def test_a_frame_past_the_limit_on_blocks_is_refused_before_a_part_of_it_is_fused() -> None:
    voxel_map = small_map(voxel_size_m=0.01, memory_mb=1, max_blocks=WIDE + 10)
    pose = along_the_wall(0.0)
    with pytest.raises(MapError, match="the map is full: 0 blocks"):
        voxel_map.integrate(frame(pose), plane_depth(pose, (0.0, 0.0, 1.0), 1.0), sure(0), None)
    assert voxel_map.block_count == voxel_map.frames == voxel_map.version == 0


def test_a_full_disk_costs_no_block_and_mapping_goes_on_once_there_is_room() -> None:
    """The frame that has no room is refused whole; what was in the map is read and saved while the disk is full."""
    free, paged = (small_map(voxel_size_m=0.01, memory_mb=mb) for mb in (0, MEMORY_MB))
    for station in range(6):
        walk(free, 1, first=station)
        walk(paged, 1, first=station)
    before = paged.stored_bytes
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


def test_a_disk_that_fails_in_the_midst_of_a_wide_frame_leaves_a_map_that_says_what_changed() -> None:
    paged = small_map(voxel_size_m=0.01, memory_mb=1)
    look_wide(paged)
    before, version, frames = paged.block_state(), paged.version, paged.frames
    pose = along_the_wall(0.02)

    def look_again(times: int) -> None:
        for _ in range(times):
            paged.integrate(frame(pose, seq=9), plane_depth(pose, (0.2, 0.1, 1.0), 1.0), sure(1), None)

    with files_at_most(paged.stored_bytes), pytest.raises(MapError, match="cannot be put on disk"):
        look_again(20)
    assert paged.version > version and paged.frames >= frames
    after = paged.block_state()
    differs = [
        key
        for key, old, new in zip(
            before["keys"].tolist(), before["weight"], weights_at(after, before["keys"]), strict=True
        )
        if (old != new).any()
    ]
    assert differs and set(map(tuple, differs)) <= set(map(tuple, paged.changed_since(version).tolist()))
    frames = paged.frames
    look_again(1)
    assert paged.frames == frames + 1


def weights_at(state: dict[str, NDArray[np.generic]], keys: NDArray[np.generic]) -> NDArray[np.generic]:
    """Weights of these blocks, which are all in the state."""
    rows = {tuple(key): n for n, key in enumerate(state["keys"].tolist())}
    return state["weight"][[rows[tuple(key)] for key in keys.tolist()]]


def test_a_block_that_cannot_be_taken_off_the_disk_is_in_the_map_once(monkeypatch: pytest.MonkeyPatch) -> None:
    free, paged = (small_map(voxel_size_m=0.01, memory_mb=mb) for mb in (0, MEMORY_MB))
    for voxel_map in (free, paged):
        walk(voxel_map, 6)
    with monkeypatch.context() as patched:
        patched.setattr(BlockStore, "drop", failing_drop)
        with pytest.raises(MapError, match="no drop"):
            walk(paged, 1)
    assert paged.block_count == free.block_count
    assert same(free.block_state(), paged.block_state())
    for voxel_map in (free, paged):
        walk(voxel_map, 1)
    assert same(free.block_state(), paged.block_state())


def test_going_to_disk_and_back_takes_a_bounded_part_of_memory_beside_the_voxels() -> None:
    grid = BlockGrid(0.02, 20, 64, 10**6, memory_bytes=200_000_000)
    along_x = np.zeros((2 * grid.room, 3), np.int32)
    along_x[:, 0] = np.arange(len(along_x))

    def touch_all() -> None:
        for blocks in grid.batches(pack_keys(along_x)):
            for values in grid.buffers()[1:]:
                values[blocks] = 1

    touch_all()
    tracemalloc.start()
    touch_all()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grid.stored_count > 1000 and peak < 0.4 * grid.memory_bytes


def failing_drop(store: BlockStore, keys: object) -> None:
    raise MapError("no drop")


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
