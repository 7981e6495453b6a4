"""Countable things in a map, with ids that stay with them while the map grows."""

import math
import threading
import weakref
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
import scipy  # loads `spatial` when it is first used
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import turn_onto
from semantic_mapper.kernels import kernel
from semantic_mapper.labels import PLAIN_NAMES, STUFF_NAMES
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, pack_keys, unpack_keys
from semantic_mapper.mapping.changes import CONFIDENCE_STEPS
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.queries.checks import check_up
from semantic_mapper.queries.occupancy import State, read_states
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.types import Bool, Float64, Int32, Int64, UInt8

MIN_VOXELS = 30  # 120 cm^2 of surface at 2 cm: less is mostly noise
LISTED = 0.35  # certainty from which on things are listed: of 0.35, 0.4 and 0.5 the one of the best F1 and counts
# Area of surface, m^2, from which on a piece of a class with mean confidence EVEN_CONFIDENCE is more likely right than
# wrong; DEFAULT_M2 for classes that rooms lack. Fitted by ``python -m research.experiments.things --split fit``.
# fmt: off
EVEN_M2 = {
    "bed": 0.35, "table": 0.219, "sink": 0.166, "sofa": 0.165, "curtain": 0.131, "refrigerator": 0.116,
    "bathtub": 0.106, "counter": 0.102, "cabinet": 0.092, "bookshelf": 0.09, "window": 0.08, "toilet": 0.079,
    "door": 0.047, "chair": 0.033, "desk": 0.023, "otherfurniture": 0.017, "picture": 0.013, "otherprop": 0.01,
}
# fmt: on
DEFAULT_M2, EVEN_CONFIDENCE = 0.03, 0.8
CONFIDENCE_GAIN, AREA_GAIN = 8.68, 1.09  # log-odds a unit of confidence, and of the logarithm of area
STRAY = 0.005  # of the points of a thing at either end of each axis that do not count for its box
OWN_AXES = 0.8  # of the floor area of the box along the room's axes: a smaller one of its own axes is taken
YAW_SAMPLE = 2000  # points that the room's axes are looked for in
YAW_BIN_M = 0.02
OTHER = "otherprop"  # small things of any kind, which often touch
# Surface of one with less than ``CORE_FREE`` of these places round it free, in voxels, is at a seam, not in its core.
# Distance and fraction: of some, those of the best F1 and counts.
SEAM_PLACES = 2.5 * np.vstack((np.eye(3), -np.eye(3), np.array([*product((-1, 1), repeat=3)]) / 3**0.5))
CORE_FREE = 0.4
GAP_M = 0.1  # pieces of another class that are no farther apart are one thing
FLAT_M = 0.1  # of a thing that is thinner, only the better seen side of the two counts
MAX_GONE = 64  # things that have gone, kept to be reported
MAX_DIRECTIONS = 4  # called up, along which boxes are kept while the map is the same
LEAST_OVERLAP = 0.1  # of an instance's voxels must be found again in what it became


@dataclass(frozen=True, slots=True, eq=False)
class OrientedBox:
    """A box that stands upright."""

    center: Float64  # (3,) float64 world metres
    size: Float64  # (3,) float64 metres along its own axes: x the longer level side, y the shorter, z along up
    R_world_box: Float64  # (3, 3) float64, columns are its axes in the world

    def holds(self, point: ArrayLike) -> bool:
        """Whether a point (3,), world metres, is inside."""
        return bool((np.abs((np.asarray(point) - self.center) @ self.R_world_box) <= self.size / 2).all())


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """One thing: surface of one class that is connected, as ``find_things`` has it."""

    id: int  # above 0; stays with the thing from update to update, and is never given to another
    # class_id, class_name: Of the label set.
    class_id: int
    class_name: str
    confidence: float  # mean over its voxels
    centroid: Float64  # (3,) float64 mean of its surface points, world metres
    box: OrientedBox  # upright box round its surface points
    # (N, 3) int32 coordinates of its surface voxels; centres at ``voxels * voxel_size_m``
    voxels: NDArray[np.int32] = field(repr=False)
    measured: float = 1.0  # fraction of them that a sensor measured; the depth of the others was computed
    certainty: float = 1.0  # probability that it is a thing of its class, IoU 0.25 or more; see ``certainty_of``
    # fraction of its outside that was seen: of its silhouettes from the four sides of its box and from above, the area
    # in which free space was seen before its surface; a side that stands at a wall counts as not seen
    seen: float = 1.0
    # stamp of the frame at which most of it was gone; all else is as it was before. None = it is there.
    gone_ns: int | None = None

    @property
    def title(self) -> str:
        """What people read: the class in plain words, and the id."""
        return f"{PLAIN_NAMES.get(self.class_name, self.class_name)} {self.id}"

    @property
    def unsure(self) -> bool:
        """Whether its certainty is below ``LISTED``, and so it is listed on request only."""
        return self.certainty < LISTED


