from __future__ import annotations

import numpy as np

from semantic_mapper.drivers.poses.pose_graph import Edge, PoseGraph, between
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import Float64

from .images import rigid

COVARIANCE = np.diag([0.01**2] * 3 + [0.02**2] * 3)


def there_and_back(count: int) -> list[Float64]:
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
    return max(between(truth[number], pose)[0] for number, pose in poses.items())


def test_a_loop_takes_the_drift_back_and_the_first_keyframe_stays() -> None:
    truth = there_and_back(12)
    graph, poses = drifting(truth)
    before = dict(enumerate(poses))
    assert error_m(truth, before) > 0.05
    graph.edges.append(loop(truth, 0, 11))
    after = graph.optimized()
    assert error_m(truth, after) < 0.6 * error_m(truth, before)
    assert np.allclose(after[0], truth[0], atol=1e-6)
    assert between(graph.poses[11], poses[11]) == (0, 0)  # the graph itself is as it was


def test_one_wrong_loop_among_right_ones_counts_little() -> None:
    truth = there_and_back(12)
    graph, _ = drifting(truth)
    graph.edges += [loop(truth, 0, b) for b in (9, 10, 11)]
    right = error_m(truth, graph.optimized())
    graph.edges.append(Edge(1, 8, invert_pose(truth[1]) @ truth[8] @ rigid(shift=(0.8, 0, 0)), COVARIANCE))
    assert error_m(truth, graph.optimized()) < right + 0.12


def test_edges_of_a_keyframe_that_goes_are_kept_by_its_heir() -> None:
    truth = there_and_back(12)
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
        near = sorted(graph.poses, key=lambda k: between(graph.poses[k], pose)[0])[:5]
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
    assert max(between(graph.poses[k], pose)[0] for k, pose in graph.optimized().items()) < 1e-5
