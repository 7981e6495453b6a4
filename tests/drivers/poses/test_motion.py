from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.drivers.poses.motion import PoseTrack, StampedPose
from semantic_mapper.types import Float64

from .images import MS, rigid

RATE = np.array((0.3, -0.8, 0.5))  # radians a second
SPEED = np.array((0.4, 0.1, -0.2))  # metres a second


def truth(stamp_ns: int) -> Float64:
    """Steady turning and a straight way: what slerp and a line give exactly."""
    t = stamp_ns / 1e9
    return rigid(RATE * t, SPEED * t)


def track(stamps_ms: list[int], **limits: int) -> PoseTrack:
    made = PoseTrack(
        limits.get("keep", 100), limits.get("gap_ms", 200) * MS, max_ahead_ns=limits.get("ahead_ms", 50) * MS
    )
    for ms in stamps_ms:
        assert made.add(StampedPose(ms * MS, truth(ms * MS), 0.01))
    return made


def test_between_samples_and_for_a_bounded_while_after_them_the_motion_is_steady() -> None:
    made = track(list(range(1000, 3001, 100)))
    for ms, sigma in ((1000, 0.01), (1234, 0.01), (2999, 0.01), (3001, None), (3050, None)):
        found = made.at(ms * MS)
        assert isinstance(found, StampedPose) and found.stamp_ns == ms * MS
        assert np.allclose(found.T, truth(ms * MS), atol=1e-9)
        assert found.sigma == pytest.approx(sigma) if sigma else found.sigma > 0.01  # a guess is less sure


def test_where_there_is_no_pose_the_track_says_why() -> None:
    made = track([1000, 1100, 1600, 1700])
    assert PoseTrack(3, 1, 1).at(5) == "empty"
    assert made.at(999 * MS) == "before"
    assert made.at(1300 * MS) == "gap"
    assert made.at(1751 * MS) == "stale"
    assert isinstance(made.at(1600 * MS), StampedPose)
    assert track([1000]).at(1001 * MS) == "stale"  # one pose tells no motion
    assert track([1000, 1500]).at(1501 * MS) == "stale"  # nor do two that are far apart


def test_late_and_doubled_samples_are_left_out_and_old_ones_forgotten() -> None:
    made = track([100, 200, 300], keep=2)
    assert not made.add(StampedPose(300 * MS, np.eye(4)))
    assert not made.add(StampedPose(250 * MS, np.eye(4)))
    assert made.at(150 * MS) == "before" and made.newest_ns == 300 * MS
