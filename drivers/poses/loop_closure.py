"""The keyframes that odometry aligns to, the loops that are closed between them, and the poses given along them.

Loop candidates are the keyframes that a new one should overlap with as the graph stands, and those that look like it
(place features, PnP). Each is aligned both ways; the result must fit the surfaces, agree in both directions, and lie
within the drift that the way between them allows. One that would move the map visibly waits until another keyframe says
the same. One candidate is looked at for each image, so no image waits long, and results do not depend on time.

The graph is optimised with GTSAM (Levenberg-Marquardt, Huber).
"""

import heapq
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.cluster.hierarchy import DisjointSet

from semantic_mapper.bundle.keyframes import minimize
from semantic_mapper.drivers.base import CorrectedWorld
from semantic_mapper.drivers.poses.motion import apart
from semantic_mapper.geometry import interpolate_pose, invert_pose
from semantic_mapper.localization.depth_alignment import FALSE, POINTS_A_VOTE, Fit, Target, align, fit
from semantic_mapper.localization.features import Features, pose_from_features
from semantic_mapper.localization.places import most_crowded, rank_places, view_distances
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float64

MAX_KEYFRAMES = 500  # 0.5 MB each; the younger of the two that are nearest to each other goes
MIN_MATCHES = 15  # corners that agree, for a guess
MIN_FITNESS = 0.5  # of the frame's points that the keyframe sees must lie on its surface
MIN_OVERLAP = 0.35  # of the frame's points that have to be in a keyframe's view
MAX_RMSE_M = 0.025  # of the distances that count
DRIFT = 0.05  # of the way: what ``sigma`` grows by with the chain of keyframes
PLACE_FEATURES = 300
_REACH_M, _REACH_RAD = 0.6, 0.6  # further away, or turned further, keyframes share too little with a view
_NEAR = 4  # keyframes that a new one is aligned to because they should overlap
_LOOK_ALIKE = 2  # of each slice of places, at most
_SLICE = 10  # places compared at a time (2 ms each)
_JOBS = 60  # that wait, at most; the oldest is dropped
_BOTH_WAYS = 0.03, 1.5  # metres and degrees by which the two directions may differ
_SMALL = 0.08, 3.0  # a loop that moves a keyframe by less needs no other that agrees with it
_AGREE = 0.15, 4.0  # between two loops that do not
_PATIENCE = 15  # keyframes for which a loop waits for another
_DRIFT_DEG_M = 1.5  # as ``DRIFT``, of rotation: degrees a metre
_SLACK_M, _SLACK_DEG = 0.1, 5.0
_BENT = 0.06, 4.0  # loops that bend the chain of keyframes by more are wrong, unless it is known badly
_FIRM_M = 0.02  # one sigma of the chain's edges that are known well
_FLOOR_M, _FLOOR_RAD = 0.004, 0.0025  # no motion is known better
_OPEN_M, _OPEN_RAD = 0.1, 0.05  # along what no point shows
_HUBER_SIGMAS = 1.5  # motions further off than this count less
_HELD_SIGMA = 1e-4  # radians and metres, of the first keyframe, which stays
_ITERATIONS = 20
_MOST_EDGES = 5  # a keyframe, once keyframes go and leave their edges to others
_GIVEN = 20_000  # poses that are corrected; 2 x 128 bytes each
_VISIBLE_M = 0.02  # no correction for less; what is left is given at the end
_LEFT_M = 0.002

_log = get_logger(__name__)


def within(T_a: Float64, T_b: Float64, limits: tuple[float, float]) -> bool:
    """Whether two poses are apart by less than so many metres and degrees."""
    moved_m, turned_deg = apart(T_a, T_b)
    return moved_m < limits[0] and turned_deg < limits[1]


def lies_on(found: Fit) -> bool:
    """Whether a view lies on the surface of a keyframe."""
    return found.overlap >= MIN_OVERLAP and found.fitness >= MIN_FITNESS and found.rmse_m <= MAX_RMSE_M


