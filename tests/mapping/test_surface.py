from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import look_at, scale_intrinsics
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping import surface
from semantic_mapper.mapping.block_grid import GridBuffers
from semantic_mapper.mapping.fusion import MEASURED
from semantic_mapper.mapping.surface import read_points
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.grids import corners, decided, random_grid
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

CENTER = np.array([0.31, -0.17, 0.52])


@pytest.fixture(scope="module")
def sphere() -> VoxelMap:
    voxel_map = small_map()
    for seq, pose in enumerate(around(CENTER, 1.2, 18)):
        voxel_map.integrate(frame(pose, seq=seq, rgb=90), sphere_depth(pose, CENTER, 0.35), sure(1), None)
    return voxel_map


def test_mesh_of_a_sphere_lies_on_it_and_faces_outwards(sphere: VoxelMap) -> None:
    mesh = sphere.mesh()
    assert mesh.faces.dtype == np.int32 and mesh.faces.max() < len(mesh.vertices)
    radius = np.linalg.norm(mesh.vertices - CENTER, axis=1)
    assert np.median(np.abs(radius - 0.35)) < 0.003
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    outward = (np.cross(b - a, c - a) * ((a + b + c) / 3 - CENTER)).sum(axis=1)
    assert (outward > 0).mean() > 0.97
    near = np.abs(radius - 0.35) < 0.01
    assert (mesh.label[near] == 9).mean() > 0.97 and (mesh.rgb[near] == 90).all()


def test_open3d_sees_the_map_with_its_labels(sphere: VoxelMap) -> None:
    grid, mesh, state = sphere.to_open3d(), sphere.mesh(), sphere.block_state()
    seen = grid.extract_triangle_mesh(1.0 - 1e-6).vertex.positions.numpy()
    assert len(seen) == len(mesh.vertices)
    assert np.allclose(np.unique(seen, axis=0), np.unique(mesh.vertices, axis=0), atol=1e-5)
    keys = grid.hashmap().key_tensor().numpy()[grid.hashmap().active_buf_indices().numpy()]
    assert (np.unique(keys, axis=0) == state["keys"]).all()
    label, weight = grid.attribute("label").numpy(), grid.attribute("weight").numpy()
    assert weight.sum() == state["weight"].sum() and label.dtype == np.uint8
    points, ids = grid.extract_point_cloud(1.0), set(np.unique(label).tolist())
    assert len(points.point.positions) > 1000 and ids == {9, sphere.label_set.ignore_id}
    with pytest.raises(MapError, match="empty map"):
        small_map().to_open3d()


@pytest.mark.parametrize("min_weight", [0.1, 4.0])
def test_crossings_are_those_of_a_dense_grid(min_weight: float, rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    blocks = rng.permutation(len(buffers.keys)).astype(np.int32)[:7]
    grid = cast("Any", SimpleNamespace(index=index, buffers=lambda: buffers))
    found = surface.surface_voxels(buffers.keys[blocks], blocks, grid, min_weight)
    low = buffers.keys.min(axis=0)
    size = 8 * (buffers.keys.max(axis=0) - low + 2)
    tsdf, seen, asked = np.zeros(size, np.float32), np.zeros(size, bool), np.zeros(size, bool)  # [x, y, z]
    for n, (x, y, z) in enumerate(((buffers.keys - low) * 8).tolist()):
        part = (slice(x, x + 8), slice(y, y + 8), slice(z, z + 8))
        tsdf[part] = buffers.tsdf[n].reshape(8, 8, 8).T
        seen[part] = (buffers.weight[n] >= min_weight).reshape(8, 8, 8).T
        asked[part] = n in blocks
    expected: list[np.ndarray] = []
    for axis in range(3):
        here, there = (np.moveaxis(a, axis, 0)[part] for part in (slice(-1), slice(1, None)) for a in (tsdf,))
        both = np.moveaxis(seen, axis, 0)[:-1] & np.moveaxis(seen, axis, 0)[1:] & np.moveaxis(asked, axis, 0)[:-1]
        both &= ((here > 0) != (there > 0)) & (np.abs(here - there) <= 0.95) & (np.abs(here) <= 0.95)
        at = np.argwhere(both).astype(float)
        a, b = here[both].astype(float), there[both].astype(float)
        at[:, 0] += a / (a - b)
        order = [axis, *(i for i in range(3) if i != axis)]
        expected.append(at[:, np.argsort(order)])
    points = np.concatenate(expected) + low * 8
    assert len(found) == len(points) > 100
    in_order = [p[np.lexsort(np.round(p, 6).T)] for p in (found, points)]
    np.testing.assert_allclose(*in_order, atol=1e-9)


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
        """TSDF at z of a ray, interpolated over the observed voxels; NaN without any."""
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
    labels, rho = make_label_set("four", ("a", "b", "c", "d"), ids=(7, 1, 4, 2), ignore_id=0), 0.4
    points = rng.uniform(-12, 18, (400, 3))
    points[::5] = np.round(points[::5])  # at voxels: the others count nothing
    rgb, channel, confidence, measured = read_points(points, index, buffers, rho, 0.0)
    label = labels.to_ids(channel)
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
        votes = sum(f * buffers.votes[at] for f, at in voted)
        said = sum(f * buffers.votes[at] * buffers.evidence[at] for f, at in voted) / votes
        best, sure = decided(said, votes / fraction, rho)
        assert label[n] == labels.ids[best]
        assert confidence[n] == pytest.approx(sure, rel=1e-5)


def test_points_beyond_all_numbers_do_no_harm_and_unknown_ones_are_unknown(rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    wild = np.array([[np.nan] * 3, [np.inf, 0, 0], [1e300, -1e300, 0], [-1e19] * 3, [1e9] * 3])
    assert np.isin(read_points(wild, index, buffers, 0.5, 0.0).channel, range(-1, 4)).all()
    for points in (np.full((2, 3), 300.0), wild[:0]):
        read = read_points(points, index, buffers, 0.5, 0.0)
        assert (read.channel == -1).all() and not (read.rgb.any() or read.confidence.any() or read.measured.any())


def test_depth_edge_is_not_bridged_by_a_false_surface() -> None:
    depth = plane_depth(np.eye(4), (0, 0, 1), 1.5)
    depth[:, :80] = 1.0  # a wall in front of a wall
    voxel_map = small_map()
    voxel_map.integrate(frame(), depth, None, None)
    z = voxel_map.points().xyz[:, 2]
    between = (z > 1.02) & (z < 1.48)
    assert between.mean() < 0.005
