"""Storeys: rooms that do not overlap, doors where one can walk through, and a survey inside of them."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes.render import cast_view
from research.scenes.storey import CORRIDOR, WALL_M, make_storey
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(20.0, 20.0, 15.5, 11.5, 32, 24)


@pytest.mark.parametrize("seed", [0, 1])
def test_rooms_are_joined_by_doors_that_are_open(seed: int) -> None:
    storey = make_storey(seed, 60.0, clutter=0.0)
    assert [room.template == CORRIDOR for room in storey.rooms].count(True) == (seed == 0)
    assert sum(float(np.prod(room.high - room.low)) for room in storey.rooms) == pytest.approx(60.0, rel=0.15)
    reached = {0}
    for _ in storey.rooms:
        reached |= {n for door in storey.doors if reached & set(door.rooms) for n in door.rooms}
    assert reached == set(range(len(storey.rooms)))
    for door in storey.doors:
        a, b = (storey.rooms[n] for n in door.rooms)
        gap = np.maximum(a.low, b.low) - np.minimum(a.high, b.high)  # positive across the wall
        across = int(gap.argmax())
        assert gap[across] == pytest.approx(WALL_M)
        pose = np.eye(4)
        pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]] if across == 0 else [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        pose[:3, 3] = [*door.center, 1.0]
        pose[across, 3] -= 0.2
        assert cast_view(storey.scene, CAMERA, pose)[0][11:13, 15:17].min() > 0.5
    centers = np.array([(room.low + room.high) / 2 for room in storey.rooms])
    np.testing.assert_array_equal(storey.room_at(centers), np.arange(len(storey.rooms)))
    assert (storey.room_at(centers - 100) == -1).all()
