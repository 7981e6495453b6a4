from __future__ import annotations

import numpy as np
import pytest

from research.evaluation.consistency import Agreement, label_agreement, matching_pixels
from semantic_mapper.errors import ShapeError
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(4.0, 4.0, 3.5, 1.5, 8, 4)
WALL = np.full((4, 8), 2.0, np.float32)  # 2 m ahead: a pixel is half a metre wide


def moved(x: float, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def test_a_step_to_the_right_moves_a_wall_to_the_left() -> None:
    index_a, index_b = matching_pixels(WALL, moved(0), WALL, moved(1.0), CAMERA)
    # One metre is two pixels; the two leftmost columns leave the picture.
    assert len(index_a) == 4 * 6
    np.testing.assert_array_equal(index_a % 8 - 2, index_b % 8)
    np.testing.assert_array_equal(index_a // 8, index_b // 8)


def test_what_another_surface_hides_is_no_match() -> None:
    hidden = WALL.copy()
    hidden[:, 3] = 1.0
    _, index_b = matching_pixels(WALL, moved(0), hidden, moved(1.0), CAMERA)
    assert len(index_b) == 4 * 5 and 3 not in index_b % 8


def test_pixels_without_depth_or_behind_the_camera_match_nothing() -> None:
    hole = WALL.copy()
    hole[0] = 0
    assert len(matching_pixels(hole, moved(0), WALL, moved(0), CAMERA)[0]) == 3 * 8
    assert len(matching_pixels(WALL, moved(0), WALL, moved(0, 3.0), CAMERA)[0]) == 0


def test_agreement_by_hand_where_unknown_agrees_with_nothing() -> None:
    a = np.array([[1, 1, 2, 0]], np.uint8)
    b = np.array([[1, 2, 2, 0]], np.uint8)
    everywhere = (np.arange(4), np.arange(4))
    found = label_agreement(a, b, everywhere, ignore_id=0)
    assert (found.agreeing, found.compared) == (2, 4)
    assert (found + Agreement(2, 4)).fraction == pytest.approx(0.5)
    assert Agreement().fraction is None


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match="depth_b_m"):
        matching_pixels(WALL, moved(0), WALL[:2], moved(0), CAMERA)
    with pytest.raises(ShapeError):
        matching_pixels(WALL[:2], moved(0), WALL, moved(0), CAMERA)
