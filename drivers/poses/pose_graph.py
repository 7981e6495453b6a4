"""A graph of keyframe poses and measured motions between them, optimised with GTSAM (Levenberg-Marquardt, Huber)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from semantic_mapper.bundle.adjustment import minimize
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.types import Float64

_HUBER_SIGMAS = 1.5  # motions further off than this count less
_HELD_SIGMA = 1e-4  # radians and metres, of the first keyframe, which stays
_ITERATIONS = 20
_MOST_EDGES = 10  # of a keyframe, once keyframes go and leave their edges to others


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured motion from one keyframe to another.

    Args:
        a, b: Keyframes by number.
        T_a_b: (4, 4).
        covariance: (6, 6) of rotation and position, in the axes of b.
        chain: Between keyframes that tracking has linked, and measured well: no loop may bend it.
    """

    a: int
    b: int
    T_a_b: Float64
    covariance: Float64
    chain: bool = False


class PoseGraph:
    """Keyframes by number and edges between them. The first keyframe stays where it is. Deterministic."""

    def __init__(self) -> None:
        self.poses: dict[int, Float64] = {}
        self.edges: list[Edge] = []

    def add(self, number: int, T_world_camera: Float64, edges: list[Edge]) -> None:
        """A keyframe and its edges to earlier ones; without any it would float, so the first alone may have none."""
        self.poses[number] = T_world_camera
        self.edges += edges

    def remove(self, number: int, heir: int) -> None:
        """Take a keyframe out; its edges go on from another one, as both stand now."""
        T_heir_gone = invert_pose(self.poses[heir]) @ self.poses.pop(number)
        kept: list[Edge] = []
        for edge in self.edges:
            if number not in (edge.a, edge.b):
                kept.append(edge)
            elif edge.a == number and edge.b != heir:
                kept.append(replace(edge, a=heir, T_a_b=T_heir_gone @ edge.T_a_b))
            elif edge.b == number and edge.a != heir:
                kept.append(replace(edge, b=heir, T_a_b=edge.T_a_b @ invert_pose(T_heir_gone)))
        self.edges = _strongest_of_pairs(kept)
        self._prune()

    def _prune(self) -> None:
        """Take the weakest edges from keyframes with too many, so that the graph's size has a bound.

        Only edges whose ends have a neighbour in common go: the graph stays in one piece.
        """
        links: dict[int, dict[int, Edge]] = {number: {} for number in self.poses}
        for edge in self.edges:
            links[edge.a][edge.b] = links[edge.b][edge.a] = edge
        gone: list[Edge] = []
        for number, own in links.items():
            spare = sorted(own.values(), key=_strength)
            for edge in spare[: max(0, len(own) - _MOST_EDGES)]:
                other = edge.b if edge.a == number else edge.a
                if own.keys() & links[other].keys():
                    del own[other], links[other][number]
                    gone.append(edge)
        if gone:
            dropped = {id(edge) for edge in gone}
            self.edges = [edge for edge in self.edges if id(edge) not in dropped]

    def linked(self, number: int) -> frozenset[int]:
        """Keyframes that have an edge to this one, and itself."""
        ends = {e.b if e.a == number else e.a for e in self.edges if number in (e.a, e.b)}
        return frozenset(ends | {number})

    def optimized(self) -> dict[int, Float64]:
        """Poses that fit all edges best, by number. The graph stays as it is."""
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel
        for number, pose in self.poses.items():
            start.insert(X(number), gtsam.Pose3(pose))
        first = min(self.poses)
        held = noise.Isotropic.Sigma(6, _HELD_SIGMA)
        graph.add(gtsam.PriorFactorPose3(X(first), gtsam.Pose3(self.poses[first]), held))
        huber = noise.mEstimator.Huber.Create(_HUBER_SIGMAS)
        for edge in self.edges:
            robust = noise.Robust.Create(huber, noise.Gaussian.Covariance(edge.covariance))
            graph.add(gtsam.BetweenFactorPose3(X(edge.a), X(edge.b), gtsam.Pose3(edge.T_a_b), robust))
        found = minimize(graph, start, _ITERATIONS)
        return {number: found.atPose3(X(number)).matrix() for number in self.poses}


def _strength(edge: Edge) -> tuple[bool, float]:
    return edge.chain, -float(np.trace(edge.covariance[3:, 3:]))


def _strongest_of_pairs(edges: list[Edge]) -> list[Edge]:
    """One edge for each two keyframes."""
    best: dict[tuple[int, int], Edge] = {}
    for edge in edges:
        pair = min(edge.a, edge.b), max(edge.a, edge.b)
        if pair not in best or _strength(edge) > _strength(best[pair]):
            best[pair] = edge
    return list(best.values())


def between(T_a: Float64, T_b: Float64) -> tuple[float, float]:
    """Metres and degrees from one pose to another."""
    T = invert_pose(T_a) @ T_b
    return float(np.linalg.norm(T[:3, 3])), float(np.rad2deg(np.linalg.norm(rotation_vector(T))))
