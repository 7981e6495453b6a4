"""What Rerun shows: from where a map is looked at first, what moves, and the way of a camera that runs for days."""

import dataclasses

import numpy as np
import pytest

from semantic_mapper.queries.graph import Room, SceneGraph
from semantic_mapper.queries.instances import Instance, OrientedBox
from semantic_mapper.replay.exporters.base import MAX_PATH, CameraPath
from semantic_mapper.replay.rerun_layout import eye_on, in_ceiling
from semantic_mapper.replay.rerun_log import moving_points, room_names
from semantic_mapper.types import CameraIntrinsics, MapUpdate

SIZE = np.array((5.0, 4.0, 2.6))


def room(*, ceiling: bool) -> tuple[np.ndarray, np.ndarray]:
    """Floor and table, and walls with or without a ceiling, of a room that stands on z = 0."""
    rng = np.random.default_rng(0)

    def plane(axis: int, value: float) -> np.ndarray:
        points = rng.random((15_000, 3)) * SIZE
        points[:, axis] = value
        return points

    table = rng.random((4000, 3)) * (1.2, 0.8, 0.7) + (2.0, 1.5, 0.0)
    walls = [plane(axis, value) for axis in (0, 1) for value in (0.0, SIZE[axis])]
    return np.concatenate((plane(2, 0.0), table)), np.concatenate(walls + ([plane(2, SIZE[2])] if ceiling else []))


@pytest.mark.parametrize("ceiling", [False, True])
def test_the_first_look_is_from_above_into_a_room_without_its_ceiling(ceiling: bool) -> None:
    xyz = np.concatenate(room(ceiling=ceiling)).astype(np.float32)
    eye = eye_on(xyz, np.array((0.0, 0.0, 1.0)))
    assert np.allclose(eye.up, (0, 0, 1), atol=0.05)
    hidden = in_ceiling(xyz, eye.up)
    assert (hidden.mean() > 0.15) == ceiling and xyz[hidden, 2].min(initial=3) > 2.2
    assert eye.target[2] < SIZE[2] < eye.position[2] and ((eye.target > 0) & (eye.target < SIZE)).all()
    ahead = eye.target - eye.position
    right = np.cross(ahead, eye.up)
    axes = [axis / np.linalg.norm(axis) for axis in (right, np.cross(ahead, right), ahead)]
    x, y, z = axes @ (xyz - eye.position).T
    out = np.maximum(abs(x), abs(y)) / z / np.tan(np.deg2rad(55 / 2))  # 1 = at the edge of a view that is square
    assert np.percentile(out, 99) > 0.8 and out.max() < 1.02


def test_what_moves_is_shown_where_it_was_seen() -> None:
    k = CameraIntrinsics(40.0, 50.0, 15.5, 11.5, 32, 24)
    shape, moving = (24, 32), np.zeros((24, 32), np.bool_)
    moving[8, 16] = moving[9, 17] = True  # of every fourth pixel, the first one is among them
    update = MapUpdate(1, 1, "c", True, False, (), np.zeros(shape, np.uint8), np.ones(shape, np.float32),
                       np.full(shape, 2.0, np.float32), 0, 0, moving=moving)  # fmt: skip
    positions = moving_points(update, k).positions
    assert positions is not None
    np.testing.assert_allclose(positions.as_arrow_array().to_pylist(), [(0.5 / 40 * 2, -3.5 / 50 * 2, 2.0)], rtol=1e-5)
    assert not moving_points(dataclasses.replace(update, moving=None), k).positions.as_arrow_array().to_pylist()


def test_a_room_is_called_by_the_largest_that_stands_in_it() -> None:
    things = [
        Instance(number, 1, name, 0.9, np.zeros(3), OrientedBox(np.zeros(3), np.full(3, size), np.eye(3)), voxels)
        for number, (name, size) in enumerate(
            [("chair", 1), ("chair", 1), ("chair", 0.1), ("table", 2), ("window", 3), ("otherprop", 1), ("sofa", 1)]
        )
        for voxels in (np.zeros((round(100 * size), 3), np.int32),)
    ]
    rooms = tuple(Room(i, 1, 9.0, np.zeros(3), np.zeros((4, 3))) for i in (1, 2))
    room_of = dict.fromkeys(range(6), 1) | {6: None}
    graph = SceneGraph(np.array((0.0, 0, 1)), (), rooms, (), tuple(things), room_of)
    assert room_names(graph) == ["room 1: chairs, table", "room 2"]


def test_the_path_of_a_camera_stays_bounded_and_even() -> None:
    path = CameraPath()
    for number in range(3 * MAX_PATH):
        T = np.eye(4)
        T[0, 3] = number
        path.add(T)
    kept = [T[0, 3] for T in path.poses]
    assert len(kept) <= MAX_PATH and set(np.diff(kept)) == {4.0} and kept[0] == 0
