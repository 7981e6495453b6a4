"""Loop closure: keyframes that show the same place are aligned to each other, and a pose graph follows.

Candidates are the keyframes that a new one should overlap with as the graph stands, and those that look like it
(``PlaceIndex``, PnP). Each is aligned both ways; the result must fit the surfaces, agree in both directions, and lie
within the drift that the way between them allows. One that would move the map visibly waits until another keyframe says
the same. One candidate is looked at for each image, so no image waits long, and results do not depend on time.

The graph is optimised with GTSAM (Levenberg-Marquardt, Huber).
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from semantic_mapper.bundle.adjustment import minimize
from semantic_mapper.drivers.poses.keyframe_map import (
    DRIFT,
    MAX_KEYFRAMES,
    MIN_MATCHES,
    OdometryKeyframe,
    apart,
    lies_on,
)
from semantic_mapper.geometry import interpolate_pose, invert_pose
from semantic_mapper.localization.depth_alignment import FALSE, POINTS_A_VOTE, Fit, Target, align, fit
from semantic_mapper.localization.features import pose_from_features
from semantic_mapper.localization.places import PlaceIndex
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float64

PLACE_FEATURES = 300
_NEAR = 4  # keyframes that a new one is aligned to because they should overlap
_LOOK_ALIKE = 2  # of each slice of places, at most
_SLICE = 10  # places compared at a time (2 ms each)
_JOBS = 60  # that wait, at most; the oldest is dropped
_BOTH_WAYS_M, _BOTH_WAYS_DEG = 0.03, 1.5  # how far the two directions may differ
_SMALL_M, _SMALL_DEG = 0.08, 3.0  # a loop that moves a keyframe by less needs no other that agrees with it
_AGREE_M, _AGREE_DEG = 0.15, 4.0  # between two loops that do not
_PATIENCE = 15  # keyframes for which a loop waits for another
_DRIFT_DEG_M = 1.5  # as ``DRIFT``, of rotation: degrees a metre
_SLACK_M, _SLACK_DEG = 0.1, 5.0
_BENT_M, _BENT_DEG = 0.06, 4.0  # loops that bend the chain of keyframes by more are wrong, unless it is known badly
_FIRM_M = 0.02  # one sigma of the chain's edges that are known well
_FLOOR_M, _FLOOR_RAD = 0.004, 0.0025  # no motion is known better
_OPEN_M, _OPEN_RAD = 0.1, 0.05  # along what no point shows
_HUBER_SIGMAS = 1.5  # motions further off than this count less
_HELD_SIGMA = 1e-4  # radians and metres, of the first keyframe, which stays
_ITERATIONS = 20
_MOST_EDGES = 10  # of a keyframe, once keyframes go and leave their edges to others

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Align keyframe ``b`` to ``a`` from a guess, or by their features where the guess is missing."""

    a: int
    b: int
    T_a_b: Float64 | None = None


