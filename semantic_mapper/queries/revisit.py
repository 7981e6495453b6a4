"""Evidence for what has become of things between two states of a map, or between two maps in one world.

A thing of before has gone where what is seen now lies behind its surface; a thing of now has come where what was seen
before did. So what could not have been seen has neither gone nor come. Surfaces of before are first fitted to those of
now round each thing, since poses of two visits differ by some centimetres. What has gone and what has come are then
matched as a whole (linear assignment) by class, size, shape and colour; a pair that is
unlikely to be one thing is one that has gone and another that is new."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads `optimize` when it is first used
from numpy.typing import NDArray

from semantic_mapper.geometry import transform, turn_onto
from semantic_mapper.localization.places import Place
from semantic_mapper.mapping.blocks import find_sorted, pack_keys
from semantic_mapper.mapping.changes import TSDF_STEPS, UNOBSERVED
from semantic_mapper.queries.instances import OTHER, Instance, OrientedBox, upright_box
from semantic_mapper.queries.occupancy import State, read_states
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import cast_rays, surface_voxels
from semantic_mapper.types import Bool, Float64, Int64, UInt8

PART_FREE = 0.08  # of a thing, from which on it is looked for parts that were or are not there
PART_VOXELS, PART_SIDE_M, PART_GAP = 60, 0.06, 1.8  # of a part at least; its shortest side; gap within, voxels
LEAST_FILLED = 0.5  # of the largest side of its box, by its surface: less is scattered
MOST_PART, MOST_PARTED = 0.9, 20_000  # of a thing; voxels of one that is looked at
NEAR_M = 0.08  # of the points of two things at one place, or what their spacing is
OTHER_CLASS, LEAST_SCORE = 0.5, 0.06  # how well two things overlap: less so of two classes; at least
GONE_FREE = 0.65  # of what is known of its place: a thing of which so much is free is not there
SHIFTED_FREE = 0.2  # likewise of a thing that may have been moved by less than its size
LEAST_KNOWN = 0.25  # of its surface
BY_GRID = 0.77  # weight of free voxels where no view sees through: next to thin boards they are free, too
LEAST_VOXELS, SLIVER_M = 40, (0.03, 0.1)  # of a thing that may have left or come: what has less, or whose two
# shorter sides are shorter, is often noise
STANDS = 0.9  # of either of two surfaces that lies at the other one: they are of one thing that stood
COMPARED = 400  # surface voxels of a thing, at most
LOOKS = 12  # views of a place that are called whether they see through it
LEAST_LOOKS = 2
TOUCH_M = 0.035  # small pieces that came, or left, together and are so near to each other are one thing
BEHIND_M = 0.1  # a view sees through a point where it meets the surface so far behind it
NEAREST_M, REACH_M, PAST_M = 0.6, 5.0, 4.0  # depth of a view, at least and most; how far past a point it is followed
CELL_M, CELL_REACH_M = 2.0, 1.8  # surfaces are fitted in cells of this size, by what is so near to their middle
FIT_POINTS, LEAST_FIT, FIT_ROUNDS = 3000, 300, 8
FIT_TUKEY = 2.5  # voxels
MOST_FIT_M, MOST_FIT_RAD = 0.08, 0.03
LEAST_SHIFT_M = 0.06  # things that have been moved by less have not been moved
CHROMA, OUTLINE, OUTLINE_M, SLICES = 8, 8, (0.05, 0.04), 3  # bins of a signature; down from the top, and outwards
PARTS = np.cumsum((CHROMA**2, OUTLINE**2))
SIGNATURE = int(PARTS[-1]) + SLICES
LIGHT_STEPS = 100.0  # of a signature, of one logarithm of lightness
HUE_RANGE, DARK = 1.2, 8.0
LEAST_HIGH_M, LEAST_SIDE_M, FOOT_M = (
    0.02,
    0.04,
    0.13,
)  # by how much the heights of one thing may differ: its foot is hidden
# chroma, outline, light, bright, high, level, class
WEIGHTS, DIFFERENT = np.array((7.5, 6.5, 4.3, 3.0, 4.0, 1.0, 4.6)), 5.3
# Parts of the building, which nobody carries; what is found of them differs from visit to visit.
FIXTURES = frozenset("window door curtain blinds showercurtain counter bathtub sink toilet".split())
FACES = np.concatenate((np.zeros((1, 3)), np.eye(3), -np.eye(3)))


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Views that a map keeps (``localization.places``): P poses T_world_camera (P, 4, 4), the greatest slopes (P, 4)
    of what they saw (left, up, right, down), and their stamps (P,)."""

    poses: Float64
    slopes: Float64
    stamps_ns: Int64

    @classmethod
    def of(cls, places: Sequence[Place], after_ns: int = -(2**63)) -> Looks:
        """Of places, those later than a stamp."""
        used = [p for p in places if p.stamp_ns > after_ns and len(p.points)]
        slopes = np.zeros((len(used), 4))
        for row, place in zip(slopes, used, strict=True):
            xy = place.points[:, :2] / place.points[:, 2:]
            row[:2], row[2:] = xy.min(axis=0), xy.max(axis=0)
        poses = np.array([p.T_world_camera for p in used]).reshape(-1, 4, 4)
        return cls(poses, slopes, np.array([p.stamp_ns for p in used], np.int64))

    def through(self, snapshot: MapSnapshot, points: Float64) -> tuple[Int64, int]:
        """How many of the ``LOOKS`` views that have the most of points (N, 3), world metres, in view see through each
        (N,), and how many of them see through most of those in view."""
        free, through = np.zeros(len(points), np.int64), 0
        if not len(self.poses) or not len(points):
            return free, through
        inside, _ = self._in_view(np.arange(len(self.poses)), points[:: 1 + len(points) // 8])
        best = np.argsort(-inside.sum(axis=1), kind="stable")[:LOOKS]
        inside, c = self._in_view(best, points)
        for view in range(len(best)):
            seen = np.flatnonzero(inside[view])
            if not len(seen):
                continue
            ray = points[seen] - c[view]
            length = np.linalg.norm(ray, axis=1)
            hit = cast_rays(snapshot, c[view], ray, float(length.max()) + PAST_M).distance_m
            sees = (hit > length + BEHIND_M) & (hit < length + PAST_M)  # past that, it is not known how far it saw
            free[seen] += sees
            through += int(2 * sees.sum() > len(seen))
        return free, through

    def _in_view(self, views: Int64, points: Float64) -> tuple[Bool, Float64]:
        """Which of points (N, 3) some views (V,) have in view (V, N), and where these are (V, 3)."""
        R, c = self.poses[views, :3, :3], self.poses[views, :3, 3]
        local = np.matmul(points[None] - c[:, None], R)
        xy = local[..., :2] / np.maximum(local[..., 2:], 1e-6)
        inside = (local[..., 2] > NEAREST_M) & ((local**2).sum(axis=-1) < REACH_M**2)
        inside &= (xy >= self.slopes[views, None, :2]).all(-1) & (xy <= self.slopes[views, None, 2:]).all(-1)
        return inside, c


class MapVisit(NamedTuple):
    """A state of a map, its things, the views that it comes of, the stamp of the last frame, and packed keys (B,),
    sorted, of the blocks that have changed since the last update of the memory, with the stamps (B,) of the frames that
    changed each last (None = all blocks, by the last frame)."""

    snapshot: MapSnapshot
    things: Sequence[Instance]
    looks: Looks
    stamp_ns: int
    changed: tuple[Int64, Int64] | None = None

    def seen_ns(self, thing: Instance) -> int | None:
        """Stamp of the last frame by which enough of a thing had been seen again; None where it was not seen since."""
        if self.changed is None:
            return self.stamp_ns
        keys = np.unique(pack_keys(thing.voxels >> 3))
        row, there = find_sorted(self.changed[0], keys)
        stamps = np.sort(self.changed[1][row[there]])
        least = max(1, int(np.ceil(LEAST_KNOWN * len(keys))))
        return int(stamps[-least]) if len(stamps) >= least else None


class Evidence(NamedTuple):
    """Of N points: which are free in another map, and which have a surface there; the others are not known."""

    free: Bool
    solid: Bool
    looks: int  # views that see through most of what they have of them in view

    @property
    def free_of(self) -> float:
        """Fraction free of those known; less where it is most and no view sees through it, 0 where few are known."""
        known = int((self.free | self.solid).sum())
        if known < LEAST_KNOWN * len(self.free):
            return 0.0
        fraction = float(self.free.sum() / known)
        return fraction * BY_GRID if fraction >= GONE_FREE and not self.looks else fraction


class Candidate(NamedTuple):
    """A thing of one visit that may not be in the map of the other."""

    class_id: int
    size: Float64  # (3,) of its box
    centers: Float64  # (2, 3) mean of its surface and middle of its box, in the world of now
    free: float  # of what is known of its place in the other map
    signature: NDArray[np.int8]
    color: UInt8  # (3,)
    away: bool = False  # since an earlier visit: it may be back where it was


def match_candidates(goers: Sequence[Candidate], comers: Sequence[Candidate]) -> list[tuple[int, int, float]]:
    """Which of those that left are which of those that came, with the probability that they are: at most one each."""
    if not goers or not comers:
        return []
    looks, cost = Looked.of(comers), np.empty((len(goers), len(comers)))
    centers, free = np.array([b.centers for b in comers]), np.array([b.free for b in comers])
    for row, a in enumerate(goers):
        # Of what is seen from another side the one or the other lies elsewhere.
        shift = np.linalg.norm(centers - a.centers, axis=2).min(axis=1)
        left, part = np.minimum(a.free, free), shift / a.size.max()  # moved by a part of its size, it left as much
        near = (part <= 1) & (left >= part) & (looks.class_id == a.class_id)
        possible = ((shift >= LEAST_SHIFT_M) | a.away) & (near | (left >= GONE_FREE))
        cost[row] = np.where(possible, pair_costs(Looked.of([a]), looks), np.inf)
    against = cost - DIFFERENT  # logarithm of the odds that they are two; no pair is better than one of more than 0
    found = zip(*scipy.optimize.linear_sum_assignment(np.minimum(against, 0)), strict=True)
    return [(int(r), int(c), float(1 / (1 + np.exp(against[r, c])))) for r, c in found if against[r, c] < 0]


class Looked(NamedTuple):
    """What N candidates look like, by row."""

    chroma: Float64  # (N, CHROMA**2) of unit length
    outline: Float64  # (N, OUTLINE**2) of unit length
    light: Float64  # (N, SLICES)
    bright: Float64  # (N,) lightness
    height: Float64  # (N,) metres
    level: Float64  # (N, 2) logarithms of the shorter and the longer side
    class_id: Int64  # (N,)

    @classmethod
    def of(cls, things: Sequence[Candidate]) -> Looked:
        """What these look like."""
        *parts, light = np.split(np.array([c.signature for c in things], np.float64), PARTS, axis=1)
        chroma, outline = (h / np.maximum(np.linalg.norm(h, axis=1, keepdims=True), 1) for h in parts)
        _, bright = _tone(np.array([c.color for c in things]))
        size, class_id = np.array([c.size for c in things]), np.array([c.class_id for c in things])
        level = np.log(np.maximum(np.sort(size[:, :2]), LEAST_SIDE_M))
        return cls(chroma, outline, light / LIGHT_STEPS, bright, size[:, 2], level, class_id)


def pair_costs(a: Looked, b: Looked) -> Float64:
    """How different one thing and others (N,) look: the logarithm of the odds of being one is ``DIFFERENT`` less this
    (N,). The weights are of a conditional logistic regression (which of those that came is it, or none) over homes that
    no figure is of; those of sizes are larger, since most things there are small."""
    chroma, outline = (1 - (x * y).sum(axis=1) for x, y in ((a.chroma, b.chroma), (a.outline, b.outline)))
    light, bright = np.abs(a.light - b.light).mean(axis=1), np.abs(a.bright - b.bright)
    high = np.maximum(0.0, np.abs(a.height - b.height) - FOOT_M) / np.maximum(np.maximum(a.height, b.height), 0.1)
    level = np.abs(a.level - b.level).mean(axis=1)
    return WEIGHTS @ np.array((chroma, outline, light, bright, high, level, a.class_id != b.class_id))


def signature_of(snapshot: MapSnapshot, thing: Instance, up: Float64) -> NDArray[np.int8]:
    """(SIGNATURE,) int8: histograms of hue and saturation, and of how far its surface is below its top and from its
    upright axis, of unit length, times 127; and the median lightness of thirds of its height against that of all."""
    points, slot, voxel = read_thing(snapshot, thing)
    hue, lightness = _tone(snapshot.voxels.rgb[slot, voxel])
    at = np.clip((hue / HUE_RANGE + 0.5) * CHROMA - 0.5, 0, CHROMA - 1.001)
    low = np.floor(at).astype(np.int64)
    near = at - low
    chroma, outline = np.zeros((CHROMA, CHROMA)), np.zeros((OUTLINE, OUTLINE))
    for x, y in np.ndindex(2, 2):  # each is shared by the four bins round it
        np.add.at(chroma, (low[:, 0] + x, low[:, 1] + y), np.abs(1 - x - near[:, 0]) * np.abs(1 - y - near[:, 1]))
    height, offset = points @ up, points - thing.box.center
    top, foot, middle = float(np.percentile(height, 99)), float(height.min()), np.median(lightness)
    aside = np.linalg.norm(offset - np.outer(offset @ up, up), axis=1)
    bins = np.clip(np.stack((top - height, aside)) / np.array(OUTLINE_M)[:, None], 0, OUTLINE - 1).astype(np.int64)
    np.add.at(outline, tuple(bins), 1)
    third = np.clip((height - foot) / max(top - foot, LEAST_HIGH_M) * SLICES, 0, SLICES - 1).astype(np.int64)
    light = [np.median(lightness[third == k]) - middle if (third == k).any() else 0.0 for k in range(SLICES)]
    histograms = [np.sqrt(h.ravel() / max(1.0, h.sum())) * 127 for h in (chroma, outline)]
    return np.clip(np.concatenate((*histograms, np.array(light) * LIGHT_STEPS)), -127, 127).round().astype(np.int8)


def color_of(snapshot: MapSnapshot, thing: Instance) -> UInt8:
    """(3,) uint8 mean RGB of its surface."""
    _, slot, voxel = read_thing(snapshot, thing)
    return snapshot.voxels.rgb[slot, voxel].mean(axis=0).astype(np.uint8)


def _tone(rgb: NDArray[np.generic]) -> tuple[Float64, Float64]:
    """Hue and saturation (N, 2) and lightness (N,) of colours (N, 3), as logarithms: other light shifts them."""
    log = np.log(rgb.astype(np.float64) + DARK)
    return np.stack((log[:, 0] - log[:, 1], log[:, 2] - log[:, 1]), axis=1), log.mean(axis=1)


def read_thing(snapshot: MapSnapshot, thing: Instance) -> tuple[Float64, Int64, Int64]:
    """Voxel centres (N, 3) of a thing, world metres, and slot and voxel of each; those still in the map."""
    row, there = find_sorted(snapshot.packed, pack_keys(thing.voxels >> 3))
    x, y, z = (thing.voxels[there] & 7).astype(np.int64).T
    xyz = thing.voxels[there].astype(np.float64) * snapshot.voxel_size_m
    return xyz, snapshot.slots[row[there]].astype(np.int64), (z * 8 + y) * 8 + x


def sample_points(thing: Instance, snapshot: MapSnapshot, most: int = COMPARED) -> Float64:
    """Centres of at most so many of its voxels, world metres."""
    every = -(-len(thing.voxels) // most)
    return thing.voxels[::every].astype(np.float64) * snapshot.voxel_size_m


def find_evidence(visit: MapVisit, class_id: int, points: Float64, fitted: Callable[[], Float64]) -> Evidence:
    """What is known in a map of points (N, 3), world metres; ``fitted`` gives them as they lie where the surfaces of
    both maps are fitted, and is called where they seem not to be there."""
    voxel_m = visit.snapshot.voxel_size_m
    free, solid = _states(visit.snapshot, points / voxel_m, class_id)
    if 2 * solid.sum() > len(points) and free.sum() < SHIFTED_FREE * (free | solid).sum():
        return Evidence(free, solid, 0)
    points = fitted()
    free, solid = _states(visit.snapshot, points / voxel_m, class_id)
    through, looks = visit.looks.through(visit.snapshot, points)
    free |= ~solid & (through >= LEAST_LOOKS)
    return Evidence(free, solid, looks)


def _states(snapshot: MapSnapshot, voxels: Float64, class_id: int) -> tuple[Bool, Bool]:
    """Which of points (N, 3) in voxels are free, with no surface at one voxel from them, and which have one of a class.
    A surface of another class says nothing of a thing that stands at it."""
    around = (voxels + FACES[:, None]).reshape(-1, 3)
    states = read_states(around, snapshot)
    occupied = states == State.OCCUPIED
    cell = np.floor(around[occupied] + 0.5).astype(np.int64)
    x, y, z = (cell & 7).T
    row, there = find_sorted(snapshot.packed, pack_keys(cell >> 3))
    own = np.zeros(len(around), np.bool_)
    label = snapshot.voxels.label[snapshot.slots[row[there]], ((z * 8 + y) * 8 + x)[there]]
    own[np.flatnonzero(occupied)[there]] = label == class_id
    near = np.logical_or.reduce(occupied.reshape(len(FACES), -1))
    return (states[: len(voxels)] == State.FREE) & ~near, np.logical_or.reduce(own.reshape(len(FACES), -1))


def parted(
    visit: MapVisit, other: MapVisit, lie: Callable[[Float64], Float64], up: Float64
) -> tuple[list[Instance], list[tuple[Instance, int]]]:
    """The things of a visit without parts that the other map has free: small things that stood so near to others that
    they are one piece; and those parts, each with the position of its thing. ``lie`` brings points (N, 3) of this
    map to where they lie in the other."""
    wholes, parts = list[Instance](), list[tuple[Instance, int]]()
    size = visit.snapshot.voxel_size_m
    for k, thing in enumerate(visit.things):
        wholes.append(thing)
        if thing.class_name != OTHER:
            continue
        free, solid = _states(other.snapshot, sample_points(thing, visit.snapshot) / size, thing.class_id)
        if not PART_FREE <= free.sum() / max(1, (free | solid).sum()) < GONE_FREE or len(thing.voxels) > MOST_PARTED:
            continue
        xyz = thing.voxels.astype(np.float64) * size
        there = lie(xyz)
        free, _ = _states(other.snapshot, there / size, thing.class_id)
        at, taken = np.flatnonzero(free), np.zeros(len(xyz), np.bool_)
        pairs = scipy.spatial.KDTree(xyz[at]).query_pairs(PART_GAP * size, output_type="ndarray")
        graph = scipy.sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (len(at), len(at)))
        _, number = scipy.sparse.csgraph.connected_components(graph, directed=False)
        for n in np.flatnonzero(np.bincount(number, minlength=1) >= PART_VOXELS):
            rows = at[number == n]
            part = _piece(thing, xyz, rows, up)
            filled = len(rows) * size**2 / float(np.sort(part.box.size)[1:].prod())
            whole = part.box.size.min() >= PART_SIDE_M and filled >= LEAST_FILLED
            if whole and len(rows) <= MOST_PART * len(xyz) and not stands(other, thing.class_id, there[rows]):
                parts.append((part, k))
                taken[rows] = True
        if taken.any():
            wholes[-1] = _piece(thing, xyz, np.flatnonzero(~taken), up)
    return wholes, parts


def stands(visit: MapVisit, class_id: int, points: Float64) -> bool:
    """Whether most of points (N, 3) lie so near to a thing of a class that they have not been moved."""
    kin = (
        thing.voxels.astype(np.float64) * visit.snapshot.voxel_size_m
        for thing in visit.things
        if thing.class_id == class_id
    )
    return any(_share_near(points, surface) > 0.5 for surface in kin)


def _piece(thing: Instance, xyz: Float64, rows: Int64, up: Float64) -> Instance:
    """Some of the voxels (N,) of a thing, which lie at (N, 3), as a thing."""
    frame = thing.box.R_world_box
    if abs(float(frame[:, 2] @ up)) < 0.99:
        frame = turn_onto(np.array((0.0, 0.0, 1.0)), up)
    box = upright_box(xyz[rows], frame)
    return replace(thing, voxels=thing.voxels[rows], box=box, centroid=xyz[rows].mean(axis=0))


def touching(boxes: Sequence[OrientedBox], classes: Sequence[int] = ()) -> list[list[int]]:
    """Groups of pieces whose boxes touch; of one class, where classes are given."""
    groups: list[list[int]] = []

    def touch(k: int, m: int) -> bool:
        a, b = boxes[k], boxes[m]
        axes = np.concatenate((a.R_world_box.T, b.R_world_box.T))
        reach = sum(np.abs(axes @ box.R_world_box) @ box.size / 2 for box in (a, b))
        apart = np.abs(axes @ (b.center - a.center)) > reach + TOUCH_M
        return (not classes or classes[k] == classes[m]) and not apart.any()

    for k in range(len(boxes)):
        near = [g for g in groups if any(touch(k, m) for m in g)]
        groups = [g for g in groups if g not in near] + [[*(m for g in near for m in g), k]]
    return groups


def joined(pieces: Sequence[Instance], voxel_m: float) -> Instance:
    """Pieces of one thing as one, with the id of the largest."""
    largest, voxels = max(pieces, key=lambda t: len(t.voxels)), np.concatenate([t.voxels for t in pieces])
    xyz = voxels.astype(np.float64) * voxel_m
    return replace(largest, voxels=voxels, box=upright_box(xyz, largest.box.R_world_box), centroid=xyz.mean(axis=0))


def overlapping(
    before: Sequence[Float64], now: Sequence[Float64], same_class: Callable[[int, int], bool]
) -> list[tuple[int, int]]:
    """Pairs of things whose points (N, 3) lie at the same place, the best first, each at most once."""
    pairs: list[tuple[float, int, int]] = []
    if before and now:
        ends = [np.array([(p.min(axis=0), p.max(axis=0)) for p in points]) for points in (before, now)]
        meet = (ends[0][:, None, 0] < ends[1][None, :, 1] + 0.05) & (ends[1][None, :, 0] < ends[0][:, None, 1] + 0.05)
        trees = [[scipy.spatial.KDTree(p) for p in points] for points in (before, now)]
        reach = [[_reach(tree) for tree in of_visit] for of_visit in trees]
        for i, j in np.argwhere(meet.all(axis=2)).tolist():
            one, other = (
                np.isfinite(tree.query(p, distance_upper_bound=limit)[0]).mean()
                for tree, p, limit in ((trees[1][j], before[i], reach[1][j]), (trees[0][i], now[j], reach[0][i]))
            )
            score = float(one * other) * (1.0 if same_class(i, j) else OTHER_CLASS)
            if score >= LEAST_SCORE:
                pairs.append((score, i, j))
    found, used = list[tuple[int, int]](), (set[int](), set[int]())
    for _, i, j in sorted(pairs, reverse=True):
        if i not in used[0] and j not in used[1]:
            found.append((i, j))
            used[0].add(i)
            used[1].add(j)
    return found


def _reach(tree: Any) -> float:
    """How far points of the same surface may lie from the points of a tree, metres."""
    spacing = tree.query(tree.data, 2)[0][:, 1] if tree.n > 1 else np.zeros(1)
    return max(NEAR_M, 1.2 * float(np.median(spacing)))


def lies_along(before: Float64, now: Float64) -> bool:
    """Whether of two surfaces, points (N, 3), one lies at the other: what was seen in part has not moved."""
    return max(_share_near(before, now), _share_near(now, before)) > STANDS


def _share_near(points: Float64, surface: Float64) -> float:
    """Which part of points (N, 3) is nearer than ``LEAST_SHIFT_M`` to any of a surface (M, 3)."""
    low, high = points.min(axis=0) - LEAST_SHIFT_M, points.max(axis=0) + LEAST_SHIFT_M
    there = surface[((surface >= low) & (surface <= high)).all(axis=1)]
    if not len(there):
        return 0.0
    return float(np.mean(scipy.spatial.KDTree(there).query(points)[0] < LEAST_SHIFT_M))


def may_go(box: OrientedBox, voxels: int) -> bool:
    """Whether a thing, or what is kept of it, is large enough to be called gone or new."""
    sides = np.sort(box.size)
    return voxels >= LEAST_VOXELS and bool((sides[:2] >= SLIVER_M).any())


class Fit:
    """How surfaces of one map lie in another: a motion for each cell, found when it is first needed; without a map
    of before, as they are."""

    def __init__(self, before: MapSnapshot | None, after: MapSnapshot) -> None:
        self._after, self._motions = after, dict[tuple[int, ...], Float64]()
        self._cells = dict[tuple[int, ...], Float64]()
        if before is not None:
            points = surface_voxels(before).point * before.voxel_size_m
            cells, part = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_inverse=True)
            order = np.argsort(part.ravel(), kind="stable")
            pieces = np.split(points[order], np.cumsum(np.bincount(part.ravel()))[:-1])
            self._cells = dict(zip(map(tuple, cells.tolist()), pieces, strict=True))

    def at(self, point: Float64) -> Float64:
        """T_after_before (4, 4) round a point (3,)."""
        key = tuple(np.floor(point / CELL_M).astype(int).tolist())
        if not self._cells:
            return np.eye(4)
        if key not in self._motions:
            around = (tuple(np.add(key, step).tolist()) for step in np.ndindex(3, 3, 3))
            near = [self._cells[c] for c in (tuple(np.subtract(c, 1).tolist()) for c in around) if c in self._cells]
            points = np.concatenate((*near, np.empty((0, 3))))
            points = points[(np.abs(points - (np.array(key) + 0.5) * CELL_M) < CELL_REACH_M).all(axis=1)]
            self._motions[key] = _fitted(self._after, points[:: 1 + len(points) // FIT_POINTS])
        return self._motions[key]


def _fitted(snapshot: MapSnapshot, points: Float64) -> Float64:
    """The motion (4, 4) that brings points (N, 3), world metres, onto the surface; the identity where too few fit.

    Gauss-Newton on the signed distance, with Tukey's weights."""
    T = np.eye(4)
    if len(points) < LEAST_FIT:
        return T
    middle, size = points.mean(axis=0), snapshot.voxel_size_m
    for _ in range(FIT_ROUNDS):
        moved = transform(T, points)
        distance, gradient = _distance(snapshot, moved / size)
        inside = np.flatnonzero(np.isfinite(distance) & (np.abs(distance) < FIT_TUKEY))
        length = np.linalg.norm(gradient[inside], axis=1)
        inside, length = inside[length > 0.3], length[length > 0.3]
        if len(inside) < LEAST_FIT:
            return np.eye(4)
        d, n = distance[inside] * size, gradient[inside] / length[:, None]
        weight = (1 - (distance[inside] / FIT_TUKEY) ** 2) ** 2
        J = np.concatenate((np.cross(moved[inside] - middle, n), n), axis=1)
        step = np.linalg.solve(J.T @ (J * weight[:, None]) + 1e-3 * np.eye(6), -J.T @ (weight * d))
        turn = np.eye(4)
        turn[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
        turn[:3, 3] = middle + step[3:] - turn[:3, :3] @ middle
        T = turn @ T
    angle = np.linalg.norm(scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_rotvec())
    shift = np.linalg.norm(transform(T, middle[None])[0] - middle)
    return T if shift <= MOST_FIT_M and angle <= MOST_FIT_RAD else np.eye(4)


def _distance(snapshot: MapSnapshot, points: Float64) -> tuple[Float64, Float64]:
    """Signed distance (N,) in voxels at points (N, 3) in voxels, NaN where not observed, and its gradient (N, 3)."""
    base = np.floor(points + 0.5).astype(np.int64)
    steps = np.concatenate((np.zeros((1, 3), np.int64), np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)))
    voxel = base[None] + steps[:, None]  # (7, N, 3)
    row, there = find_sorted(snapshot.packed, pack_keys((voxel >> 3).reshape(-1, 3)))
    x, y, z = (voxel.reshape(-1, 3) & 7).T
    value = np.full(len(row), np.nan)
    read = snapshot.voxels.tsdf[snapshot.slots[row[there]], ((z * 8 + y) * 8 + x)[there]].astype(np.float64)
    value[there] = np.where(read == UNOBSERVED, np.nan, read * (snapshot.truncation_voxels / TSDF_STEPS))
    value = value.reshape(7, -1)
    gradient = np.nan_to_num((value[1:4] - value[4:7]).T / 2)
    return value[0] + ((points - base) * gradient).sum(axis=1), gradient
