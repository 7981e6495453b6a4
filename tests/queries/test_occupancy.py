"""Distances to obstacles against a search of all voxels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from semantic_mapper.queries.occupancy import State, distance_field, occupancy
from tests.queries.random_map import random_map
from tests.queries.scene import whole
from tests.queries.test_surface import dense

LOWER, UPPER = (-0.05, -0.35, -0.1), (1.23, 0.41, 0.57)


@pytest.mark.parametrize("unknown_is_occupied", [False, True])
def test_distance_is_to_the_nearest_obstacle(unknown_is_occupied: bool) -> None:
    field = distance_field(whole(), LOWER, UPPER, unknown_is_occupied=unknown_is_occupied)
    first, last = np.ceil(np.divide(LOWER, 0.02)), np.floor(np.divide(UPPER, 0.02))
    assert field.distance_m.shape == field.state.shape == tuple((last - first + 1).astype(int))
    np.testing.assert_allclose(field.origin_m, first * 0.02)
    centers = field.origin_m + np.indices(field.state.shape).reshape(3, -1).T * field.voxel_size_m
    np.testing.assert_array_equal(field.state.ravel(), occupancy(whole(), centers))
    assert {0, 1, 2} == set(np.unique(field.state))
    bad = field.state.ravel() == State.OCCUPIED
    if unknown_is_occupied:
        bad |= field.state.ravel() == State.UNKNOWN
    expected = KDTree(centers[bad]).query(centers)[0]
    np.testing.assert_allclose(field.distance_m.ravel(), expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_states_of_random_blocks_are_those_of_their_voxels(seed: int) -> None:
    snapshot = random_map(seed)
    tsdf, observed, first = dense(snapshot)
    expected = np.where(observed, np.where(tsdf * 4.0 / 127 <= 0.5, State.OCCUPIED, State.FREE), State.UNKNOWN)
    last = first + np.array(tsdf.shape) - 1
    np.testing.assert_array_equal(distance_field(snapshot, first * 0.02, last * 0.02).state, expected)
    centers = (first + np.indices(tsdf.shape).reshape(3, -1).T) * 0.02
    np.testing.assert_array_equal(occupancy(snapshot, centers), expected.ravel())


def test_what_moves_is_an_obstacle_for_now() -> None:
    points = np.array([(0.5, 0.0, 0.5), (0.505, 0.0, 0.5), (9.0, 9.0, 9.0)], np.float32)
    now = whole().with_moving(points)
    assert occupancy(now, points).tolist() == [State.MOVING] * 3
    assert State.MOVING not in occupancy(whole(), points) and State.MOVING not in occupancy(now, points - 0.1)
    field, before = (distance_field(s, LOWER, UPPER) for s in (now, whole()))
    assert (field.state == State.MOVING).sum() == 1
    at = tuple(np.rint((points[0] - field.origin_m) / 0.02).astype(int))
    assert field.state[at] == State.MOVING and field.distance_m[at] == 0 < before.distance_m[at]
    assert (field.distance_m <= before.distance_m).all()
