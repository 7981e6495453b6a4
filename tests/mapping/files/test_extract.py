from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.mapping import surface
from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.mapping.grids import random_grid
from tests.mapping.rendered_views import around, frame, plane_depth, small_map, sphere_depth, sure

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


def test_depth_edge_is_not_bridged_by_a_false_surface() -> None:
    depth = plane_depth(np.eye(4), (0, 0, 1), 1.5)
    depth[:, :80] = 1.0  # a wall in front of a wall
    voxel_map = small_map()
    voxel_map.integrate(frame(), depth, None, None)
    z = voxel_map.points().xyz[:, 2]
    between = (z > 1.02) & (z < 1.48)
    assert between.mean() < 0.005


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
