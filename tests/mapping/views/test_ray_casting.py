from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.geometry import look_at, scale_intrinsics
from semantic_mapper.mapping.storage.grid_buffers import GridBuffers
from semantic_mapper.types import CameraIntrinsics
from tests.mapping.grids import corners
from tests.mapping.rendered_views import (
    INTRINSICS,
    around,
    frame,
    plane_depth,
    ray_directions,
    small_map,
    sphere_depth,
    sure,
)

WALL = ((0.1, 0.05, 1.0), 1.013)


@pytest.mark.parametrize("turn_deg", [0, 45, 90, 135, 180, 225, 270, 315])
def test_wall_depth_is_unbiased_whichever_way_the_camera_looks(turn_deg: int) -> None:
    """Open3D's own ray caster is off by half a voxel, the sign depending on the direction; a quarter is the limit."""
    angle = np.deg2rad(turn_deg)
    toward = np.array([np.sin(angle), 0.0, np.cos(angle)])
    pose = look_at(np.zeros(3), toward, np.array([0.0, -1.0, 0.0]))
    normal = (float(toward[0] + 0.1), 0.05, float(toward[2] - 0.07))
    depth = plane_depth(pose, normal, 1.013)
    voxel_map = small_map()
    voxel_map.integrate(frame(pose, rgb=200), depth, sure(2), None)
    view = voxel_map.ray_cast(pose, INTRINSICS)
    inner = (slice(5, -5), slice(5, -5))
    assert (view.depth_m[inner] > 0).all()
    error = (view.depth_m - depth)[inner]
    assert abs(error.mean()) < 0.0005 and np.abs(error).max() < 0.002
    assert (view.label[inner] == 2).all() and (view.rgb[inner] == 200).all()
    assert view.confidence[inner].min() > 0.3


def test_sphere_is_seen_from_a_pose_it_was_not_fused_from() -> None:
    center = np.array([0.3, -0.2, 0.5])
    voxel_map = small_map()
    for seq, pose in enumerate(around(center, 1.2, 12)):
        voxel_map.integrate(frame(pose, seq=seq), sphere_depth(pose, center, 0.4), None, None)
    pose = look_at(center + np.array([0.9, 0.8, 0.3]), center, np.array([0.0, 0.0, 1.0]))
    truth, view = sphere_depth(pose, center, 0.4), voxel_map.ray_cast(pose, INTRINSICS)
    both = (truth > 0) & (view.depth_m > 0)
    assert both.sum() > 0.97 * (truth > 0).sum()
    error = np.abs(view.depth_m - truth)[both]
    assert np.median(error) < 0.003 and np.quantile(error, 0.95) < 0.01


def test_misses_are_explicit() -> None:
    voxel_map = small_map()
    voxel_map.integrate(frame(), plane_depth(np.eye(4), *WALL), sure(1), None)
    away = look_at(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0]))
    view = voxel_map.ray_cast(away, INTRINSICS)
    assert not view.depth_m.any() and not view.rgb.any() and not view.confidence.any() and (view.label == 0).all()


def test_a_surface_is_not_seen_from_behind() -> None:
    voxel_map = small_map()
    voxel_map.integrate(frame(), plane_depth(np.eye(4), *WALL), None, None)
    behind = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    assert (voxel_map.ray_cast(behind, INTRINSICS).depth_m[10:-10, 10:-10] > 0).mean() < 0.01


def test_views_of_another_size_agree_with_the_full_one() -> None:
    voxel_map = small_map()
    voxel_map.integrate(frame(), plane_depth(np.eye(4), *WALL), None, None)
    small: CameraIntrinsics = scale_intrinsics(INTRINSICS, 40, 30)
    view = voxel_map.ray_cast(np.eye(4), small)
    truth = plane_depth(np.eye(4), *WALL, intrinsics=small)
    assert view.depth_m.shape == (30, 40)
    assert np.abs(view.depth_m - truth)[2:-2, 2:-2].max() < 0.005


def test_hits_lie_on_the_first_zero_of_the_interpolated_field() -> None:
    center = np.array([0.3, -0.2, 0.5])
    voxel_map = small_map()
    for seq, pose in enumerate(around(center, 1.2, 12)):
        voxel_map.integrate(frame(pose, seq=seq), sphere_depth(pose, center, 0.4), None, None)
    small, pose = scale_intrinsics(INTRINSICS, 16, 12), around(center, 1.3, 7)[3]
    depth = voxel_map.ray_cast(pose, small).depth_m
    with voxel_map.locked() as grid:
        _, rows = grid.sorted_blocks()
        buffers = GridBuffers(*(np.ascontiguousarray(values[rows]) for values in grid.buffers()))

    def field(z: float, direction: np.ndarray) -> float:
        """TSDF at z of a ray, interpolated over the observed voxels; NaN where there is none."""
        around = [(f, at) for f, at in corners(buffers, (pose[:3, 3] + z * direction) / 0.02) if buffers.weight[at] > 0]
        fraction = sum(f for f, _ in around)
        return sum(f * float(buffers.tsdf[at]) for f, at in around) / fraction if fraction else np.nan

    directions, hits = ray_directions(small, pose), np.argwhere(depth > 0)
    assert len(hits) > 30
    for v, u in hits[::3]:
        assert abs(field(depth[v, u], directions[v, u])) < 5e-3
        before = np.array([field(z, directions[v, u]) for z in depth[v, u] - np.arange(0.01, 0.2, 0.01)])
        assert (before > 0).any() and not (before < -0.05).any()