def certainty_of(class_name: str, confidence: float, area_m2: float) -> float:
    """Probability that a connected piece is a thing of its class, by mean confidence and area of its surface."""
    size = AREA_GAIN * math.log(area_m2 / EVEN_M2.get(class_name, DEFAULT_M2))
    return 1 / (1 + math.exp(-(CONFIDENCE_GAIN * (confidence - EVEN_CONFIDENCE) + size)))


class ThingVoxels(NamedTuple):
    """N surface voxels of some classes in the B blocks of a map, ordered as in ``SurfaceVoxels``."""

    packed: Int64  # (B,) int64 sorted keys
    start: Int64  # (B + 1,) int64; block b has the voxels ``start[b] .. start[b + 1] - 1``.
    row: Int32  # (N,) int32 position of the block in ``packed``
    voxel: Int32  # (N,) int32 within the block, ascending in each
    point: Float64  # (N, 3) float64 surface point in units of voxels
    label: UInt8  # (N,) uint8 class ids


def thing_voxels(snapshot: MapSnapshot, wanted: Bool) -> ThingVoxels:
    """The surface voxels of the classes with ids ``wanted`` (256,)."""
    bits = np.packbits(wanted, bitorder="little").view("<u8")
    rows = np.flatnonzero((snapshot.voxels.classes[snapshot.slots] & bits).any(axis=1))
    row, voxel, point = surface_voxels(snapshot, rows)
    label = snapshot.voxels.label[snapshot.slots[row], voxel]
    kept = wanted[label]
    start = np.searchsorted(row[kept], np.arange(snapshot.block_count + 1))
    return ThingVoxels(snapshot.packed, start, row[kept], voxel[kept], point[kept], label[kept])


class FoundThings(NamedTuple):
    """The things of a map, unsure ones too, and which voxels are theirs."""

    things: tuple[Instance, ...]  # by ascending id
    voxels: ThingVoxels  # of all classes of things
    number: Int64  # (N,) int64 position in ``things`` of what each voxel belongs to; -1 = too small a piece


class _Found(NamedTuple):
    """What was found in a snapshot; ``ids`` (C,) and ``sizes`` (C,) in voxels go with the components."""

    snapshot: weakref.ref[MapSnapshot]
    voxels: ThingVoxels
    components: "Components"
    ids: Int64
    sizes: Int64
    along: dict[bytes, FoundThings]  # by the direction that was called up


class _Whole(NamedTuple):
    """A thing as it was when it was last at least half as large as ever, and in which version of the map."""

    thing: Instance
    version: int
    most_voxels: int


