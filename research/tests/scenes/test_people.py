"""People and animals in rooms: people with a class, animals without, seen by the camera, some of them moving."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes import RoomConfig, Scene, make_room, room_views
from research.scenes.scene import scene_at
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

BEINGS = (ROOMS.id_of("person"), ROOMS.ignore_id)
PEOPLED = RoomConfig(shadow_resolution=8, people=1.0)
CAMERA = CameraIntrinsics(fx=27.6, fy=27.6, cx=19.5, cy=14.5, width=40, height=30)


@pytest.fixture(scope="module")
def rooms() -> list[Scene]:
    return [make_room(seed, PEOPLED) for seed in range(12)]


def test_rooms_have_nobody_unless_asked_for() -> None:
    for seed in range(6):
        scene = make_room(seed, RoomConfig(shadow_resolution=8))
        assert scene.walks == () and not np.isin(scene.primitives.label, BEINGS).any()


def test_people_stand_inside_a_room_that_is_otherwise_the_same(rooms: list[Scene]) -> None:
    met = 0
    for scene in rooms:
        being = np.isin(scene.primitives.label, BEINGS)
        plain = make_room(scene.seed, RoomConfig(shadow_resolution=8)).primitives
        np.testing.assert_array_equal(scene.primitives.center[~being], plain.center)
        low, high = scene.primitives.bounds()
        assert (low[being] >= -1e-6).all() and (high[being] <= np.array(scene.size_m) + 1e-6).all()
        met += bool(being.any())
    assert met >= 10


def test_only_walkers_move_and_by_no_more_than_their_reach(rooms: list[Scene]) -> None:
    walking = [scene for scene in rooms if scene.walks]
    assert len(walking) >= 3
    for scene in walking:
        moves = np.isin(scene.primitives.group, [walk.group for walk in scene.walks])
        assert np.isin(scene.primitives.label[moves], BEINGS).all()
        first, later = scene_at(scene, 0).primitives, scene_at(scene, 3).primitives
        np.testing.assert_array_equal(first.center[~moves], later.center[~moves])
        way = np.linalg.norm(first.center[moves] - later.center[moves], axis=1)
        assert 0 < way.max() <= 1.0
        assert not scene.primitives.casts_shadow[moves].any()


def test_the_camera_sees_people_with_their_class_and_animals_without(rooms: list[Scene]) -> None:
    seen = np.zeros(2, int)
    for scene in rooms:
        for view in room_views(scene.seed, 4, CAMERA, room=PEOPLED, scene=scene):
            beings = np.stack([view.rendered.label == label for label in BEINGS])
            assert (view.rendered.exact_depth_m[beings.any(axis=0)] > 0).all()
            seen += beings.sum(axis=(1, 2))
    assert seen[0] > 100 and seen[1] > 0
