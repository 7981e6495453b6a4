import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.mapping.correction.pose_correction import ALWAYS, PoseCorrection, PosePair

small = st.floats(-0.5, 0.5)
vectors = st.tuples(small, small, small).map(np.array)
shares = st.floats(0.01, 0.99)


def rigid(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.asarray(turn, np.float64))[0]
    T[:3, 3] = shift
    return T


def angle(T: np.ndarray) -> float:
    return float(np.linalg.norm(cv2.Rodrigues(T[:3, :3])[0]))


POSES = [rigid(np.array([0.1 * i, 0.2, -0.1 * i]), np.array([0.3 * i, 0.1, 1.0])) for i in range(5)]
C = rigid(np.array([0.02, -0.03, 0.05]), np.array([0.05, 0.0, -0.02]))
D = rigid(np.array([-0.04, 0.01, 0.02]), np.array([0.0, 0.07, 0.01]))


def test_a_given_frame_gets_the_very_pose_that_was_given():
    new = C @ POSES[1]
    correction = PoseCorrection([PosePair("a", 100, POSES[1], new)], 100)
    assert correction.place("a", 100, POSES[1]) is new


def test_unchanged_poses_leave_all_frames_as_they_are_to_the_bit():
    pairs = [PosePair("a", 100 * i, POSES[i], POSES[i].copy()) for i in (1, 3)]
    correction = PoseCorrection(pairs, ALWAYS)
    for i in range(5):
        assert correction.place("a", 100 * i, POSES[i]).tobytes() == POSES[i].tobytes()


def test_halfway_in_time_a_frame_turns_by_half_the_angle_and_goes_half_the_way():
    axis = np.array([0.0, 0.0, 1.0])
    here = rigid(np.zeros(3), np.array([2.0, 0.0, 0.0]))
    turned = here @ rigid(0.4 * axis, np.array([0.0, 0.1, 0.0]))
    correction = PoseCorrection([PosePair("a", 0, here, here.copy()), PosePair("a", 200, here, turned)], 200)
    placed = correction.place("a", 50, here)
    np.testing.assert_allclose(placed[:3, :3], rigid(0.1 * axis, np.zeros(3))[:3, :3], atol=1e-12)
    np.testing.assert_allclose(placed[:3, 3], [2.0, 0.025, 0.0], atol=1e-12)


def test_before_the_first_the_first_holds_and_after_the_last_only_up_to_the_stamp_named():
    pairs = [PosePair("a", 100, POSES[1], C @ POSES[1]), PosePair("a", 200, POSES[2], D @ POSES[2])]
    trusting, until, always = (PoseCorrection(pairs, until) for until in (200, 350, ALWAYS))
    for correction in (trusting, until, always):
        np.testing.assert_allclose(correction.place("a", 0, POSES[0]), C @ POSES[0], atol=1e-12)
    assert trusting.place("a", 300, POSES[3]) is POSES[3]
    np.testing.assert_allclose(until.place("a", 350, POSES[3]), D @ POSES[3], atol=1e-12)
    assert until.place("a", 351, POSES[4]) is POSES[4]
    np.testing.assert_allclose(always.place("a", 10**18, POSES[4]), D @ POSES[4], atol=1e-12)
    np.testing.assert_allclose(always.last_motions[0], D, atol=1e-12)


def test_another_camera_on_the_same_body_follows_in_time():
    correction = PoseCorrection([PosePair("front", 100, POSES[1], C @ POSES[1])], 100)
    np.testing.assert_allclose(correction.place("rear", 100, POSES[2]), C @ POSES[2], atol=1e-12)


@given(vectors, vectors, vectors, vectors, shares)
def test_where_the_world_has_its_origin_makes_no_difference(turn_a, shift_a, turn_b, shift_b, fraction):
    """Blended translations would fail this: the far origin is a lever."""
    a, b = rigid(turn_a, shift_a), rigid(turn_b, shift_b)
    far = rigid(np.array([0.3, -1.0, 0.5]), np.array([300.0, -200.0, 50.0]))
    stamp = int(fraction * 10**9)

    def placed(G: np.ndarray) -> np.ndarray:
        pairs = [PosePair("a", n * 10**9, G @ POSES[n], G @ m @ POSES[n]) for n, m in enumerate((a, b))]
        return PoseCorrection(pairs, 10**9).place("a", stamp, G @ POSES[2])

    np.testing.assert_allclose(placed(far), far @ placed(np.eye(4)), atol=1e-9)


@given(vectors, vectors, shares)
def test_one_motion_of_all_given_frames_moves_the_others_rigidly(turn, shift, fraction):
    motion = rigid(turn, shift)
    pairs = [PosePair("a", n * 10**9, POSES[n], motion @ POSES[n]) for n in (0, 1)]
    placed = PoseCorrection(pairs, 10**9).place("a", int(fraction * 10**9), POSES[2])
    np.testing.assert_allclose(placed, motion @ POSES[2], atol=1e-7)


@given(vectors, vectors, shares)
def test_the_result_is_a_rotation_between_the_two(turn_a, turn_b, fraction):
    a, b = rigid(turn_a, np.zeros(3)), rigid(turn_b, np.zeros(3))
    pairs = [PosePair("a", n * 10**9, POSES[n], m @ POSES[n]) for n, m in enumerate((a, b))]
    placed = PoseCorrection(pairs, 10**9).place("a", int(fraction * 10**9), np.eye(4))
    assert np.abs(placed[:3, :3].T @ placed[:3, :3] - np.eye(3)).max() < 1e-9
    assert angle(a.T @ placed) == pytest.approx(fraction * angle(a.T @ b), abs=1e-6)
