import numpy as np

from semantic_mapper.geometry import make_pose, unproject
from semantic_mapper.localization.depth_alignment import (
    Level,
    Target,
    align,
    fit,
    flat_directions,
    gauss_newton_step,
    make_levels,
    thin_depth,
    thin_intrinsics,
)
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.drawn_room import walk_frames

INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)


def levels_of(frame: PosedFrame) -> tuple[Level, ...]:
    assert frame.depth_m is not None
    return make_levels(thin_depth(frame.depth_m, 1, 6.0), INTRINSICS)


def test_alignment_finds_the_way_between_two_views_past_what_does_not_fit() -> None:
    a, _, b = walk_frames(7, 3, INTRINSICS)
    assert b.depth_m is not None
    b.depth_m[40:70, 60:100] -= 0.06  # near enough to count, were it not for its distance beyond the noise
    target = Target(levels_of(a), a.T_world_camera)
    guess = b.T_world_camera @ make_pose((0.01, -0.015, 0.01), (0.02, -0.01, 0.02))
    found = align(levels_of(b), [target], guess)
    assert found is not None
    assert np.linalg.norm(found[:3, 3] - b.T_world_camera[:3, 3]) < 0.002
    assert np.allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    before, after = (fit(levels_of(b), target, T) for T in (guess, found))
    assert after.rmse_m < 0.5 * before.rmse_m and after.fitness > 0.9 and after.overlap > 0.6


def test_a_wall_leaves_two_shifts_and_a_turn_open_and_a_corner_none() -> None:
    wall = make_levels(np.full((120, 160), 2.0, np.float32), INTRINSICS)
    flat = flat_directions([fit(wall, Target(wall, np.eye(4)), np.eye(4)).normal_matrix])
    assert flat is not None
    assert np.allclose(flat[0], np.diag((0, 0, 1)), atol=1e-3) and np.allclose(flat[1], np.diag((1, 1, 0)), atol=1e-3)
    room = levels_of(walk_frames(7, 1, INTRINSICS)[0])
    assert flat_directions([fit(room, Target(room, np.eye(4)), np.eye(4)).normal_matrix]) is None


def test_a_camera_of_which_nothing_says_anything_stays() -> None:
    np.testing.assert_array_equal(gauss_newton_step(np.zeros((6, 6)), np.zeros(6)), np.eye(4))


def test_points_and_rays_of_thinned_images_are_those_of_the_whole() -> None:
    (frame,) = walk_frames(7, 1, INTRINSICS)
    assert frame.depth_m is not None
    whole = unproject(frame.depth_m, INTRINSICS)
    for stride in (2, 3):
        small = thin_intrinsics(INTRINSICS, stride, stride // 2)
        depth = thin_depth(frame.depth_m, stride, 100.0)
        assert depth.shape == (small.height, small.width)
        assert np.allclose(unproject(depth, small), whole[stride // 2 :: stride, stride // 2 :: stride], atol=1e-5)
