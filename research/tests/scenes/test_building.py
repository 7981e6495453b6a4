"""The building: rooms apart from each other, a walk that comes back, one scene held at a time."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest

from research.scenes import (
    TRAIN_SEEDS,
    NoiseConfig,
    RoomConfig,
    building_walk,
    make_room,
    room_cell,
    room_frames,
)
from research.scenes import sequence as sequence_module
from research.scenes.building import BEYOND_M
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(fx=33.0, fy=33.0, cx=23.5, cy=17.5, width=48, height=36)
FAST = RoomConfig(shadow_resolution=16)


def seen_points(frame: PosedFrame) -> np.ndarray:
    assert frame.depth_m is not None
    points = unproject(frame.depth_m, frame.intrinsics)[frame.depth_m > 0]
    return transform(frame.T_world_camera, points)


def building_frames(*args: Any, **options: Any) -> Iterator[PosedFrame]:
    """The frames of a walk, one after the other."""
    return (frame for visit in building_walk(*args, **options) for frame in visit.frames)


def test_every_room_lies_in_its_own_cell_with_all_that_its_opening_shows() -> None:
    for index in range(40):
        scene = make_room(TRAIN_SEEDS[index], FAST)
        low, high = scene.primitives.bounds()
        cell_low, cell_high = room_cell(index, 40)
        origin = np.array([cell_low[0] + BEYOND_M, cell_low[1] + BEYOND_M, 0.0])
        assert (low.min(0) + origin > cell_low).all() and (high.max(0) + origin < cell_high).all()
    cells = [room_cell(k, 7) for k in range(7)]
    for i, (low, high) in enumerate(cells):
        for other_low, other_high in cells[:i]:
            assert ((low >= other_high + 0.99) | (high <= other_low - 0.99))[:2].any(), "cells are a metre apart"


def test_what_the_camera_sees_lies_in_the_cell_of_the_visit() -> None:
    for visit in building_walk(5, 3, CAMERA, returns=1, room=FAST):
        for frame in visit.frames:
            points = seen_points(frame)
            assert len(points) > 100
            assert (points > visit.low).all() and (points < visit.high).all()


def test_a_walk_goes_through_all_rooms_and_comes_back_to_the_first() -> None:
    visits = [
        (v.number, v.room, v.returning, list(v.frames)) for v in building_walk(3, 2, CAMERA, returns=2, room=FAST)
    ]
    assert [v[:3] for v in visits] == [(0, 0, False), (1, 1, False), (2, 2, False), (3, 0, True), (4, 1, True)]
    frames = [frame for visit in visits for frame in visit[3]]
    assert [f.seq for f in frames] == list(range(10))
    np.testing.assert_array_equal(frames[6].T_world_camera, frames[0].T_world_camera)
    np.testing.assert_array_equal(frames[9].rgb, frames[3].rgb)
    (own,) = islice(room_frames(TRAIN_SEEDS[1], 2, CAMERA, room=FAST), 1, None)
    moved = frames[3].T_world_camera - own.T_world_camera
    np.testing.assert_allclose(moved[:3, 3], room_cell(1, 3)[0] + (BEYOND_M, BEYOND_M, 1.0))
    assert not moved[:, :3].any()


def test_stamps_follow_the_rate() -> None:
    stamps = [f.stamp_ns for f in building_frames(2, 3, CAMERA, hz=2.0, room=FAST)]
    assert stamps == [round(k * 0.5e9) for k in range(1, 7)]


def test_the_same_arguments_give_the_same_frames() -> None:
    first, again = (list(building_frames(2, 2, CAMERA, returns=1, room=FAST, noise=NoiseConfig())) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        assert a.rgb.tobytes() == b.rgb.tobytes() and a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
        assert a.depth_m is not None and b.depth_m is not None and a.depth_m.tobytes() == b.depth_m.tobytes()


def test_one_scene_is_held_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[weakref.ref[object]] = []
    alive: list[int] = []

    def counted(*arguments: object) -> object:
        scene = make_room(*arguments)  # type: ignore[arg-type]
        made.append(weakref.ref(scene.primitives.center))
        return scene

    monkeypatch.setattr(sequence_module, "make_room", counted)
    for _ in building_frames(6, 1, CAMERA, returns=1, room=FAST):
        alive.append(sum(ref() is not None for ref in made))
    assert len(made) == 7 and max(alive) == 1


@pytest.mark.parametrize("bad", [{"rooms": 0}, {"frames_a_room": 0}, {"returns": 3}, {"returns": -1}, {"hz": 0.0}])
def test_a_walk_that_is_none_is_refused(bad: dict[str, float]) -> None:
    arguments = {"rooms": 2, "frames_a_room": 1, "returns": 0, "hz": 1.0, **bad}
    rooms, count = int(arguments["rooms"]), int(arguments["frames_a_room"])
    with pytest.raises(ConfigError, match="building: need"):
        next(building_walk(rooms, count, CAMERA, returns=int(arguments["returns"]), hz=arguments["hz"]))
