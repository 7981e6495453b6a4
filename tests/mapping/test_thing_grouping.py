"""Telling things apart that touch."""

from __future__ import annotations

import numpy as np

from semantic_mapper.mapping.thing_grouping import group_things

VOXEL_M = 0.02


def slab(x0: int, x1: int, *, y: int = 10, z: int = 2) -> np.ndarray:
    """Voxels (N, 3) of a box."""
    return np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y), np.arange(z), indexing="ij"), -1).reshape(-1, 3)


def way(voxels: np.ndarray) -> np.ndarray:
    """To their middle, metres."""
    return ((voxels.mean(axis=0) - voxels) * VOXEL_M).astype(np.float32)


def test_two_things_that_touch_are_two_where_their_centres_say_so() -> None:
    left, right = slab(0, 10), slab(10, 20)
    both = np.concatenate((left, right))
    channel = np.full(len(both), 5)
    apart = group_things(both, channel, np.concatenate((way(left), way(right))), VOXEL_M)
    assert len(np.unique(apart)) == 2
    assert len(np.unique(apart[: len(left)])) == len(np.unique(apart[len(left) :])) == 1
    assert len(np.unique(group_things(both, channel, way(both), VOXEL_M))) == 1


def test_classes_and_gaps_part_things_whatever_the_centres_say() -> None:
    voxels = np.concatenate((slab(0, 10), slab(10, 20), slab(30, 40)))
    found = group_things(voxels, np.repeat((3, 4, 4), 200), way(voxels), VOXEL_M)
    assert [len(np.unique(part)) for part in np.split(found, 3)] == [1, 1, 1]
    assert len(np.unique(found)) == 3


def test_a_long_thing_whose_centres_drift_is_one() -> None:
    voxels = slab(0, 200)
    towards = np.clip(way(voxels), -0.3, 0.3)  # as far as the network says
    assert len(np.unique(group_things(voxels, np.zeros(len(voxels), np.int64), towards, VOXEL_M))) == 1


def test_crumbs_join_the_neighbour_that_is_nearest_to_what_they_say() -> None:
    left, right = slab(0, 10), slab(11, 21)
    between = slab(10, 11)  # 20 voxels that are of two minds
    ways = np.concatenate((way(left), way(right), np.full((len(between), 3), (0.09, 0, 0), np.float32)))
    voxels = np.concatenate((left, right, between))
    found = group_things(voxels, np.zeros(len(voxels), np.int64), ways, VOXEL_M)
    assert len(np.unique(found)) == 2
    assert (found[-len(between) :] == found[len(left)]).all()


def test_nothing_is_grouped_to_nothing() -> None:
    none = np.zeros((0, 3), np.int64)
    assert len(group_things(none, none[:, 0], none.astype(np.float32), VOXEL_M)) == 0
