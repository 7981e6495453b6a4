"""Loop closure: keyframes that show the same place are aligned to each other, and a pose graph follows.

Candidates are the keyframes that a new one should overlap with as the graph stands, and those that look like it
(``PlaceIndex``, PnP). Each is aligned both ways; the result must fit the surfaces, agree in both directions, and lie
within the drift that the way between them allows. One that would move the map visibly waits until another keyframe says
the same. One candidate is looked at for each image, so no image waits long, and results do not depend on time.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.drivers.poses.alignment import FALSE, Fit, Target, align, fit
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.keyframe_map import OdometryKeyframe
from semantic_mapper.drivers.poses.pose_graph import Edge, PoseGraph, between
from semantic_mapper.geometry import interpolate_pose, invert_pose
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
_DRIFT_DEG_M = 1.5  # as ``drift``, of rotation: degrees a metre
_SLACK_M, _SLACK_DEG = 0.1, 5.0
_BENT_M, _BENT_DEG = 0.06, 4.0  # loops that bend the chain of keyframes by more are wrong, unless it is known badly
_FIRM_M = 0.02  # one sigma of the chain's edges that are known well
_POINTS_A_VOTE = 50  # neighbouring points have the same error: that many tell as much as one
_FLOOR_M, _FLOOR_RAD = 0.004, 0.0025  # no motion is known better
_OPEN_M, _OPEN_RAD = 0.1, 0.05  # along what no point tells of

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Align keyframe ``b`` to ``a`` from a guess, or by their features where there is none."""

    a: int
    b: int
    T_a_b: Float64 | None = None


