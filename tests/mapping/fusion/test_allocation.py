from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import look_at, unproject
from semantic_mapper.mapping.fusion.allocation import (
    blocks_in_band,
    blocks_in_view,
    frame_budget,
    make_camera,
    view_bounds,
)
from semantic_mapper.mapping.storage.block_index import pack_keys, unpack_keys
from semantic_mapper.types import CameraIntrinsics
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, small_map

POSE = look_at(np.array([0.4, -0.3, -1.1]), np.array([0.1, 0.1, 0.4]), np.array([0.1, -1.0, 0.0]))


def sampled_blocks(depth: np.ndarray, truncation: float, block: float) -> np.ndarray:
    """The same by brute force: 65 points on every pixel's ray."""
    directions = unproject(np.ones_like(depth), INTRINSICS)[depth > 0] @ POSE[:3, :3].T
    z = depth[depth > 0].astype(np.float64)
    found = [
        np.floor(((z + s)[:, None] * directions + POSE[:3, 3]) / block).astype(np.int32)
        for s in np.linspace(-truncation, truncation, 65)
    ]
    return np.unique(pack_keys(np.concatenate(found)))


@pytest.mark.parametrize("scene", ["plane", "noise"])
def test_every_block_that_a_ray_crosses_in_the_band_is_found(scene: str, rng: np.random.Generator) -> None:
    depth = plane_depth(POSE, (0.2, 0.1, 1.0), 0.45)
    if scene == "noise":
        depth = (depth + rng.uniform(-0.5, 0.5, depth.shape)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.3] = 0
    found = blocks_in_band(depth, make_camera(INTRINSICS, POSE), 0.02, 0.08, 5.0)
    expected = sampled_blocks(depth, 0.08, 0.16)
    assert (np.diff(found) > 0).all()
    missed = np.setdiff1d(expected, found)
    # A smooth tile may pass over the tip of a block between two rays, at the end of the band.
    assert len(missed) <= (0.01 * len(expected) if scene == "plane" else 0)
    surface = sampled_blocks(depth, 0.07, 0.16)
    assert np.isin(surface, found).all(), "never within 3.5 voxels of the surface"
    assert len(found) < 1.1 * len(expected)


def tile_rays(depth: np.ndarray, voxel: float, u0: int, v0: int, side: int) -> list[tuple[float, float, float, float]]:
    """Pixel, least and greatest depth of the rays that stand for a tile: one where it is smooth, else its quarters'."""
    tile = depth[v0 : v0 + side, u0 : u0 + side]
    height, width = depth.shape
    whole = tile.shape == (side, side) and (tile > 0).all()
    widest = 2 * voxel * min(INTRINSICS.fx, INTRINSICS.fy) / side if side > 1 else np.inf
    if whole and tile.max() - tile.min() <= np.float32(2 * voxel) and tile.max() <= widest:
        across = side - 1
        inside = 0 < u0 < width - 4 and 0 < v0 < height - 4
        if inside or side == 1:
            at = [(u0 + across / 2, v0 + across / 2)]
        else:
            at = [(u0 + i * across, v0 + j * across) for i in (0, 1) for j in (0, 1)]
        return [(u, v, float(tile.min()), float(tile.max())) for u, v in at]
    half = side // 2
    parts = [(u, v) for v in (v0, v0 + half) for u in (u0, u0 + half) if u < width and v < height] if half else []
    return [ray for u, v in parts for ray in tile_rays(depth, voxel, u, v, half)]