@dataclass(frozen=True, slots=True, eq=False)
class OdometryKeyframe:
    """A view that others are aligned to."""

    number: int  # counts keyframes
    target: Target  # what views are aligned to, with its pose
    features: Features  # for finding back
    place: Features  # for loop closure
    way_m: float  # length of the shortest chain of keyframes back to the first one: errors add up along it
    unsure_m: float = 0.0  # how far it may be off along what no point showed


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured motion from one keyframe to another."""

    a: int  # keyframe by number
    b: int
    T_a_b: Float64  # (4, 4)
    covariance: Float64  # (6, 6) of rotation and position, in the axes of b
    chain: bool = False  # between keyframes that tracking has linked, and measured well: no loop may bend it


@dataclass(slots=True, eq=False)
class _Given:
    """A pose that was given: relative to its keyframe, and as of the last correction."""

    stamp_ns: int
    keyframe: int
    T_keyframe_camera: Float64
    T_world_camera: Float64


class KeyframeGraph:
    """Keyframes by number, in the order they were made, measured motions between them, and the last poses that a camera
    was given: where keyframes move, they move along. Deterministic."""

    def __init__(self) -> None:
        self.frames: dict[int, OdometryKeyframe] = {}
        self.edges: list[Edge] = []
        self._given: deque[_Given] = deque(maxlen=_GIVEN)  # oldest first

    @property
    def poses(self) -> dict[int, Float64]:
        """T_world_camera (4, 4) by number."""
        return {number: k.target.T_world_camera for number, k in self.frames.items()}

    def move(self, poses: Mapping[int, Float64]) -> None:
        """Put keyframes at other poses, by number."""
        for number, pose in poses.items():
            keyframe = self.frames[number]
            self.frames[number] = replace(keyframe, target=replace(keyframe.target, T_world_camera=pose))

    def distances(self, T_world_camera: Float64) -> tuple[Float64, Float64]:
        """Metres (N,) and radians (N,) from a pose to each keyframe's."""
        return view_distances(np.array([*self.poses.values()]), T_world_camera)

    def near(self, T_world_camera: Float64, count: int) -> list[OdometryKeyframe]:
        """Up to ``count`` keyframes to align a view to: the nearest one first, then the oldest ones within reach.

        Old ones have the least drift, and hold later ones to them where the camera comes back. Where none is within
        reach, the nearest one alone.
        """
        way, turn = self.distances(T_world_camera)
        spacing = np.hypot(way / _REACH_M, turn / _REACH_RAD)
        nearest = int(spacing.argmin())
        others = [i for i in np.flatnonzero(spacing < 1) if i != nearest]
        frames = [*self.frames.values()]
        return [frames[i] for i in (nearest, *others[: count - 1])]

    def linked(self, number: int) -> set[int]:
        """Keyframes that have an edge to this one."""
        return {k for e in self.edges if number in (e.a, e.b) for k in (e.a, e.b)}

    def way(self, a: int, b: int) -> tuple[float, float]:
        """Metres along the shortest chain of edges (Dijkstra), and one sigma of all of these together."""
        links: dict[int, list[tuple[int, float, float]]] = {}
        for e in self.edges:
            length, variance = float(np.linalg.norm(e.T_a_b[:3, 3])), float(np.trace(e.covariance[3:, 3:]))
            links.setdefault(e.a, []).append((e.b, length, variance))
            links.setdefault(e.b, []).append((e.a, length, variance))
        done, heap = set[int](), [(0.0, 0.0, a)]
        while heap:
            way, variance, here = heapq.heappop(heap)
            if here == b:
                return way, float(np.sqrt(variance))
            if here not in done:
                done.add(here)
                for there, length, more in links.get(here, []):
                    heapq.heappush(heap, (way + length, variance + more, there))
        return 0.0, 0.0

    def trim(self) -> None:
        """With more than ``MAX_KEYFRAMES``, let the younger of the two go that are nearest to each other, never the
        newest, which is in use. Its edges and poses become those of the other one, as both stand now."""
        if len(self.frames) <= MAX_KEYFRAMES:
            return
        numbers, poses = [*self.frames][:-1], np.array([*self.poses.values()])[:-1]
        way, turn = view_distances(poses[:, None], poses[None])
        first, second = most_crowded(np.hypot(way / _REACH_M, turn / _REACH_RAD))
        heir, gone, T_heir_gone = numbers[first], numbers[second], invert_pose(poses[first]) @ poses[second]
        del self.frames[gone]
        edges: list[Edge] = []
        for edge in self.edges:
            if edge.a == gone:
                edge = replace(edge, a=heir, T_a_b=T_heir_gone @ edge.T_a_b)
            elif edge.b == gone:
                edge = replace(edge, b=heir, T_a_b=edge.T_a_b @ invert_pose(T_heir_gone))
            if edge.a != edge.b:
                edges.append(edge)
        self.edges = self._strongest(edges)
        for given in self._given:
            if given.keyframe == gone:
                given.keyframe, given.T_keyframe_camera = heir, T_heir_gone @ given.T_keyframe_camera

    def _strongest(self, edges: list[Edge]) -> list[Edge]:
        """The strongest edges, so that the graph's size has a bound, with those that keep it in one piece (Kruskal)."""
        joined = DisjointSet(self.frames)
        tree: list[Edge] = []
        others: list[Edge] = []
        for edge in sorted(edges, key=lambda e: (e.chain, -np.trace(e.covariance[3:, 3:])), reverse=True):
            (tree if joined.merge(edge.a, edge.b) else others).append(edge)
        return tree + others[: _MOST_EDGES * len(self.frames) - len(tree)]

    def optimized(self) -> dict[int, Float64]:
        """Poses that fit all edges best, by number; the first keyframe stays. The graph stays as it is."""
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise, poses = gtsam.noiseModel, self.poses
        for number, pose in poses.items():
            start.insert(X(number), gtsam.Pose3(pose))
        first = min(poses)
        graph.add(gtsam.PriorFactorPose3(X(first), gtsam.Pose3(poses[first]), noise.Isotropic.Sigma(6, _HELD_SIGMA)))
        huber = noise.mEstimator.Huber.Create(_HUBER_SIGMAS)
        for edge in self.edges:
            robust = noise.Robust.Create(huber, noise.Gaussian.Covariance(edge.covariance))
            graph.add(gtsam.BetweenFactorPose3(X(edge.a), X(edge.b), gtsam.Pose3(edge.T_a_b), robust))
        found = minimize(graph, start, _ITERATIONS)
        return {number: found.atPose3(X(number)).matrix() for number in poses}

    def give(self, stamp_ns: int, keyframe: OdometryKeyframe, T_world_camera: Float64) -> None:
        """A camera is given a pose near a keyframe."""
        relative = invert_pose(keyframe.target.T_world_camera) @ T_world_camera
        self._given.append(_Given(stamp_ns, keyframe.number, relative, T_world_camera))

    def correction(self, final: bool) -> CorrectedWorld | None:
        """All given poses as the keyframes stand now, if that moves one visibly; ``final``: no more will come."""
        if not self._given:
            return None
        keyframes, before = self.poses, np.array([g.T_world_camera for g in self._given])
        poses = np.array([keyframes[g.keyframe] @ g.T_keyframe_camera for g in self._given])
        moved_m = float(np.linalg.norm(poses[:, :3, 3] - before[:, :3, 3], axis=1).max())
        if moved_m < (_LEFT_M if final else _VISIBLE_M):
            return None
        for given, pose in zip(self._given, poses, strict=True):
            given.T_world_camera = pose
        until_ns, motion = self._given[-1].stamp_ns, poses[-1] @ invert_pose(before[-1])
        return CorrectedWorld({g.stamp_ns: g.T_world_camera for g in self._given}, until_ns, motion)