class LoopCloser:
    """The graph of keyframes, and the search for loops. Not for several threads at once.

    Args:
        config: Of the odometry.

    Attributes:
        counters: "loops_closed" and "loops_refused".
    """

    def __init__(self, config: OdometryPoses) -> None:
        self._config = config
        self._graph = PoseGraph()
        self._keyframes: dict[int, OdometryKeyframe] = {}
        self._places = PlaceIndex(config.max_keyframes)
        self._jobs: deque[_Job] = deque(maxlen=_JOBS)
        self._looking: tuple[int, list[int]] = -1, []  # a keyframe, and the places that it is still to be compared with
        self._waiting: list[Edge] = []  # loops that need another that agrees with them
        self._new: list[Edge] = []  # loops since the graph was optimised
        self.counters: Counter[str] = Counter()

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
            measured = self._measure(parent, number, guess)
            measured = _tracked(parent, number, guess) if measured is None else measured
            edges.append(replace(measured, chain=_is_firm(measured)))
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
        gone = {number}
        seeker, places = self._looking
        self._looking = seeker, [] if seeker == number else [key for key in places if key != number]
        self._jobs = deque((j for j in self._jobs if not gone & {j.a, j.b}), maxlen=_JOBS)
        self._waiting = [e for e in self._waiting if not gone & {e.a, e.b}]
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
            self._look()
        return None

    def _near(self, number: int) -> list[int]:
        """Keyframes that should overlap with one, those from all of its past alike."""
        own = self._keyframes[number]
        found: list[int] = []
        for other, keyframe in self._keyframes.items():
            if other == number or between(keyframe.target.T_world_camera, own.target.T_world_camera)[1] > 60:
                continue
            if fit(self._config, own.target.levels, keyframe.target, own.target.T_world_camera).overlap > 0.4:
                found.append(other)
        steps = np.linspace(0, len(found) - 1, min(_NEAR, len(found)))
        return [found[round(s)] for s in steps]

    def _look(self) -> None:
        number, places = self._looking
        self._looking = number, places[_SLICE:]
        others = frozenset(self._places.keys) - frozenset(places[:_SLICE])
        for key, matches in self._places.candidates(self._keyframes[number].place, _LOOK_ALIKE, exclude=others):
            if matches >= self._config.min_matches:
                self._jobs.append(_Job(key, number))

    def _verify(self, job: _Job) -> None:
        a, b = self._keyframes[job.a], self._keyframes[job.b]
        guess = job.T_a_b
        if guess is None:
            found = pose_from_features(b.place, a.place, b.target.levels[0].intrinsics, self._config.min_matches)
            if found is None:
                return
            guess = found[0]
        edge = self._measure(job.a, job.b, guess)
        if edge is None:
            if job.T_a_b is None:
                self.counters["loops_refused"] += 1
            return
        self._judge(edge)

    def _measure(self, a: int, b: int, guess: Float64) -> Edge | None:
        """Align b to a and a to b; None where the result does not fit, or both directions differ."""
        one, other = self._keyframes[a].target.levels, self._keyframes[b].target.levels
        there = align(self._config, other, [Target(one, np.eye(4))], guess)
        if there is None:
            return None
        back = align(self._config, one, [Target(other, np.eye(4))], invert_pose(there))
        if back is None:
            return None
        moved_m, turned_deg = between(invert_pose(back), there)
        T_a_b = interpolate_pose(there, invert_pose(back), 0.5)
        found = fit(self._config, other, Target(one, np.eye(4)), T_a_b)
        c = self._config
        fits = found.overlap >= c.min_overlap and found.fitness >= c.min_fitness and found.rmse_m <= c.max_rmse_m
        if not fits or moved_m > _BOTH_WAYS_M or turned_deg > _BOTH_WAYS_DEG:
            return None
        return Edge(a, b, T_a_b, _covariance(found))

    def _judge(self, edge: Edge) -> None:
        """Take a loop in, let it wait for another, or refuse it."""
        poses = self._graph.poses
        moved_m, turned_deg = between(poses[edge.b], poses[edge.a] @ edge.T_a_b)
        way_m, sigma_m = self._way(edge.a, edge.b)
        allowed_m = _SLACK_M + 3 * float(np.hypot(self._config.drift * way_m, sigma_m))
        if moved_m > allowed_m or turned_deg > _SLACK_DEG + 3 * _DRIFT_DEG_M * way_m:
            self._refuse(edge, moved_m, turned_deg)
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
        self.counters["loops_refused"] += len(expired)
        self._waiting = [e for e in self._waiting if edge.b - e.b <= _PATIENCE] + [edge]

    def _agree(self, one: Edge, other: Edge) -> bool:
        """Whether two loops move the same place to the same place."""
        poses = self._graph.poses
        motions = [poses[e.a] @ e.T_a_b @ invert_pose(poses[e.b]) for e in (one, other)]
        moved_m, turned_deg = between(motions[0] @ poses[other.b], motions[1] @ poses[other.b])
        return moved_m < _AGREE_M and turned_deg < _AGREE_DEG

    def _take(self, edge: Edge) -> None:
        self._graph.edges.append(edge)
        self._new.append(edge)

    def _refuse(self, edge: Edge, moved_m: float, turned_deg: float) -> None:
        self.counters["loops_refused"] += 1
        _log.info(
            "loop_refused", keyframes=(edge.a, edge.b), moved_m=round(moved_m, 3), turned_deg=round(turned_deg, 1)
        )

    def _way(self, a: int, b: int) -> tuple[float, float]:
        """Metres along the shortest chain of edges, and one sigma of all of these together."""
        links: dict[int, list[tuple[int, float, float]]] = {}
        for e in self._graph.edges:
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

    def _close(self) -> Mapping[int, Float64] | None:
        new, self._new = self._new, []
        poses = self._graph.optimized()
        bent = [e for e in self._graph.edges if _is_bent(e, poses)]
        if bent:
            self._graph.edges = [e for e in self._graph.edges if e not in new]
            self.counters["loops_refused"] += len(new)
            _log.warning("loops_refused", count=len(new), reason="they bend what tracking found")
            return None
        moved_m = max(between(self._graph.poses[n], pose)[0] for n, pose in poses.items())
        self._graph.poses = poses
        self.counters["loops_closed"] += len(new)
        _log.info("loops_closed", count=len(new), keyframes=len(poses), moved_m=round(moved_m, 3))
        self._keyframes = {n: k.moved(poses[n]) for n, k in self._keyframes.items()}
        return poses


def _is_bent(edge: Edge, poses: Mapping[int, Float64]) -> bool:
    moved_m, turned_deg = between(poses[edge.a] @ edge.T_a_b, poses[edge.b])
    return edge.chain and (moved_m > _BENT_M or turned_deg > _BENT_DEG)


def _is_firm(edge: Edge) -> bool:
    return bool(np.linalg.eigvalsh(edge.covariance[3:, 3:])[-1] < _FIRM_M**2)


def _tracked(a: int, b: int, T_a_b: Float64) -> Edge:
    """What tracking says, where the two alone cannot be aligned."""
    return Edge(a, b, T_a_b, np.diag([_OPEN_RAD**2] * 3 + [_OPEN_M**2] * 3))


def _covariance(found: Fit) -> Float64:
    """(6, 6) of a measured motion, from what the points say about each direction."""
    values, axes = np.linalg.eigh(found.normal_matrix)
    values = np.maximum(values - FALSE * values[-1], 0.0) / max(found.noise_m, 1e-3) ** 2 / _POINTS_A_VOTE
    told = (axes * values) @ axes.T + np.diag([_OPEN_RAD**-2] * 3 + [_OPEN_M**-2] * 3)
    return np.linalg.inv(told) + np.diag([_FLOOR_RAD**2] * 3 + [_FLOOR_M**2] * 3)