class LoopCloser:
    """The graph of keyframes, and the search for loops. Not for several threads at once.

    Args:
        counters: Where "loops_closed" and "loops_refused" are counted.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._graph = PoseGraph()
        self._keyframes: dict[int, OdometryKeyframe] = {}
        self._places = PlaceIndex(MAX_KEYFRAMES)
        self._jobs: deque[_Job] = deque(maxlen=_JOBS)
        self._looking: tuple[int, list[int]] = -1, []  # a keyframe, and the places that it is still to be compared with
        self._waiting: list[Edge] = []  # loops that need another that agrees with them
        self._new: list[Edge] = []  # loops since the graph was optimised

    @property
    def busy(self) -> bool:
        """Whether ``work`` has something to do."""
        return bool(self._jobs or self._looking[1] or self._new)

    def add(self, keyframe: OdometryKeyframe, parent: int | None, before: tuple[int, Float64] | None = None) -> None:
        """A new keyframe.

        Args:
            keyframe: The one.
            parent: The one that it was tracked against; None: it is the first.
            before: Where tracking has jumped: the keyframe that it went by before, and T_before_keyframe (4, 4) as it
                should be then.
        """
        number, pose = keyframe.number, keyframe.target.T_world_camera
        self._keyframes[number] = keyframe
        edges: list[Edge] = []
        if parent is not None:
            guess = invert_pose(self._graph.poses[parent]) @ pose
            edge = self._measure(parent, number, guess)
            if edge is None:  # the two alone cannot be aligned: what tracking says
                edge = Edge(parent, number, guess, np.diag([_OPEN_RAD**2] * 3 + [_OPEN_M**2] * 3))
            edges.append(replace(edge, chain=bool(np.linalg.eigvalsh(edge.covariance[3:, 3:])[-1] < _FIRM_M**2)))
        self._graph.add(number, pose, edges)
        near = [] if parent is None else self._near(number)
        for other in near:
            if other != parent:
                self._jobs.append(_Job(other, number, invert_pose(self._graph.poses[other]) @ pose))
        if before is not None:
            self._jobs.appendleft(_Job(before[0], number, before[1]))
        if not self._looking[1]:  # else this keyframe is not looked for: the search has to keep up
            known = {number, *near} | self._graph.linked(number)
            self._looking = number, [key for key in self._places.keys if key not in known]
        self._places.add(number, keyframe.place)

    def remove(self, number: int, heir: int) -> None:
        """A keyframe is no longer kept; another one near it takes its edges."""
        self._graph.remove(number, heir)
        del self._keyframes[number]
        self._places.remove(number)
        seeker, places = self._looking
        self._looking = seeker, [] if seeker == number else [key for key in places if key != number]
        self._jobs = deque((j for j in self._jobs if number not in (j.a, j.b)), maxlen=_JOBS)
        self._waiting = [e for e in self._waiting if number not in (e.a, e.b)]
        self._new = [e for e in self._new if e in self._graph.edges]

    def work(self, optimize: bool) -> Mapping[int, Float64] | None:
        """Optimise, if allowed and there is something new, else look at one candidate.

        Returns:
            New poses of the keyframes by number; None where they stay.
        """
        if self._new and optimize:
            return self._close()
        if self._jobs:
            self._verify(self._jobs.popleft())
        elif self._looking[1]:
            number, places = self._looking
            self._looking = number, places[_SLICE:]
            others = frozenset(self._places.keys) - frozenset(places[:_SLICE])
            for key, matches in self._places.candidates(self._keyframes[number].place, _LOOK_ALIKE, exclude=others):
                if matches >= MIN_MATCHES:
                    self._jobs.append(_Job(key, number))
        return None

    def _near(self, number: int) -> list[int]:
        """Keyframes that should overlap with one, those from all of its past alike."""
        own = self._keyframes[number].target
        found = [
            other
            for other, keyframe in self._keyframes.items()
            if other != number
            and apart(keyframe.target.T_world_camera, own.T_world_camera)[1] <= 60
            and fit(own.levels, keyframe.target, own.T_world_camera).overlap > 0.4
        ]
        steps = np.linspace(0, len(found) - 1, min(_NEAR, len(found)))
        return [found[round(s)] for s in steps]

    def _verify(self, job: _Job) -> None:
        guess = job.T_a_b
        if guess is None:
            a, b = self._keyframes[job.a], self._keyframes[job.b]
            found = pose_from_features(b.place, a.place, b.target.levels[0].intrinsics, MIN_MATCHES)
            if found is None:
                return
            guess = found[0]
        edge = self._measure(job.a, job.b, guess)
        if edge is not None:
            self._judge(edge)
        elif job.T_a_b is None:
            self._counters["loops_refused"] += 1

    def _measure(self, a: int, b: int, guess: Float64) -> Edge | None:
        """Align b to a and a to b; None where the result does not fit, or both directions differ."""
        one, other = self._keyframes[a].target.levels, self._keyframes[b].target.levels
        there = align(other, [Target(one, np.eye(4))], guess)
        if there is None:
            return None
        back = align(one, [Target(other, np.eye(4))], invert_pose(there))
        if back is None:
            return None
        moved_m, turned_deg = apart(invert_pose(back), there)
        T_a_b = interpolate_pose(there, invert_pose(back), 0.5)
        found = fit(other, Target(one, np.eye(4)), T_a_b)
        if not lies_on(found) or moved_m > _BOTH_WAYS_M or turned_deg > _BOTH_WAYS_DEG:
            return None
        return Edge(a, b, T_a_b, _covariance(found))

    def _judge(self, edge: Edge) -> None:
        """Take a loop in, let it wait for another, or refuse it."""
        poses = self._graph.poses
        moved_m, turned_deg = apart(poses[edge.b], poses[edge.a] @ edge.T_a_b)
        way_m, sigma_m = self._graph.way(edge.a, edge.b)
        allowed_m = _SLACK_M + 3 * float(np.hypot(DRIFT * way_m, sigma_m))
        if moved_m > allowed_m or turned_deg > _SLACK_DEG + 3 * _DRIFT_DEG_M * way_m:
            self._counters["loops_refused"] += 1
            moved = {"moved_m": round(moved_m, 3), "turned_deg": round(turned_deg, 1)}
            _log.info("loop_refused", keyframes=(edge.a, edge.b), **moved)
            return
        if moved_m < _SMALL_M and turned_deg < _SMALL_DEG:
            self._take(edge)
            return
        for other in self._waiting:
            if other.b != edge.b and self._agree(other, edge):
                self._take(edge)
                self._take(other)
                self._waiting.remove(other)
                return
        expired = [e for e in self._waiting if edge.b - e.b > _PATIENCE]
        self._counters["loops_refused"] += len(expired)
        self._waiting = [e for e in self._waiting if edge.b - e.b <= _PATIENCE] + [edge]

    def _agree(self, one: Edge, other: Edge) -> bool:
        """Whether two loops move the same place to the same place."""
        poses = self._graph.poses
        motions = [poses[e.a] @ e.T_a_b @ invert_pose(poses[e.b]) for e in (one, other)]
        moved_m, turned_deg = apart(motions[0] @ poses[other.b], motions[1] @ poses[other.b])
        return moved_m < _AGREE_M and turned_deg < _AGREE_DEG

    def _take(self, edge: Edge) -> None:
        self._graph.edges.append(edge)
        self._new.append(edge)

    def _close(self) -> Mapping[int, Float64] | None:
        new, self._new = self._new, []
        poses = self._graph.optimized()
        for e in self._graph.edges:
            moved_m, turned_deg = apart(poses[e.a] @ e.T_a_b, poses[e.b])
            if e.chain and (moved_m > _BENT_M or turned_deg > _BENT_DEG):
                self._graph.edges = [e for e in self._graph.edges if e not in new]
                self._counters["loops_refused"] += len(new)
                _log.warning("loops_refused", count=len(new), reason="they bend what tracking found")
                return None
        moved_m = max(apart(self._graph.poses[n], pose)[0] for n, pose in poses.items())
        self._graph.poses = poses
        self._counters["loops_closed"] += len(new)
        _log.info("loops_closed", count=len(new), keyframes=len(poses), moved_m=round(moved_m, 3))
        self._keyframes = {n: k.moved(poses[n]) for n, k in self._keyframes.items()}
        return poses


def _covariance(found: Fit) -> Float64:
    """(6, 6) of a measured motion, from what the points say about each direction."""
    values, axes = np.linalg.eigh(found.normal_matrix)
    values = np.maximum(values - FALSE * values[-1], 0.0) / max(found.noise_m, 1e-3) ** 2 / POINTS_A_VOTE
    information = (axes * values) @ axes.T + np.diag([_OPEN_RAD**-2] * 3 + [_OPEN_M**-2] * 3)
    return np.linalg.inv(information) + np.diag([_FLOOR_RAD**2] * 3 + [_FLOOR_M**2] * 3)


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
        """Take a keyframe out; its edges become those of another one, as both stand now."""
        T_heir_gone = invert_pose(self.poses[heir]) @ self.poses.pop(number)
        best: dict[tuple[int, int], Edge] = {}  # one edge for each two keyframes
        for edge in self.edges:
            if number in (edge.a, edge.b):
                if heir in (edge.a, edge.b):
                    continue
                if edge.a == number:
                    edge = replace(edge, a=heir, T_a_b=T_heir_gone @ edge.T_a_b)
                else:
                    edge = replace(edge, b=heir, T_a_b=edge.T_a_b @ invert_pose(T_heir_gone))
            pair = min(edge.a, edge.b), max(edge.a, edge.b)
            if pair not in best or _strength(edge) > _strength(best[pair]):
                best[pair] = edge
        self.edges = list(best.values())
        self._prune()

    def _prune(self) -> None:
        """Take the weakest edges from keyframes with too many, so that the graph's size has a bound.

        Only edges whose ends have a neighbour in common go: the graph stays in one piece.
        """
        links: dict[int, dict[int, Edge]] = {number: {} for number in self.poses}
        for edge in self.edges:
            links[edge.a][edge.b] = links[edge.b][edge.a] = edge
        dropped: set[int] = set()
        for number, own in links.items():
            spare = sorted(own.values(), key=_strength)
            for edge in spare[: max(0, len(own) - _MOST_EDGES)]:
                other = edge.b if edge.a == number else edge.a
                if own.keys() & links[other].keys():
                    del own[other], links[other][number]
                    dropped.add(id(edge))
        self.edges = [edge for edge in self.edges if id(edge) not in dropped]

    def linked(self, number: int) -> frozenset[int]:
        """Keyframes that have an edge to this one, and itself."""
        ends = {e.b if e.a == number else e.a for e in self.edges if number in (e.a, e.b)}
        return frozenset(ends | {number})

    def way(self, a: int, b: int) -> tuple[float, float]:
        """Metres along the shortest chain of edges (Dijkstra), and one sigma of all of these together."""
        links: dict[int, list[tuple[int, float, float]]] = {}
        for e in self.edges:
            length, variance = float(np.linalg.norm(e.T_a_b[:3, 3])), float(np.trace(e.covariance[3:, 3:]))
            links.setdefault(e.a, []).append((e.b, length, variance))
            links.setdefault(e.b, []).append((e.a, length, variance))
        best, heap = {a: 0.0}, [(0.0, 0.0, a)]
        while heap:
            way, variance, here = heapq.heappop(heap)
            if here == b:
                return way, float(np.sqrt(variance))
            if way > best[here]:
                continue
            for there, length, more in links.get(here, []):
                if way + length < best.get(there, np.inf):
                    best[there] = way + length
                    heapq.heappush(heap, (way + length, variance + more, there))
        return 0.0, 0.0

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
