"""What a frame sees through is cleared, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.geometry import make_pose
from semantic_mapper.mapping import clearing
from semantic_mapper.mapping.clearing import depth_bounds
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64
from tests.mapping.rendered_views import LABELS, frame, small_map

HEADER = Path(clearing.__file__).parents[2] / "kernels" / "src" / "see_through.h"
CAMERA = CameraIntrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)
WALL_M, THING_M = 3.0, 2.0
THING = (slice(90, 150), slice(120, 200))  # pixels


def pose(x: float = 0.0, yaw: float = 0.0) -> Float64:
    return make_pose((0.0, yaw, 0.0), (x, 0.0, 0.0))


def wall(thing: bool = False) -> Float32:
    depth = np.full((240, 320), WALL_M, np.float32)
    if thing:
        depth[THING] = THING_M
    return depth


def votes(channel: int) -> Float32:
    p = np.full((240, 320, len(LABELS)), 0.1, np.float32)
    p[..., channel] = 0.8
    return p


def see(voxel_map: VoxelMap, depth: Float32, *, times: int = 1, measured: bool = True) -> None:
    for _ in range(times):
        given = frame(pose(), seq=voxel_map.frames, intrinsics=CAMERA, rgb=90)
        voxel_map.integrate(given, depth, votes(1), None, measured=measured)


def thing_points(voxel_map: VoxelMap) -> int:
    """Surface points at the depth of the thing, away from its rim by more than the surroundings of a voxel."""
    return int((np.abs(voxel_map.points(1e-3).xyz[:, 2] - THING_M) < 0.1).sum())


def state(voxel_map: VoxelMap) -> dict[str, bytes]:
    return {name: values.tobytes() for name, values in voxel_map.block_state().items()}


def test_bounds_are_the_least_and_greatest_depths(rng: np.random.Generator) -> None:
    depth = rng.uniform(-1, 7, (240, 640)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    measured = (depth > 0) & (depth <= 5)
    bounds = depth_bounds(depth, 5.0)
    assert bounds.cell == 2 and bounds.nearest.shape == (6, 120, 320) and bounds.farthest.shape == (15, 40)
    least = np.where(measured, depth, np.inf)
    for level, v, u in ((0, 7, 9), (3, 30, 200), (5, 88, 288)):
        side = 2 * 2**level
        assert bounds.nearest[level, v, u] == least[2 * v : 2 * v + side, 2 * u : 2 * u + side].min()
    most = np.where(measured, depth, 0).reshape(15, 16, 40, 16).max(axis=(1, 3))
    np.testing.assert_array_equal(bounds.farthest, most)


@pytest.mark.parametrize("looks", [1, 10, 300])
def test_a_thing_that_left_is_cleared_within_three_frames(looks: int) -> None:
    voxel_map = small_map()
    see(voxel_map, wall(thing=True), times=looks)
    before = thing_points(voxel_map)
    see(voxel_map, wall(), times=3)
    assert before > 500 and thing_points(voxel_map) == 0 and voxel_map.cleared > before
    blocks = voxel_map.block_state()
    free = (blocks["tsdf"] == 1) & (blocks["votes"] == 0)
    assert not blocks["evidence"][free].any()  # or it would come back from disk otherwise


@pytest.mark.parametrize("hole", [0.0, np.nan, np.inf, 65.0])
def test_holes_and_what_is_too_far_clear_nothing(hole: float) -> None:
    voxel_map = small_map()
    see(voxel_map, wall(thing=True), times=10)
    before = voxel_map.points().xyz
    depth = wall()
    depth[THING] = hole
    see(voxel_map, depth, times=10)
    assert voxel_map.cleared == 0
    after = voxel_map.points().xyz
    np.testing.assert_array_equal(before[before[:, 2] < 2.5], after[after[:, 2] < 2.5])


def test_computed_depth_clears_nothing_and_measured_depth_clears_what_was_computed() -> None:
    voxel_map = small_map()
    see(voxel_map, wall(thing=True), times=10)
    before = thing_points(voxel_map)
    see(voxel_map, wall(), times=20, measured=False)
    assert thing_points(voxel_map) == before and voxel_map.cleared == 0
    computed = small_map()
    see(computed, wall(thing=True), times=10, measured=False)
    assert thing_points(computed) > 500
    see(computed, wall())
    assert thing_points(computed) == 0


def test_a_thin_pole_stays_where_poses_are_off() -> None:
    """4 cm across, 2 m away; the poses of the map are off by 5 mm and 0.1 degrees."""
    kept = {}
    for clears in (False, True):
        noise, voxel_map = np.random.default_rng(5), small_map(clear_free_space=clears)
        for n in range(120):
            x, yaw = 0.4 * np.sin(n / 9), 0.05 * np.sin(n / 5)
            true = pose(x, yaw)
            u = np.arange(320)
            ray = np.stack(((u - CAMERA.cx) / CAMERA.fx, np.zeros(320), np.ones(320))).T @ true[:3, :3].T
            at = x + ray[:, 0] * (THING_M / ray[:, 2])  # where the ray crosses the plane of the pole
            z = np.where(np.abs(at) < 0.02, THING_M, WALL_M) / ray[:, 2]
            depth = np.repeat(z.astype(np.float32)[None], 240, axis=0)
            off = pose(x + noise.normal(0, 0.005), yaw + np.radians(noise.normal(0, 0.1)))
            voxel_map.integrate(frame(off, seq=n, intrinsics=CAMERA), depth, None)
        kept[clears] = thing_points(voxel_map)
    assert kept[True] > 0.97 * kept[False] > 100


def test_clearing_is_deterministic_and_blocks_on_disk_are_cleared_as_well() -> None:
    """Beside the thing, the map has more blocks than memory has room for."""
    maps = [small_map(), small_map(), small_map(memory_mb=9)]
    for voxel_map in maps:
        see(voxel_map, wall(thing=True), times=4)
        for n in range(1, 12):
            away = frame(pose(x=4.0 * n), seq=100 + n, intrinsics=CAMERA)
            voxel_map.integrate(away, wall(), votes(0), None)
        before = thing_points(voxel_map)
        see(voxel_map, wall(), times=3)
        assert before > 500 and thing_points(voxel_map) == 0
    assert maps[2].stored_blocks > 0
    assert state(maps[0]) == state(maps[1]) == state(maps[2])
    assert maps[0].cleared == maps[2].cleared
