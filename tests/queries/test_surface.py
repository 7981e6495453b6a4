"""Surface voxels against a search of every voxel, and against the shapes they come from."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from semantic_mapper.errors import MapError
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import costmap, points_in_box, surface_voxels, up_in
from tests.queries.random_map import random_map, voxel_places
from tests.queries.scene import BALL, BOX, CUP, FLOOR, TABLE, surface_of, truth_distance, whole


def dense(snapshot: MapSnapshot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """TSDF and weight of the box of all blocks, a block wider all round, as [x, y, z], and its first voxel."""
    keys = snapshot.keys
    first = keys.min(axis=0) - 1
    shape = tuple((keys.max(axis=0) - first + 2) * 8)
    tsdf, weight = np.zeros(shape), np.zeros(shape, bool)
    for (x, y, z), slot in zip((keys - first) * 8, snapshot.slots, strict=True):
        part = (slice(x, x + 8), slice(y, y + 8), slice(z, z + 8))
        tsdf[part] = snapshot.voxels.tsdf[slot].reshape(8, 8, 8).T
        weight[part] = snapshot.voxels.weight[slot].reshape(8, 8, 8).T > 0
    return tsdf, weight, first * 8


def brute_force(snapshot: MapSnapshot) -> tuple[np.ndarray, np.ndarray]:
    """Voxels (N, 3) in lexicographic order with the means (N, 3) of the crossings that are nearest to them."""
    tsdf, weight, first = dense(snapshot)
    owners, points = [], []
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        a, b = tsdf, np.roll(tsdf, -1, axis)  # the border is empty
        crossed = weight & np.roll(weight, -1, axis) & ((a > 0) != (b > 0)) & (np.abs(a - b) <= 120)
        lower = np.argwhere(crossed)
        along = (a[crossed] / (a[crossed] - b[crossed]))[:, None]
        owners.append(np.where(along <= 0.5, lower, lower + step) + first)
        points.append(lower + along * step + first)
    voxels, inverse, counts = np.unique(np.concatenate(owners), axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros(voxels.shape)
    np.add.at(sums, inverse.ravel(), np.concatenate(points))
    return voxels, sums / counts[:, None]


def test_points_lie_on_the_shape_of_their_class() -> None:
    xyz, label, confidence = surface_of(whole())
    distance = np.abs(truth_distance(xyz))
    for column, class_id in enumerate((FLOOR, TABLE, CUP)):
        mine = label == class_id
        others = np.delete(distance, column, axis=1).min(axis=1)
        assert np.quantile(distance[mine, column], 0.9) < 0.01
        clear = mine & (others > 0.08) & (distance.min(axis=1) < 0.01)
        assert clear.sum() > 300
        assert (distance[clear, column] < 0.01).mean() > 0.99 and (confidence[clear] > 100).mean() > 0.95


@pytest.mark.parametrize("seed", range(3))
def test_surface_voxels_of_random_blocks_are_all_found(seed: int) -> None:
    snapshot = random_map(seed)
    surface = surface_voxels(snapshot)
    places = voxel_places(snapshot, surface.row, surface.voxel)
    order = np.lexsort(places.T[::-1])
    expected, points = brute_force(snapshot)
    np.testing.assert_array_equal(places[order], expected)
    np.testing.assert_allclose(surface.point[order], points, atol=1e-12)


def test_points_are_all_surface_points_in_the_box() -> None:
    lower, upper = (-0.3137, -0.2711, 0.0513), (0.8329, 0.3317, 0.3719)
    xyz, label, confidence = surface_of(whole())
    inside = ((xyz >= lower) & (xyz <= upper)).all(axis=1)
    found = points_in_box(whole(), lower, upper)
    assert 500 < inside.sum() < 0.8 * len(xyz)
    np.testing.assert_allclose(found.xyz, xyz[inside], atol=1e-6)
    np.testing.assert_array_equal(found.label, label[inside])
    np.testing.assert_allclose(found.confidence, confidence[inside] / 255, atol=1e-6)
    assert found.xyz.dtype == found.confidence.dtype == np.float32 and found.rgb.shape == found.xyz.shape
    assert len(points_in_box(whole(), (5, 5, 5), (6, 6, 6)).xyz) == 0


def test_a_costmap_is_the_floor_plan_without_what_is_within_the_radius_of_something() -> None:
    plain, costs = costmap(whole(), 0.0, up=(0, 0, 2)), costmap(whole(), 0.2)
    assert up_in(whole()) is up_in(whole()), "found once a map"
    beside = BOX + np.array((0.0, 0.45, 0.0))
    assert plain.at((BOX, BALL, beside, (9, 9, 0))).tolist() == [100, 100, 0, -1]
    assert costs.at((BOX, BALL, beside, (-9, 0, 0))).tolist() == [100, 100, 99, -1] and costs.at(BOX) == [100]
    cells, occupied = np.argwhere(plain.cells == plain.cells), np.argwhere(plain.cells == 100)
    near = scipy.spatial.KDTree(occupied).query(cells)[0].reshape(plain.cells.shape) * plain.resolution_m <= 0.2 + 1e-9
    np.testing.assert_array_equal(costs.cells, np.where(near & (plain.cells != 100), 99, plain.cells))
    assert {*np.unique(costs.cells).tolist()} == {-1, 0, 99, 100}
    np.testing.assert_array_equal(costs.cells_of(costs.centres_of(cells)), cells)
    assert (costmap(whole(), 0.2, height_m=(0.5, 1.0)).at((BOX, BALL)) < 99).all(), "a robot that is higher than both"
    for wrong, said in (({"radius_m": -1.0}, "radius"), ({"radius_m": np.nan}, "radius"), ({"up": (0, 0, 0)}, "up")):
        with pytest.raises(MapError, match=said):
            costmap(whole(), **{"radius_m": 0.2, **wrong})