class LoopCloser:
    """Measures motions between keyframes of a graph, which gets them, and searches for loops; counts "loops_closed" and
    "loops_refused". Not for several threads at once."""

    def __init__(self, graph: KeyframeGraph, counters: Counter[str]) -> None:
        self._graph = graph
        self._counters = counters
        # Keyframes to align, a and b, and a guess of T_a_b; None: by their features.
        self._jobs: deque[tuple[int, int, Float64 | None]] = deque(maxlen=_JOBS)
        self._looking: tuple[int, list[int]] = -1, []  # a keyframe, and the places that it is still to be compared with
        self._waiting: list[Edge] = []  # loops that need another that agrees with them
        self._new: list[Edge] = []  # loops since the graph was optimised

    @property
    def busy(self) -> bool:
        """Whether ``work`` has something to do."""
        return bool(self._jobs or self._looking[1] or self._new)

    def add(self, keyframe: OdometryKeyframe, parent: int | None) -> None:
        """The graph has a new keyframe, tracked against ``parent``; None: it is the first."""
        if parent is None:
            return
        number, poses = keyframe.number, self._graph.poses
        guess = invert_pose(poses[parent]) @ poses[number]
        edge = self._measure(parent, number, guess)
        if edge is None:  # the two alone cannot be aligned: what tracking says
            edge = Edge(parent, number, guess, np.diag([_OPEN_RAD**2] * 3 + [_OPEN_M**2] * 3))
        firm = bool(np.linalg.eigvalsh(edge.covariance[3:, 3:])[-1] < _FIRM_M**2)
        self._graph.edges.append(replace(edge, chain=firm))
        near = self._near(keyframe)
        self._jobs.extend((k, number, invert_pose(poses[k]) @ poses[number]) for k in near if k != parent)
        if not self._looking[1]:  # else this keyframe is not looked for: the search has to keep up
            known = {number, *near, *self._graph.linked(number)}
            self._looking = number, [k for k in self._graph.frames if k not in known]

    def work(self, optimize: bool) -> Mapping[int, Float64] | None:
        """Optimise, if allowed and there is something new, else look at one candidate.

        Returns: new poses of the keyframes by number, for the graph to be moved to; None where they stay.
        """
        frames = self._graph.frames
        if self._new and optimize:
            return self._close()
        if self._jobs:
            a, b, guess = self._jobs.popleft()
            if a in frames and b in frames:
                self._verify(a, b, guess)
        elif self._looking[1]:
            number, places = self._looking
            self._looking = number, places[_SLICE:] if number in frames else []
            if number in frames:
                theirs = {k: frames[k].place.descriptors for k in places[:_SLICE] if k in frames}
                alike = rank_places(frames[number].place, theirs, _LOOK_ALIKE)
                self._jobs.extend((key, number, None) for key, matches in alike if matches >= MIN_MATCHES)
        return None

    def _near(self, new: OdometryKeyframe) -> list[int]:
        """Keyframes that should overlap with one, those from all of its past alike."""
        pose = new.target.T_world_camera
        found = [
            number
            for number, keyframe in self._graph.frames.items()
            if number != new.number
            and apart(keyframe.target.T_world_camera, pose)[1] <= 60
            and fit(new.target.levels, keyframe.target, pose).overlap > 0.4
        ]
        steps = np.linspace(0, len(found) - 1, min(_NEAR, len(found)))
        return [found[round(s)] for s in steps]

    def _verify(self, a: int, b: int, guess: Float64 | None) -> None:
        alike = guess is None
        if guess is None:
            one, other = self._graph.frames[a], self._graph.frames[b]
            found = pose_from_features(other.place, one.place, other.target.levels[0].intrinsics, MIN_MATCHES)
            if found is None:
                return
            guess = found[0]
        edge = self._measure(a, b, guess)
        if edge is not None:
            self._judge(edge)
        elif alike:
            self._counters["loops_refused"] += 1

    def _measure(self, a: int, b: int, guess: Float64) -> Edge | None:
        """Align b to a and a to b; None where the result does not fit, or both directions differ."""
        one, other = self._graph.frames[a].target.levels, self._graph.frames[b].target.levels
        there = align(other, [Target(one, np.eye(4))], guess)
        back = None if there is None else align(one, [Target(other, np.eye(4))], invert_pose(there))
        if there is None or back is None:
            return None
        T_a_b = interpolate_pose(there, invert_pose(back), 0.5)
        found = fit(other, Target(one, np.eye(4)), T_a_b)
        if not lies_on(found) or not within(invert_pose(back), there, _BOTH_WAYS):
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
            _log.info("loop_refused", keyframes=(edge.a, edge.b), moved_m=round(moved_m, 3), deg=round(turned_deg, 1))
            return
        taken = [edge]
        if moved_m >= _SMALL[0] or turned_deg >= _SMALL[1]:
            kept = [e for e in self._waiting if e.a in poses and e.b in poses and edge.b - e.b <= _PATIENCE]
            self._counters["loops_refused"] += len(self._waiting) - len(kept)
            # Two loops agree that move the same place to the same place.
            move = poses[edge.a] @ edge.T_a_b
            moves = [(e, poses[e.a] @ e.T_a_b @ invert_pose(poses[e.b]) @ poses[edge.b]) for e in kept if e.b != edge.b]
            other = next((e for e, theirs in moves if within(theirs, move, _AGREE)), None)
            taken = [] if other is None else [edge, other]
            self._waiting = [*kept, edge] if other is None else [e for e in kept if e is not other]
        self._graph.edges.extend(taken)
        self._new.extend(taken)

    def _close(self) -> Mapping[int, Float64] | None:
        before, new = self._graph.poses, [e for e in self._new if e in self._graph.edges]
        self._new = []
        poses = self._graph.optimized()
        if any(e.chain and not within(poses[e.a] @ e.T_a_b, poses[e.b], _BENT) for e in self._graph.edges):
            self._graph.edges = [e for e in self._graph.edges if e not in new]
            self._counters["loops_refused"] += len(new)
            _log.warning("loops_refused", count=len(new), reason="they bend what tracking found")
            return None
        moved_m = max(apart(before[n], pose)[0] for n, pose in poses.items())
        self._counters["loops_closed"] += len(new)
        _log.info("loops_closed", count=len(new), keyframes=len(poses), moved_m=round(moved_m, 3))
        return poses


def _covariance(found: Fit) -> Float64:
    """(6, 6) of a measured motion, from what the points say about each direction."""
    values, axes = np.linalg.eigh(found.normal_matrix)
    values = np.maximum(values - FALSE * values[-1], 0.0) / max(found.noise_m, 1e-3) ** 2 / POINTS_A_VOTE
    information = (axes * values) @ axes.T + np.diag([_OPEN_RAD**-2] * 3 + [_OPEN_M**-2] * 3)
    return np.linalg.inv(information) + np.diag([_FLOOR_RAD**2] * 3 + [_FLOOR_M**2] * 3)