@pytest.mark.parametrize("scene", ["plane", "noise"])
def test_blocks_are_those_of_the_rays_of_smooth_tiles(scene: str, rng: np.random.Generator) -> None:
    depth = plane_depth(POSE, (0.2, 0.1, 1.0), 0.45)[:, :157]
    depth[rng.random(depth.shape) < 0.03] = np.nan
    if scene == "noise":
        depth[::2, 40:90] += rng.uniform(0, 0.5, (60, 50)).astype(np.float32)
    measured, keys = np.nan_to_num(depth), []
    for v0, u0 in np.ndindex(30, 40):
        for u, v, least, most in tile_rays(measured, 0.02, 4 * u0, 4 * v0, 4):
            direction = POSE[:3, :3] @ [(u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy, 1]
            near, far = max(least - 0.08, 0), most + 0.08
            ends = [(POSE[:3, 3] + z * direction) / 0.16 for z in (near, far)]
            # Where the way between both ends crosses a face of a block; between two such places it is in one block.
            planes = [
                (axis, n) for axis in range(3) for n in range(*np.ceil(np.sort([e[axis] for e in ends])).astype(int))
            ]
            cuts = [(n - ends[0][axis]) / (ends[1] - ends[0])[axis] for axis, n in planes]
            places = np.sort([0.0, *cuts, 1.0])
            middles = (places[:-1] + places[1:]) / 2
            keys.append(np.floor(ends[0] + middles[:, None] * (ends[1] - ends[0])).astype(np.int32))
    expected = np.unique(pack_keys(np.concatenate(keys)))
    found = blocks_in_band(depth, make_camera(INTRINSICS, POSE), 0.02, 0.08, 5.0)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("column", [80, 81, 82, 83])
def test_a_pole_one_pixel_wide_is_not_missed(column: int) -> None:
    depth = np.zeros((120, 160), np.float32)
    depth[:, column] = 1.0
    voxel_map = small_map(voxel_size_m=0.005)
    assert voxel_map.integrate(frame(), depth, None, None) >= 24
    xyz = voxel_map.points().xyz
    assert xyz[:, 1].max() - xyz[:, 1].min() > 0.85
    assert np.abs(xyz[:, 2] - 1.0).max() < 0.001


def test_no_measurement_no_blocks() -> None:
    assert len(blocks_in_band(np.zeros((120, 160), np.float32), make_camera(INTRINSICS, POSE), 0.02, 0.08, 5.0)) == 0


def test_more_blocks_than_the_first_guess_has_room_for(rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 5.0, (120, 160)).astype(np.float32)
    found = blocks_in_band(depth, make_camera(INTRINSICS, POSE), 0.004, 0.3, 5.0, 1 << 20)
    assert len(found) > 8 * (1 << 13)


def test_a_frame_that_needs_more_blocks_than_its_budget_is_refused(rng: np.random.Generator) -> None:
    depth, camera = rng.uniform(0.5, 5.0, (120, 160)).astype(np.float32), make_camera(INTRINSICS, POSE)
    needed = len(blocks_in_band(depth, camera, 0.02, 0.08, 5.0))
    assert len(blocks_in_band(depth, camera, 0.02, 0.08, 5.0, needed)) == needed
    for budget in (needed - 1, 1):
        with pytest.raises(FrameError, match=f"more than {budget} blocks"):
            blocks_in_band(depth, camera, 0.02, 0.08, 5.0, budget)


@pytest.mark.parametrize("change", [{"cy": 1e19}, {"fx": 1e-3}, {"cx": 1e6}, {"fx": 1e-320}, {"cx": float("nan")}])
def test_a_camera_whose_rays_are_endless_is_refused_before_they_are_followed(change: dict[str, float]) -> None:
    camera = make_camera(INTRINSICS, POSE)._replace(**change)
    with pytest.raises(FrameError, match="check the intrinsics"):
        blocks_in_band(np.ones((120, 160), np.float32), camera, 0.02, 0.08, 5.0)


def test_the_budget_is_a_fraction_of_the_map() -> None:
    assert frame_budget(200_000) == 25_000 and frame_budget(1000) == 1 << 14


def test_an_image_of_one_pixel_is_enough() -> None:
    camera = make_camera(CameraIntrinsics(100, 100, 0, 0, 1, 1), np.eye(4))
    assert len(blocks_in_band(np.full((1, 1), 1.0, np.float32), camera, 0.02, 0.08, 5.0)) == 2


def test_blocks_in_view_are_all_that_a_camera_sees_the_nearest_first() -> None:
    camera, side = make_camera(INTRINSICS, POSE), 0.16
    grid = np.arange(-14, 15)
    keys = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
    found = unpack_keys(blocks_in_view(camera, (120, 160), keys, 0.02, 1.5))
    z = ((found + 0.5) * side - camera.t) @ camera.R[:, 2]
    assert np.diff(z).min() > -1e-9
    depth = np.linspace(0.01, 1.5, 100, dtype=np.float32)
    rays = unproject(np.ones((120, 160), np.float32), INTRINSICS).reshape(-1, 3) @ POSE[:3, :3].T
    met = np.floor((depth[:, None, None] * rays + POSE[:3, 3]).reshape(-1, 3) / side).astype(np.int32)
    needed = np.intersect1d(pack_keys(met), pack_keys(keys))
    assert np.isin(needed, pack_keys(found)).all(), "nothing that a ray meets is left out"
    assert len(found) < 2.5 * len(needed) < 0.2 * len(keys)


def test_the_bounds_of_a_view_hold_all_its_blocks_and_little_more(rng: np.random.Generator) -> None:
    grid = np.arange(-14, 15)
    keys = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
    for _ in range(30):
        eye, target, up = rng.uniform(-1, 1, (3, 3))
        camera = make_camera(INTRINSICS, look_at(eye, target, up))
        low, high = view_bounds(camera, INTRINSICS, 0.02, 1.0)
        near = keys[((keys >= low) & (keys <= high)).all(axis=1)]
        seen = blocks_in_view(camera, (120, 160), keys, 0.02, 1.0)
        np.testing.assert_array_equal(blocks_in_view(camera, (120, 160), near, 0.02, 1.0), seen)
        assert (high - low <= 2 * 1.6 / 0.16 + 6).all(), "no wider than the sphere round the camera"
