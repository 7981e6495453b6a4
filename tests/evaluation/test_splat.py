from __future__ import annotations

import numpy as np

from semantic_mapper.evaluation.splat import draw_points, from_above, from_angle, hides_the_room
from tests.evaluation.room_points import class_id, room_points

BLACK = (0, 0, 0)


def square(center: tuple[float, float, float], color: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.5, 0.5, 40))
    xyz = np.stack((a.ravel(), b.ravel(), 0 * a.ravel()), axis=1) + center
    return xyz, np.tile(np.array(color, np.uint8), (len(xyz), 1))


def test_the_nearer_of_two_surfaces_is_drawn_without_holes() -> None:
    near, red = square((0, 0, 1), (255, 0, 0))
    far, blue = square((0, 0, 2), (0, 0, 255))
    for order in (1, -1):
        xyz, colors = np.concatenate((near, far)[::order]), np.concatenate((red, blue)[::order])
        picture, _ = draw_points(xyz, colors, (80, 80), BLACK)
        inner = picture[10:-10, 10:-10]
        assert inner[..., 0].min() > 150 and inner[..., 2].max() == 0


def test_the_scale_is_pixels_a_metre() -> None:
    xyz, colors = square((3, -2, 0), (255, 255, 255))
    picture, scale = draw_points(xyz, colors, (200, 120), BLACK)
    columns = np.flatnonzero((picture[60] > 100).any(axis=-1))
    assert abs((columns[-1] - columns[0] + 1) / scale - 1) < 0.06
    assert abs(columns.mean() - 99.5) < 2  # in the middle


def test_no_points_give_an_empty_picture() -> None:
    picture, _ = draw_points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), (30, 20), (9, 8, 7))
    assert picture.shape == (20, 30, 3)
    assert (picture == (9, 8, 7)).all()


def test_a_single_point_is_drawn() -> None:
    picture, _ = draw_points(np.zeros((1, 3)), np.full((1, 3), 255, np.uint8), (30, 20), BLACK)
    assert picture.max() > 0


def test_from_above_north_is_up_and_the_highest_is_nearest() -> None:
    np.testing.assert_array_equal(from_above(np.array([[1.0, 2, 3]])), [[1, -2, -3]])


def test_a_viewer_at_an_angle_sees_near_things_below_and_high_things_above() -> None:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    view = from_angle(points, azimuth=0.0, elevation=np.deg2rad(45))  # from +x
    near, far, high, left = view
    assert near[2] < far[2] and near[1] > far[1]
    assert high[1] < 0
    assert left[0] > 0 and abs(left[1]) < 1e-12  # +y lies to the right of one who looks along -x
    np.testing.assert_allclose(np.linalg.norm(view, axis=1), np.linalg.norm(points, axis=1))


def test_walls_on_the_viewers_side_are_left_out_and_nothing_else() -> None:
    points = room_points()
    inside = points.label != class_id("ceiling")
    xyz, label = points.xyz[inside].astype(np.float64), points.label[inside]
    hidden = hides_the_room(xyz, azimuth=0.0)  # from +x
    near_wall = (xyz[:, 0] > 3.9) & (xyz[:, 2] > 0.2)
    assert hidden[near_wall].mean() > 0.95
    assert hidden[(xyz[:, 0] < 2) | (label == class_id("table")) | (label == class_id("floor"))].mean() < 0.01


def test_an_empty_map_hides_nothing() -> None:
    assert hides_the_room(np.zeros((0, 3)), 0.3).shape == (0,)
