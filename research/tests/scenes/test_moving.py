"""Rooms in which things move: truth says what differs from the still room, and when."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes import CameraPathConfig, RoomConfig, room_views
from research.scenes.moving import MovingRoom, make_moving_room, moving_views
from research.scenes.primitives import PERSON
from research.scenes.tracks import FRAME_HZ
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
        movable = moving.thing > 0
        assert (same | movable | closed).all()
        assert not (same & movable & ~closed).any()
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
