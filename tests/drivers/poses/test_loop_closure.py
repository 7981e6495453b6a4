from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.drivers.poses.alignment import Target
from semantic_mapper.drivers.poses.depth_view import Level, make_levels, thin_depth
from semantic_mapper.drivers.poses.keyframe_map import OdometryKeyframe
from semantic_mapper.drivers.poses.loop_closure import LoopCloser
from semantic_mapper.drivers.poses.pose_graph import between
from semantic_mapper.drivers.poses.trail import PoseTrail
from semantic_mapper.localization.features import Features, find_place_features
from semantic_mapper.types import Float64, PosedFrame

from .images import rigid
from .test_odometry import CONFIG, INTRINSICS, walk

NOWHERE = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))


def keyframe(number: int, frame: PosedFrame, pose: Float64, *, place: bool = False) -> OdometryKeyframe:
    assert frame.depth_m is not None
    levels: tuple[Level, ...] = make_levels(thin_depth(frame.depth_m, 1, 6.0), INTRINSICS, 3)
    features = find_place_features(frame.rgb, frame.depth_m, 300) if place else NOWHERE
    return OdometryKeyframe(number, Target(levels, pose), NOWHERE, features, 0.0)


def finish(closer: LoopCloser) -> dict[int, Float64]:
    poses: dict[int, Float64] = {}
    while closer.busy:
        poses |= closer.work(optimize=True) or {}
    return poses


def there_and_back() -> list[PosedFrame]:
    frames = walk()
    return [frames[i] for i in (0, 6, 12, 18, 12, 6, 0)]


def drift(k: int) -> Float64:
    return rigid(shift=(0.008 * k, 0, 0))


def test_keyframes_that_come_back_are_aligned_and_the_graph_takes_the_drift_back() -> None:
    closer, frames = LoopCloser(CONFIG), there_and_back()
    for k, frame in enumerate(frames):
        closer.add(keyframe(k, frame, drift(k) @ frame.T_world_camera), None if k == 0 else k - 1)
    poses = finish(closer)
    assert closer.counters["loops_closed"] >= 3 and closer.counters["loops_refused"] == 0
    assert between(drift(6) @ frames[6].T_world_camera, frames[6].T_world_camera)[0] > 0.04
    assert max(between(poses[k], f.T_world_camera)[0] for k, f in enumerate(frames)) < 0.01


def far_off(closer: LoopCloser, count: int) -> list[PosedFrame]:
    """Keyframes there, a bare wall that none of them can be aligned to, and back 0.4 m off."""
    frames = there_and_back()[:count]
    frames[3] = replace(frames[3], depth_m=np.full((120, 160), 0.4, np.float32))
    jump = rigid(shift=(0.0, 0.4, 0.0))
    for k, frame in enumerate(frames):
        pose = jump @ frame.T_world_camera if k > 3 else frame.T_world_camera
        closer.add(keyframe(k, frame, pose, place=k != 3), None if k == 0 else k - 1)
    return frames


def test_one_far_loop_alone_is_not_believed_and_two_that_agree_are() -> None:
    alone = LoopCloser(CONFIG)
    frames = far_off(alone, 5)
    assert 0.35 < between(finish(alone)[4], frames[4].T_world_camera)[0] < 0.45  # it stays where tracking saw it
    closer = LoopCloser(CONFIG)
    frames = far_off(closer, 7)
    poses = finish(closer)
    assert closer.counters["loops_closed"] >= 2
    assert max(between(poses[k], f.T_world_camera)[0] for k, f in enumerate(frames) if k != 3) < 0.02


def test_nothing_is_closed_while_it_must_not() -> None:
    closer = LoopCloser(CONFIG)
    for k, frame in enumerate(there_and_back()):
        closer.add(keyframe(k, frame, drift(k) @ frame.T_world_camera), None if k == 0 else k - 1)
    for _ in range(100):
        assert closer.work(optimize=False) is None
    assert closer.busy and closer.counters["loops_closed"] == 0


def test_poses_that_were_given_move_with_their_keyframes() -> None:
    trail = PoseTrail()
    assert trail.correction({}, final=True) is None
    keyframes = {0: np.eye(4), 1: rigid(shift=(1, 0, 0))}
    for stamp, (number, x) in enumerate(((0, 0.0), (0, 0.5), (1, 1.2))):
        trail.add(stamp, number, keyframes[number], rigid(shift=(x, 0, 0)))
    assert trail.correction(keyframes, final=True) is None  # nothing has moved
    moved = {0: np.eye(4), 1: rigid((0, 0, np.pi / 2), (1, 0.1, 0))}
    found = trail.correction(moved, final=False)
    assert found is not None and found.until_ns == 2
    assert found.poses[1][:3, 3] == pytest.approx((0.5, 0, 0))
    assert found.poses[2][:3, 3] == pytest.approx((1.0, 0.3, 0))
    assert (found.motion @ rigid(shift=(1.2, 0, 0)))[:3, 3] == pytest.approx((1.0, 0.3, 0))
    assert trail.correction(moved, final=True) is None  # told already
    trail.hand_over(1, 0, moved[1])
    assert trail.correction({0: np.eye(4)}, final=True) is None