class InstanceTracker:
    """Finds the instances of one map again and again. Safe to call from several threads.

    An instance is what one of the last update became where it holds the most of that one's voxels, and at least a
    tenth. Of several that became one, the oldest id stays; of a split, the largest part keeps the id. A thing of which
    more than half was seen through since it was whole has gone (``gone``); what is left of it gets a new id. One that
    is only no longer found has not gone. Pieces below ``min_voxels`` are left out; ``up`` (3,) is along which boxes
    stand where an update names no other. Their sides run along the room's axes (the level directions that most surface
    of things runs along), or the thing's own where it is clearly turned. A map that has not changed costs nothing."""

    def __init__(self, min_voxels: int = MIN_VOXELS, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        if min_voxels < 1:
            raise MapError(f"min_voxels must be at least 1, got {min_voxels}")
        self._min_voxels = min_voxels
        self._up = check_up(up)
        self._next_id = 1
        self._last: _Found | None = None
        self._epoch = 0
        self._whole: dict[int, _Whole] = {}
        self._going: dict[int, _Whole] = {}  # found in less than half, and seen through, but not gone yet
        self._gone: deque[Instance] = deque(maxlen=MAX_GONE)
        self._lock = threading.Lock()

    @property
    def gone(self) -> tuple[Instance, ...]:
        """The things that had gone by the last update, those first that went first; the latest ``MAX_GONE``."""
        with self._lock:
            return tuple(self._gone)

    def update(self, snapshot: MapSnapshot, *, unsure: bool = False) -> tuple[Instance, ...]:
        """The instances of the map as it is now, by ascending id; those that are ``unsure`` only on request.

        Raises MapError: lengths of the map are not metres."""
        return tuple(thing for thing in self.find(snapshot).things if unsure or not thing.unsure)

    def knows(self, snapshot: MapSnapshot) -> bool:
        """Whether the things of this snapshot were found last, so that to ask again costs nothing."""
        return self._last is not None and self._last.snapshot() is snapshot

    def find(self, snapshot: MapSnapshot, up: ArrayLike | None = None) -> FoundThings:
        """As ``update``, with the voxels of the things and with unsure ones, and boxes that stand along ``up`` (3,)."""
        require_metres(snapshot.scale_known, "things")
        axis = self._up if up is None else check_up(up)
        with self._lock:
            if self._last is None or not self.knows(snapshot):
                self._last = self._find(snapshot)
                self._keep_whole(snapshot, _describe(snapshot, self._last, axis).things)
            return _describe(snapshot, self._last, axis)

    def _find(self, snapshot: MapSnapshot) -> _Found:
        wanted = np.zeros(256, np.bool_)
        wanted[list(snapshot.label_set.thing_ids(STUFF_NAMES))] = True
        voxels = thing_voxels(snapshot, wanted)
        found = find_things(snapshot, voxels, self._min_voxels)
        sizes = np.diff(found.ends, prepend=0)
        ids = np.zeros(len(sizes), np.int64)
        if self._last:
            self._match(self._last, voxels, found, ids)
            self._find_gone(snapshot, ids, sizes)
        new = np.flatnonzero(ids == 0)
        ids[new] = self._next_id + np.arange(len(new))
        self._next_id += len(new)
        return _Found(weakref.ref(snapshot), voxels, found, ids, sizes, {})

    def _match(self, last: _Found, voxels: ThingVoxels, found: "Components", ids: Int64) -> None:
        """Write the id that each component had."""
        count = len(ids)
        blocks = np.union1d(last.voxels.packed, voxels.packed)
        places = [np.searchsorted(blocks, v.packed)[v.row] * BLOCK_VOXELS + v.voxel for v in (last.voxels, voxels)]
        _, before, now = np.intersect1d(*places, assume_unique=True, return_indices=True)
        was, became = last.components.component[before], found.component[now]
        both = (was >= 0) & (became >= 0)
        pairs, overlaps = np.unique(was[both] * count + became[both], return_counts=True)
        ends = np.searchsorted(pairs, count * np.arange(len(last.ids) + 1))
        for old in np.argsort(last.ids):  # so that the oldest of several has its component first
            part = slice(ends[old], ends[old + 1])
            if part.start < part.stop:
                best = int(np.argmax(overlaps[part]))
                successor = pairs[part][best] % count
                if overlaps[part][best] >= LEAST_OVERLAP * last.sizes[old] and ids[successor] == 0:
                    ids[successor] = last.ids[old]

    def _find_gone(self, snapshot: MapSnapshot, ids: Int64, sizes: Int64) -> None:
        """Note which things have gone, and take the ids of their remains away."""
        if snapshot.epoch != self._epoch:  # all may have moved
            self._epoch, self._whole = snapshot.epoch, {}
        size_of = dict(zip(ids.tolist(), sizes.tolist(), strict=True))
        small = {n: whole for n, whole in self._whole.items() if 2 * size_of.get(n, 0) < whole.most_voxels}
        self._going = {}
        for number, whole in sorted(small.items()):
            left, stamps = _seen_through(snapshot, whole)
            if len(stamps) and 2 * left >= whole.most_voxels:
                self._going[number] = whole
            elif len(stamps):
                self._gone.append(replace(whole.thing, gone_ns=int(stamps[len(stamps) // 2])))
                ids[ids == number] = 0

    def _keep_whole(self, snapshot: MapSnapshot, things: Collection[Instance]) -> None:
        """Note the things as they are, save those that are about to go; what else has shrunk is whole again."""
        before, found = self._whole, {thing.id for thing in things}
        lost = [number for number in self._going if number not in found]
        self._whole = {number: self._going[number] for number in lost[-MAX_GONE:]}
        for thing in things:
            known, size = before.get(thing.id), len(thing.voxels)
            most = size if known is None or 2 * size < known.most_voxels else max(size, known.most_voxels)
            self._whole[thing.id] = self._going.get(thing.id) or _Whole(thing, snapshot.version, most)


def _describe(snapshot: MapSnapshot, found: _Found, up: Float64) -> FoundThings:
    """The things that were found, with boxes that stand along ``up`` (3,)."""
    if (key := up.tobytes()) not in found.along:
        voxels, pieces = found.voxels, found.components
        parts = dict(zip(found.ids.tolist(), np.split(pieces.order, pieces.ends[:-1]), strict=False))
        frame = _room_frame(voxels.point[pieces.order] * snapshot.voxel_size_m, up)
        things = tuple(_describe_thing(snapshot, number, voxels, part, frame) for number, part in sorted(parts.items()))
        number = np.append(np.argsort(np.argsort(found.ids)), -1)[pieces.component]
        if len(found.along) == MAX_DIRECTIONS:
            found.along.clear()
        found.along[key] = FoundThings(things, voxels, number)
    return found.along[key]


def _describe_thing(snapshot: MapSnapshot, number: int, voxels: ThingVoxels, part: Int64, frame: Float64) -> Instance:
    row, voxel, labels = voxels.row[part], voxels.voxel[part].astype(np.int64), snapshot.label_set
    slot, class_id = snapshot.slots[row].astype(np.int64), int(voxels.label[part[0]])
    xyz, name = voxels.point[part] * snapshot.voxel_size_m, labels.names[labels.ids.index(class_id)]
    confidence = float(snapshot.voxels.confidence[slot, voxel].mean(dtype=np.float64) / CONFIDENCE_STEPS)
    box = upright_box(xyz, frame)
    place = np.stack((voxel & 7, (voxel >> 3) & 7, voxel >> 6), axis=1).astype(np.int32)
    place += unpack_keys(voxels.packed[row]) * 8
    measured = float(snapshot.measured(slot, voxel).mean())
    certainty = certainty_of(name, confidence, len(part) * snapshot.voxel_size_m**2)
    seen = float(_fraction_seen(snapshot, voxels.point[part], box))
    return Instance(number, class_id, name, confidence, xyz.mean(axis=0), box, place, measured, certainty, seen)


def _seen_through(snapshot: MapSnapshot, whole: _Whole) -> tuple[int, Int64]:
    """How many voxels of a thing have a surface still, and the stamp of each voxel cleared there, ascending; none where
    these are too few to be what the thing has lost."""
    packed = pack_keys(whole.thing.voxels >> 3)
    rows = snapshot.cleared.between(whole.version, snapshot.version)
    of_thing = np.isin(rows.packed, packed)
    stamps = np.repeat(rows.stamp_ns[of_thing], rows.voxels[of_thing])
    if not len(stamps):
        return len(packed), stamps
    surface = surface_voxels(snapshot, np.flatnonzero(np.isin(snapshot.packed, packed)))
    blocks, row = np.unique(packed, return_inverse=True)
    x, y, z = (whole.thing.voxels & 7).T
    there = np.searchsorted(blocks, snapshot.packed[surface.row]) * BLOCK_VOXELS + surface.voxel
    left = int(np.isin(row * BLOCK_VOXELS + (z * 8 + y) * 8 + x, there).sum())
    return left, stamps if 2 * len(stamps) >= len(packed) - left else stamps[:0]


class Components(NamedTuple):
    """C components of N surface voxels."""

    # (N,) int64 0..C-1, numbered in the order of their first voxels; -1 = in a piece that is too small
    component: NDArray[np.int64]
    order: NDArray[np.int64]  # (M,) int64 voxels of the first component, ascending, then those of the second, and so on
    ends: NDArray[np.int64]  # (C,) int64 where in ``order`` each component ends


def find_components(voxels: ThingVoxels, min_voxels: int) -> Components:
    """Surface voxels of one class that touch by face, edge or corner; pieces of fewer voxels are left out."""
    used = np.diff(voxels.start) > 0
    node, first = np.full((int(used.sum()), 512), -1, np.int32), np.empty(len(voxels.voxel), np.int64)
    connect_voxels(voxels.packed, voxels.start, voxels.voxel, voxels.label, np.cumsum(used) - 1, node, first)
    sizes = np.bincount(first, minlength=len(first))  # at the first voxel of each component
    large = np.flatnonzero(sizes >= min_voxels)
    number = np.full(len(first), -1, np.int64)
    number[large] = np.arange(len(large))
    component = number[first]
    kept = np.flatnonzero(component >= 0)
    # Numpy sorts integers of 16 bits, which nearly always suffice, much faster than longer ones.
    order = kept[np.argsort(component[kept].astype(np.min_scalar_type(len(large))), kind="stable")]
    return Components(component, order, np.cumsum(sizes[large]))


def find_things(snapshot: MapSnapshot, voxels: ThingVoxels, min_voxels: int) -> Components:
    """As ``find_components``, but pieces of ``OTHER`` are cut at seams, and near ones of other classes are joined."""
    found, pieces, parts = find_components(voxels, min_voxels), dict[int, list[Int64]](), list[Int64]()
    for piece in np.split(found.order, found.ends)[:-1]:
        pieces.setdefault(int(voxels.label[piece[0]]), []).append(piece)
    for class_id, own in sorted(pieces.items()):
        if snapshot.label_set.names[snapshot.label_set.ids.index(class_id)] == OTHER:
            parts += _cut_at_seams(snapshot, voxels, own, min_voxels)
        else:
            parts += _join_near(voxels, own, GAP_M / snapshot.voxel_size_m)
    order, ends = np.concatenate((found.order[:0], *parts)), np.cumsum([len(part) for part in parts], dtype=np.int64)
    component = np.full(len(voxels.voxel), -1, np.int64)
    component[order] = np.repeat(np.arange(len(parts)), np.diff(ends, prepend=0))
    return Components(component, order, ends)


def _cut_at_seams(snapshot: MapSnapshot, voxels: ThingVoxels, pieces: Sequence[Int64], min_voxels: int) -> list[Int64]:
    """Pieces of one class; one with several cores of ``min_voxels`` is divided, each voxel goes to the nearest core."""
    every = np.sort(np.concatenate(pieces))
    around = (voxels.point[every] + SEAM_PLACES[:, None]).reshape(-1, 3)
    free = (read_states(around, snapshot).reshape(len(SEAM_PLACES), -1) == State.FREE).mean(axis=0)
    at = every[free >= CORE_FREE]
    packed, _, row, voxel, point, label = voxels
    start = np.searchsorted(row[at], np.arange(len(packed) + 1))
    core, parts = np.full(len(row), -1, np.int64), list[Int64]()
    core[at] = find_components(ThingVoxels(packed, start, row[at], voxel[at], point[at], label[at]), min_voxels)[0]
    for piece in pieces:
        number = core[piece]
        inside = number >= 0
        if len(cores := np.unique(number[inside])) > 1:
            _, nearest = scipy.spatial.KDTree(voxels.point[piece[inside]]).query(voxels.point[piece[~inside]])
            number[~inside] = number[inside][nearest]
        parts += [piece[number == n] for n in cores] if len(cores) > 1 else [piece]
    return parts


def _join_near(voxels: ThingVoxels, pieces: Sequence[Int64], gap: float) -> list[Int64]:
    """Pieces of one class; those that are less than ``gap`` voxels apart are one."""
    points, group = [voxels.point[piece] for piece in pieces], np.arange(len(pieces))
    low, high = (np.array([end(p, axis=0) for p in points]) for end in (np.min, np.max))
    near = (low[:, None] - high < gap).all(axis=2)
    for one, other in np.argwhere(np.triu(near & near.T, 1)).tolist():
        a, b = points[one], points[other]
        a = a[((a > low[other] - gap) & (a < high[other] + gap)).all(axis=1)]
        if len(a) and np.isfinite(scipy.spatial.KDTree(a).query(b, distance_upper_bound=gap)[0]).any():
            group[group == group[other]] = group[one]
    return [np.sort(np.concatenate([pieces[k] for k in np.flatnonzero(group == n).tolist()])) for n in np.unique(group)]


@kernel
def connect_voxels(
    packed: Int64, start: Int64, voxel: Int32, label: UInt8, used: Int64, node: Int32, first: Int64
) -> None:
    """Write the ``first`` voxel of the component of each of the ``ThingVoxels`` (N,): union-find over 26 neighbours.
    ``used`` (B,) numbers the U blocks that have voxels, ``node`` (U, 512) is scratch, -1."""
    ...


def upright_box(xyz: Float64, frame: Float64) -> OrientedBox:
    """The box round points (N, 3), N > 0, without strays, along the columns of ``frame`` (3, 3), whose third is up; or
    along a side of their hull from above, where the floor area is then below ``OWN_AXES`` of that."""
    middle = xyz.mean(axis=0)
    plan = (xyz - middle) @ frame[:, :2]
    own = math.radians(cv2.minAreaRect(plan.astype(np.float32))[2]) % (math.pi / 2)
    least = YAW_BIN_M  # a thing without depth has no area
    areas = [float(np.prod(np.ptp(_extent(plan @ _turn(yaw)), axis=0) + least)) for yaw in (0.0, own)]
    yaw = own if areas[1] < OWN_AXES * areas[0] else 0.0
    if np.diff(np.ptp(_extent(plan @ _turn(yaw)), axis=0))[0] > 0:
        yaw += np.pi / 2
    R = frame.copy()
    R[:, :2] = frame[:, :2] @ _turn(yaw)
    low, high = _extent((xyz - middle) @ R)
    return OrientedBox(middle + R @ ((low + high) / 2), high - low, R)


def _extent(points: Float64) -> Float64:
    """Lowest and highest value (2, D) of points (N, D) along each axis, without strays."""
    few = int(STRAY * len(points))
    ends = np.partition(points, (few, len(points) - 1 - few), axis=0) if few else np.sort(points, axis=0)
    return ends[[few, len(points) - 1 - few]]


def _room_frame(xyz: Float64, up: Float64) -> Float64:
    """Axes (3, 3), columns, the third up: those along which points (N, 3) lie in the fewest level layers."""
    frame = turn_onto(np.array((0.0, 0.0, 1.0)), up)
    plan = (xyz[:: 1 + len(xyz) // YAW_SAMPLE] @ frame)[:, :2]

    def sharpness(yaw: float) -> int:
        bins = np.floor((plan @ _turn(yaw)) / YAW_BIN_M).astype(np.int64)
        return sum(int((np.bincount(column - column.min()) ** 2).sum()) for column in bins.T)

    if len(plan):
        coarse = max(np.arange(0, np.pi / 2, np.pi / 90), key=sharpness)
        frame[:, :2] = frame[:, :2] @ _turn(max(coarse + np.linspace(-1, 1, 9) * np.pi / 90, key=sharpness))
    return frame


def _fraction_seen(snapshot: MapSnapshot, point: Float64, box: OrientedBox) -> float:
    """``Instance.seen`` of surface points (N, 3) in units of voxels."""
    sides = np.concatenate((box.R_world_box.T, -box.R_world_box.T[:2]))  # x, y, up, -x, -y
    before = np.ascontiguousarray((point + 1.5 * sides[:, None]).reshape(-1, 3))
    free = read_states(before, snapshot).reshape(5, -1) == State.FREE
    cell = np.floor(point @ box.R_world_box / 2).astype(np.int64)  # of two voxels: no gaps between those of a surface
    cell -= cell.min(axis=0)
    seen = whole = 0
    for axis, pair in enumerate(((0, 3), (1, 4), (2,))):
        a, b = np.delete(cell, axis, axis=1).T
        number = a * (b.max() + 1) + b
        areas = [np.count_nonzero(np.bincount(number[free[side]])) for side in pair]
        flat = box.size[axis] < FLAT_M
        seen += max(areas) if flat else sum(areas)
        whole += np.count_nonzero(np.bincount(number)) * (1 if flat else len(pair))
    return seen / whole


def _turn(yaw: float) -> Float64:
    """(2, 2) whose columns are the axes turned by ``yaw``."""
    return np.array(((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))))
