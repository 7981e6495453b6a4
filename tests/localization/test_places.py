from __future__ import annotations

from functools import cache

import numpy as np

from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.localization.features import (
    Features,
    find_place_features,
    match_features,
    pose_from_features,
    pose_from_points,
)
from semantic_mapper.localization.places import rank_places
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.drawn_room import walk_frames

INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)


@cache
def walk() -> tuple[PosedFrame, ...]:
    """Every third of 24 frames through a furnished room."""
    return walk_frames(7, 24, INTRINSICS, step_m=0.06)[::3]


def features_of(frame: PosedFrame, light: float = 1.0) -> Features:
    assert frame.depth_m is not None
    rgb = np.clip(frame.rgb * light, 0, 255).astype(np.uint8)
    return find_place_features(rgb, frame.depth_m, 300)


def test_a_place_is_found_among_others_in_weaker_light() -> None:
    places = {number: features_of(frame).descriptors for number, frame in enumerate(walk())}
    for number, frame in enumerate(walk()):
        assert rank_places(features_of(frame, 0.5), places, 3)[0][0] == number


def test_the_pose_between_two_views_comes_of_their_features() -> None:
    a, b = walk()[0], walk()[1]
    found = pose_from_features(features_of(b), features_of(a), INTRINSICS, 12)
    assert found is not None
    off = invert_pose(invert_pose(a.T_world_camera) @ b.T_world_camera) @ found[0]
    assert np.linalg.norm(off[:3, 3]) < 0.05 and np.rad2deg(np.linalg.norm(rotation_vector(off))) < 1.5


def test_images_without_features_match_nothing() -> None:
    flat = find_place_features(np.full((48, 64, 3), 90, np.uint8), np.ones((48, 64), np.float32), 100)
    assert len(flat.pixels) == 0 and flat.descriptors.shape == (0, 128)
    assert match_features(flat.descriptors, features_of(walk()[0]).descriptors).shape == (0, 2)
    assert rank_places(flat, {0: features_of(walk()[0]).descriptors}, 3) == []
    same = np.tile([[0.1, 0.2, 1.0]], (12, 1))
    assert pose_from_points(same, np.tile([[92.7, 85.9]], (12, 1)), INTRINSICS, 12, 4.0) is None
