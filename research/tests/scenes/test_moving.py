"""Rooms in which things move: truth says what differs from the still room, and when."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from research.scenes import CameraPathConfig, NoiseConfig, RoomConfig, room_views
from research.scenes.moving import MovingRoom, make_moving_room, moving_scene_at, moving_views
from research.scenes.primitives import PERSON
from research.scenes.tracks import FRAME_HZ
from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(fx=27.6, fy=27.6, cx=19.5, cy=14.5, width=40, height=30)
ROOM, PATH = RoomConfig(shadow_resolution=8, min_side_m=4.5, max_side_m=7.0), CameraPathConfig(step_m=0.03)
SEED, FRAMES = 200_000, 100


@pytest.fixture(scope="module")
def room() -> MovingRoom:
    return make_moving_room(SEED, FRAMES, room=ROOM, path=PATH)


def test_pictures_differ_from_those_of_the_still_room_only_where_truth_says(room: MovingRoom) -> None:
    assert [thing.name for thing in room.things] == [PERSON, PERSON, "chair", "box", "door"]
    seen: set[int] = set()
    still = room_views(SEED, FRAMES, CAMERA, room=ROOM, path=PATH)
    for moving, plain in zip(moving_views(room, CAMERA), still, strict=True):
        np.testing.assert_array_equal(moving.view.T_world_camera, plain.T_world_camera)
        same = (moving.view.frame.rgb == plain.frame.rgb).all(-1)
        same &= moving.view.rendered.exact_depth_m == plain.rendered.exact_depth_m
        closed = plain.rendered.label == ROOMS.id_of("door")  # where the leaf has left
        assert (same | moving.movable | closed).all()
        assert not (same & moving.movable & ~closed).any()
        seen |= set(np.unique(moving.thing))
    assert seen == {0, 1, 2, 3, 4, 5}


def test_pixels_move_while_their_thing_does_and_for_a_second_after(room: MovingRoom) -> None:
    walker, _, chair, box, _ = room.things
    assert walker.moves().all(), "turns at once at the ends of its way"
    place = chair.T_world_rest[:, :2, 3]
    start, end = (int(np.argmax((place != ends).any(1) if k == 0 else (place == ends).all(1))) for k, ends in
                  enumerate((place[0], place[-1])))  # fmt: skip
    assert np.flatnonzero(chair.moves()).tolist() == list(range(start, end + FRAME_HZ))
    put, taken = np.flatnonzero(np.diff(box.there)) + 1
    assert np.flatnonzero(box.moves()).tolist() == [*range(put, put + FRAME_HZ), *range(taken, taken + FRAME_HZ)]
    for frame, view in enumerate(moving_views(room, CAMERA)):
        own = [view.thing == number + 1 for number in range(len(room.things))]
        np.testing.assert_array_equal(
            view.moving, np.any([o & t.moves()[frame] for o, t in zip(own, room.things, strict=True)], axis=0)
        )


def test_people_walk_on_free_floor_at_a_walking_pace(room: MovingRoom) -> None:
    for person in room.things[:2]:
        way = np.linalg.norm(np.diff(person.T_world_rest[:, :2, 3], axis=0), axis=1) * FRAME_HZ
        assert 0.7 < way.max() < 1.3
        for frame in range(0, FRAMES, 10):
            p = moving_scene_at(room, frame).primitives
            low, high = p.bounds()
            body = low[np.flatnonzero(p.label == ROOMS.id_of(PERSON))]
            assert (body > -0.05).all() and (body < np.array(room.scene.size_m)).all()
            x, y = person.T_world_rest[frame, :2, 3]
            tall = (p.label != ROOMS.id_of(PERSON)) & (p.group > 1) & (low[:, 2] < 1.5) & (high[:, 2] > 0.1)
            inside = (low[:, 0] < x) & (x < high[:, 0]) & (low[:, 1] < y) & (y < high[:, 1])
            assert not (tall & inside).any()


def test_everything_follows_from_the_seed(room: MovingRoom) -> None:
    again = make_moving_room(SEED, FRAMES, room=ROOM, path=PATH)
    for a, b in zip(room.things, again.things, strict=True):
        np.testing.assert_array_equal(a.T_world_rest, b.T_world_rest)
    noise = NoiseConfig()
    (a, b) = (next(moving_views(r, CAMERA, noise=noise)) for r in (room, again))
    np.testing.assert_array_equal(a.view.frame.rgb, b.view.frame.rgb)


def test_people_have_a_class_of_their_own(room: MovingRoom) -> None:
    people = 0
    for view in islice(moving_views(room, CAMERA), 40):
        person = (view.thing == 1) | (view.thing == 2)
        np.testing.assert_array_equal(view.view.rendered.label == ROOMS.id_of(PERSON), person)
        people += int(person.sum())
    assert people > 100


def test_other_numbers_of_people_and_other_people_are_refused() -> None:
    with pytest.raises(ConfigError, match="people must be 0 to 3, got 4"):
        make_moving_room(SEED, 2, people=4)
    with pytest.raises(ConfigError, match="ask for people by number"):
        make_moving_room(SEED, 2, room=RoomConfig(people=0.5))
