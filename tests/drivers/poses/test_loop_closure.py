from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.drivers.poses import loop_closure
from semantic_mapper.drivers.poses.loop_closure import Edge, KeyframeGraph, LoopCloser, OdometryKeyframe
from semantic_mapper.drivers.poses.motion import apart
from semantic_mapper.geometry import invert_pose
from semantic_mapper.localization.depth_alignment import Target, make_levels, thin_depth
from semantic_mapper.localization.features import Features, find_place_features
from semantic_mapper.types import Float64, PosedFrame

from .images import rigid
from .test_odometry import INTRINSICS, walk

NOWHERE = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
COVARIANCE = np.diag([0.01**2] * 3 + [0.02**2] * 3)


def bare(number: int, pose: Float64) -> OdometryKeyframe:
    return OdometryKeyframe(number, Target((), pose), NOWHERE, NOWHERE, 0.0)


def keyframe(number: int, frame: PosedFrame, pose: Float64, *, place: bool = False) -> OdometryKeyframe:
    assert frame.depth_m is not None
    levels = make_levels(thin_depth(frame.depth_m, 1, 6.0), INTRINSICS)
    features = find_place_features(frame.rgb, frame.depth_m, 300) if place else NOWHERE
    return replace(bare(number, pose), target=Target(levels, pose), place=features)


def closer_of(keyframes: list[OdometryKeyframe]) -> tuple[KeyframeGraph, LoopCloser, Counter[str]]:
    """Of keyframes that were tracked one after the other."""
    graph, counters = KeyframeGraph(), Counter[str]()
    closer = LoopCloser(graph, counters)
    for k in keyframes:
        graph.frames[k.number] = k
        closer.add(k, k.number - 1 if k.number else None)
    return graph, closer, counters


def finish(graph: KeyframeGraph, closer: LoopCloser) -> dict[int, Float64]:
    while closer.busy:
        graph.move(closer.work(optimize=True) or {})
    return graph.poses


def there_and_back() -> list[PosedFrame]:
    frames = walk()
    return [frames[i] for i in (0, 6, 12, 18, 12, 6, 0)]


def test_keyframes_that_come_back_are_aligned_and_the_graph_takes_the_drift_back() -> None:
    frames = there_and_back()
    drifted = [rigid(shift=(0.008 * k, 0, 0)) @ f.T_world_camera for k, f in enumerate(frames)]
    graph, closer, counters = closer_of([keyframe(k, f, drifted[k]) for k, f in enumerate(frames)])
    for _ in range(100):
        assert closer.work(optimize=False) is None
    assert closer.busy and counters["loops_closed"] == 0
    poses = finish(graph, closer)
    assert counters["loops_closed"] >= 3 and counters["loops_refused"] == 0
    assert apart(drifted[6], frames[6].T_world_camera)[0] > 0.04
    assert max(apart(poses[k], f.T_world_camera)[0] for k, f in enumerate(frames)) < 0.01


@pytest.mark.parametrize(("count", "closes"), [(5, False), (7, True)])
def test_one_far_loop_alone_is_not_believed_and_two_that_agree_are(count: int, closes: bool) -> None:
    """Keyframes there, a bare wall that none of them can be aligned to, and back 0.4 m off."""
    frames = there_and_back()[:count]
    frames[3] = replace(frames[3], depth_m=np.full((120, 160), 0.4, np.float32))
    jump = rigid(shift=(0.0, 0.4, 0.0))
    poses = [jump @ f.T_world_camera if k > 3 else f.T_world_camera for k, f in enumerate(frames)]
    graph, closer, counters = closer_of([keyframe(k, f, poses[k], place=k != 3) for k, f in enumerate(frames)])
    found = finish(graph, closer)
    off_m = [apart(found[k], f.T_world_camera)[0] for k, f in enumerate(frames) if k != 3]
    if closes:
        assert counters["loops_closed"] >= 2 and max(off_m) < 0.02
    else:
        assert 0.35 < off_m[-1] < 0.45  # it stays where tracking saw it


def test_poses_that_were_given_move_with_their_keyframes() -> None:
    graph = KeyframeGraph()
    assert graph.correction(final=True) is None
    graph.frames = {0: bare(0, np.eye(4)), 1: bare(1, rigid(shift=(1, 0, 0)))}
    for stamp, (number, x) in enumerate(((0, 0.0), (0, 0.5), (1, 1.2))):
        graph.give(stamp, graph.frames[number], rigid(shift=(x, 0, 0)))
    assert graph.correction(final=True) is None  # nothing has moved
    graph.move({1: rigid((0, 0, np.pi / 2), (1, 0.1, 0))})
    found = graph.correction(final=False)
    assert found is not None and found.until_ns == 2
    assert found.poses[1][:3, 3] == pytest.approx((0.5, 0, 0))
    assert found.poses[2][:3, 3] == pytest.approx((1.0, 0.3, 0))
    assert (found.motion @ rigid(shift=(1.2, 0, 0)))[:3, 3] == pytest.approx((1.0, 0.3, 0))
    assert graph.correction(final=True) is None  # given already


def test_the_most_crowded_keyframe_goes_and_old_ones_are_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_closure, "MAX_KEYFRAMES", 4)
    graph = KeyframeGraph()
    for number, x in enumerate((0.0, 0.3, 0.35, 1.5, 1.8)):
        graph.frames[number] = bare(number, rigid(shift=(x, 0, 0)))
        graph.give(number, graph.frames[number], rigid(shift=(x, 0, 0)))
        graph.trim()
    assert [*graph.frames] == [0, 1, 3, 4]  # 0.35 was next to 0.3, and younger
    graph.move({1: rigid(shift=(0.3, 1, 0))})
    moved = graph.correction(final=True)
    assert moved is not None and moved.poses[2][:3, 3] == pytest.approx((0.35, 1, 0)), "its poses have an heir"
    graph.move({1: rigid(shift=(0.3, 0, 0))})
    assert [k.number for k in graph.near(rigid(shift=(0.25, 0, 0)), 3)] == [1, 0]
    assert [k.number for k in graph.near(rigid(shift=(1.7, 0, 0)), 2)] == [4, 3]
    assert [k.number for k in graph.near(rigid(shift=(9, 0, 0)), 3)] == [4]
    way, turn = graph.distances(rigid((0, 0.2, 0), (0, 1.0, 0)))
    assert way[0] == pytest.approx(1.0) and turn[0] == pytest.approx(0.2)


def test_edges_of_keyframes_that_go_are_kept_by_their_heirs_and_stay_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that goes to and fro on one metre: 30 keyframes are kept of 300, each linked to the five nearest."""
    monkeypatch.setattr(loop_closure, "MAX_KEYFRAMES", 30)
    rng, graph, sizes = np.random.default_rng(0), KeyframeGraph(), []
    for number in range(300):
        pose = rigid(shift=rng.uniform(0, 1, 3))
        poses = graph.poses
        near = sorted(poses, key=lambda k: apart(poses[k], pose)[0])[:5]
        graph.frames[number] = bare(number, pose)
        graph.edges += [Edge(k, number, invert_pose(poses[k]) @ pose, COVARIANCE) for k in near]
        graph.trim()
        sizes.append(len(graph.edges))
    assert max(sizes) <= 30 * 5 and len(graph.frames) == 30
    reached, left = {min(graph.frames)}, set(graph.frames)
    while more := {k for k in left - reached if graph.linked(k) & reached}:
        reached |= more
    assert reached == left
    poses = graph.poses
    assert max(apart(poses[k], pose)[0] for k, pose in graph.optimized().items()) < 1e-5
