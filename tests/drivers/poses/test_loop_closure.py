from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.drivers.poses.keyframe_map import OdometryKeyframe, PoseTrail, apart
from semantic_mapper.drivers.poses.loop_closure import Edge, LoopCloser, PoseGraph
from semantic_mapper.geometry import invert_pose
from semantic_mapper.localization.depth_alignment import Target, make_levels, thin_depth
from semantic_mapper.localization.features import Features, find_place_features
from semantic_mapper.types import Float64, PosedFrame

from .images import rigid
from .test_odometry import INTRINSICS, walk

NOWHERE = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))


def keyframe(number: int, frame: PosedFrame, pose: Float64, *, place: bool = False) -> OdometryKeyframe:
    assert frame.depth_m is not None
    levels = make_levels(thin_depth(frame.depth_m, 1, 6.0), INTRINSICS)
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
    counters = Counter[str]()
    closer, frames = LoopCloser(counters), there_and_back()
    for k, frame in enumerate(frames):
        closer.add(keyframe(k, frame, drift(k) @ frame.T_world_camera), None if k == 0 else k - 1)
    poses = finish(closer)
    assert counters["loops_closed"] >= 3 and counters["loops_refused"] == 0
    assert apart(drift(6) @ frames[6].T_world_camera, frames[6].T_world_camera)[0] > 0.04
    assert max(apart(poses[k], f.T_world_camera)[0] for k, f in enumerate(frames)) < 0.01


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
    alone = LoopCloser(Counter())
    frames = far_off(alone, 5)
    assert 0.35 < apart(finish(alone)[4], frames[4].T_world_camera)[0] < 0.45  # it stays where tracking saw it
    counters = Counter[str]()
    closer = LoopCloser(counters)
    frames = far_off(closer, 7)
    poses = finish(closer)
    assert counters["loops_closed"] >= 2
    assert max(apart(poses[k], f.T_world_camera)[0] for k, f in enumerate(frames) if k != 3) < 0.02


def test_nothing_is_closed_while_it_must_not() -> None:
    counters = Counter[str]()
    closer = LoopCloser(counters)
    for k, frame in enumerate(there_and_back()):
        closer.add(keyframe(k, frame, drift(k) @ frame.T_world_camera), None if k == 0 else k - 1)
    for _ in range(100):
        assert closer.work(optimize=False) is None
    assert closer.busy and counters["loops_closed"] == 0


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
    assert trail.correction(moved, final=True) is None  # given already
    trail.hand_over(1, 0, moved[1])
    assert trail.correction({0: np.eye(4)}, final=True) is None


COVARIANCE = np.diag([0.01**2] * 3 + [0.02**2] * 3)


def line_and_back(count: int) -> list[Float64]:
    """Poses along a line, and back to its beginning."""
    return [rigid((0, 0, 0.1 * k), (0.3 * min(k, count - 1 - k), 0, 0)) for k in range(count)]


def drifting(truth: list[Float64]) -> tuple[PoseGraph, list[Float64]]:
    """A chain whose every motion is measured 1 cm too long, and its poses."""
    graph, poses = PoseGraph(), [truth[0]]
    graph.add(0, truth[0], [])
    for k in range(1, len(truth)):
        T = invert_pose(truth[k - 1]) @ truth[k] @ rigid((0, 0, 0.01), (0.01, 0, 0))
        poses.append(poses[-1] @ T)
        graph.add(k, poses[-1], [Edge(k - 1, k, T, COVARIANCE, chain=True)])
    return graph, poses


def loop(truth: list[Float64], a: int, b: int) -> Edge:
    return Edge(a, b, invert_pose(truth[a]) @ truth[b], COVARIANCE)


def error_m(truth: list[Float64], poses: dict[int, Float64]) -> float:
    return max(apart(truth[number], pose)[0] for number, pose in poses.items())


def test_a_loop_takes_the_drift_back_and_the_first_keyframe_stays() -> None:
    truth = line_and_back(12)
    graph, poses = drifting(truth)
    before = dict(enumerate(poses))
    assert error_m(truth, before) > 0.05
    graph.edges.append(loop(truth, 0, 11))
    after = graph.optimized()
    assert error_m(truth, after) < 0.6 * error_m(truth, before)
    assert np.allclose(after[0], truth[0], atol=1e-6)
    assert apart(graph.poses[11], poses[11]) == (0, 0)  # the graph itself is as it was


def test_one_wrong_loop_among_right_ones_counts_little() -> None:
    truth = line_and_back(12)
    graph, _ = drifting(truth)
    graph.edges += [loop(truth, 0, b) for b in (9, 10, 11)]
    right = error_m(truth, graph.optimized())
    graph.edges.append(Edge(1, 8, invert_pose(truth[1]) @ truth[8] @ rigid(shift=(0.8, 0, 0)), COVARIANCE))
    assert error_m(truth, graph.optimized()) < right + 0.12


def test_edges_of_a_keyframe_that_goes_are_kept_by_its_heir() -> None:
    truth = line_and_back(12)
    graph = PoseGraph()
    for k, pose in enumerate(truth):
        graph.add(k, pose, [loop(truth, k - 1, k)] if k else [])
    graph.edges.append(loop(truth, 5, 11))
    assert graph.linked(5) == {4, 5, 6, 11}
    graph.remove(5, heir=4)
    assert set(graph.poses) == set(range(12)) - {5}
    assert graph.linked(4) == {3, 4, 6, 11}
    assert error_m(truth, graph.optimized()) < 1e-6


def test_the_graph_does_not_grow_with_the_keyframes_that_have_gone() -> None:
    """A camera that goes to and fro on one metre: 30 keyframes are kept of 300, each linked to the five nearest."""
    rng, graph, sizes = np.random.default_rng(0), PoseGraph(), []
    for number in range(300):
        pose = rigid(shift=rng.uniform(0, 1, 3))
        near = sorted(graph.poses, key=lambda k: apart(graph.poses[k], pose)[0])[:5]
        graph.add(number, pose, [Edge(k, number, invert_pose(graph.poses[k]) @ pose, COVARIANCE) for k in near])
        if len(graph.poses) > 30:
            gone = int(rng.choice([k for k in graph.poses if k]))
            graph.remove(gone, heir=next(k for k in near if k != gone))
        sizes.append(len(graph.edges))
    assert max(sizes) <= 30 * 10 / 2 + 15  # as many, and those that came with the last keyframe
    reached, left = {0}, set(graph.poses) - {0}
    while more := {k for k in left if graph.linked(k) & reached}:
        reached, left = reached | more, left - more
    assert not left
    assert max(apart(graph.poses[k], pose)[0] for k, pose in graph.optimized().items()) < 1e-5
