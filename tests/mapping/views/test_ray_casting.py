from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.geometry import look_at, scale_intrinsics
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.fusion.fuse import MEASURED
from semantic_mapper.mapping.storage.block_grid import GridBuffers
from semantic_mapper.mapping.surface import read_points
from tests.mapping.grids import corners, random_grid
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


def test_points_are_read_as_plain_numpy_reads_them(rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    labels, rho, sums = (
        make_label_set("four", ("a", "b", "c", "d"), ids=(7, 1, 4, 2), ignore_id=0),
        0.4,
        buffers.evidence.astype(np.float64),
    )
    points = rng.uniform(-12, 18, (400, 3))
    points[::5] = np.round(points[::5])  # at voxels: the others count nothing
    rgb, label, confidence, measured = read_points(points, index, buffers, labels, rho, 0.0)
    assert 20 < measured.sum() < len(points) - 20
    for n, p in enumerate(points):
        around = [(f, at) for f, at in corners(buffers, p) if f >= 1e-3]
        seen = [(f, at) for f, at in around if buffers.weight[at] > 0]
        assert measured[n] == (bool(seen) and min(buffers.weight[at] for _, at in seen) >= MEASURED)
        color = sum((f * buffers.color[at].astype(float) for f, at in seen), np.zeros(3)) / (
            sum(f for f, _ in seen) or 1
        )
        np.testing.assert_allclose(rgb[n], color, atol=0.501)
        voted = [(f, at) for f, at in around if buffers.votes[at] > 0]
        fraction = sum(f for f, _ in voted)
        if not voted:
            assert (label[n], confidence[n]) == (0, 0.0)
            continue
        total, votes = (
            sum(f * sums[at] for f, at in voted) / fraction,
            sum(f * buffers.votes[at] for f, at in voted) / fraction,
        )
        worth = 1 / (1 + rho * (votes - 1)) if votes > 1 else 1 / votes
        p_class = np.exp((total - total.max()) * worth)
        assert label[n] == labels.ids[int(total.argmax())]
        assert confidence[n] == pytest.approx(p_class.max() / p_class.sum(), rel=1e-5)


def test_points_beyond_all_numbers_do_no_harm_and_unknown_ones_are_unknown(rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    labels = make_label_set("four", ("a", "b", "c", "d"), ignore_id=0)
    wild = np.array([[np.nan] * 3, [np.inf, 0, 0], [1e300, -1e300, 0], [-1e19] * 3, [1e9] * 3])
    assert np.isin(read_points(wild, index, buffers, labels, 0.5, 0.0)[1], (0, *labels.ids)).all()
    for points in (np.full((2, 3), 300.0), wild[:0]):
        assert not any(values.any() for values in read_points(points, index, buffers, labels, 0.5, 0.0))
