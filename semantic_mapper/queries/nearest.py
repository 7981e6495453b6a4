"""What is at a point, and the nearest surface of a class, by searches that need no index of their own."""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, BlockIndex
from semantic_mapper.mapping.changes import CONFIDENCE_STEPS
from semantic_mapper.queries.checks import check_point, check_points, check_positive
from semantic_mapper.queries.instances import FoundThings, Instance, InstanceTracker
from semantic_mapper.queries.occupancy import read_states
from semantic_mapper.queries.snapshot import MEASURED, BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float32, Float64, Int32, Int64, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class NearestSurface:
    """A place of the class that was requested."""

    xyz: Float64  # (3,) float64 point of the surface, world metres
    distance_m: float  # from the point of the question
    confidence: float  # probability of the class there
    measured: bool = True  # whether a sensor measured it, or its depth was computed
    thing: Instance | None = None  # that it is of; None = of none, such as a wall or a speck, or there are no metres


_trackers: WeakKeyDictionary[MapSnapshot, InstanceTracker] = WeakKeyDictionary()


def nearest(
    snapshot: MapSnapshot,
    class_name: str,
    point: ArrayLike,
    min_confidence: float = 0.0,
    *,
    unsure: bool = False,
    up: ArrayLike | None = None,
    tracker: InstanceTracker | None = None,
) -> NearestSurface | None:
    """The surface point of a class that is nearest to a point (3,), world metres, and the thing that it is of; ``None``
    where the map has none.

    Of countable classes, only things that ``instances`` lists count; with ``unsure``, or where lengths are not metres,
    any surface. Places that are less sure than ``min_confidence``, 0..1, do not count. ``tracker`` finds the things,
    once a snapshot, and boxes stand along ``up`` (3,). ``LabelError``: no such class; lists those there are.
    ``MapError``: a bad point, direction or confidence."""
    class_id = snapshot.label_set.id_of(class_name)
    p = check_point(point, snapshot)
    if not 0 <= min_confidence <= 1:
        raise MapError(f"min_confidence must be 0..1, got {min_confidence}")
    least = int(np.ceil(min_confidence * CONFIDENCE_STEPS - 1e-9))
    found, thing = np.array((0.0, 0.0, 0.0, np.inf)), None
    if snapshot.scale_known and class_id in snapshot.label_set.thing_ids(STUFF_NAMES):
        tracker = tracker or _trackers.setdefault(snapshot, InstanceTracker())
        things = tracker.find(snapshot, up)
        place, thing = _search_things(snapshot, class_id, p, least, things, found, unsure=unsure)
    else:
        voxels, index = snapshot.voxels, snapshot.index
        rows, bounds = np.empty(snapshot.block_count, np.int64), np.empty(snapshot.block_count)
        count = bound_blocks(p, class_id, snapshot.packed, snapshot.slots, voxels.classes, rows, bounds)
        order = np.argsort(bounds[:count], kind="stable")
        blocks = rows[order]
        near = snapshot.packed[blocks], snapshot.slots[blocks], bounds[order]
        place = search_blocks(p, class_id, least, *near, index, voxels, found)
    if place < 0:
        return None
    size_m, confidence = snapshot.voxel_size_m, float(snapshot.voxels.confidence.ravel()[place]) / CONFIDENCE_STEPS
    measured = bool(snapshot.voxels.weight.ravel()[place] == MEASURED)
    return NearestSurface(found[:3] * size_m, float(np.sqrt(found[3])) * size_m, confidence, measured, thing)


def _search_things(
    snapshot: MapSnapshot, class_id: int, p: Float64, least: int, things: FoundThings, found: Float64, *, unsure: bool
) -> tuple[int, Instance | None]:
    """As ``search_blocks`` for a countable class, and the thing there."""
    voxels = things.voxels
    counts = np.array([unsure or not thing.unsure for thing in things.things] + [unsure])
    at = np.flatnonzero((voxels.label == class_id) & counts[things.number])
    place = snapshot.slots[voxels.row[at]].astype(np.int64) * BLOCK_VOXELS + voxels.voxel[at]
    sure = snapshot.voxels.confidence.ravel()[place] >= least
    at, place = at[sure], place[sure]
    if not len(at):
        return -1, None
    squares = ((voxels.point[at] - p) ** 2).sum(axis=1)
    best = squares.argmin()
    found[:] = *voxels.point[at[best]], squares[best]
    number = things.number[at[best]]
    return int(place[best]), things.things[number] if number >= 0 else None


@kernel
def bound_blocks(
    p: Float64, class_id: int, packed: Int64, slots: Int32, classes: NDArray[np.uint64], rows: Int64, bounds: Float64
) -> int:
    """Write the rows (B,) of the blocks that may have surface of a class, and the squares (B,) of the least distances
    that it may have from ``p`` (3,), in voxels; returns how many there are."""
    ...


@kernel
def search_blocks(
    p: Float64,
    class_id: int,
    least: int,
    packed: Int64,
    slots: Int32,
    bounds: Float64,
    index: BlockIndex,
    voxels: BlockVoxels,
    found: Float64,
) -> int:
    """Look for the surface point of a class nearest to ``p`` in blocks (R,) in the order of their ``bounds``; of less
    confidence than ``least``, times 255, it does not count. Returns slot * 512 + voxel, -1 = none is nearer than
    ``found`` (4,), the nearest so far and the square of its distance in voxels, which is updated."""
    ...


RADIUS_VOXELS = 2.5  # default: bridges half a voxel of rounding and a little noise, not the gap between two objects
MAX_RADIUS_VOXELS = 25.0  # work grows with its cube; ``nearest`` searches farther


@dataclass(frozen=True, slots=True, eq=False)
class PointAnswers:
    """What is at N points."""

    label: UInt8  # (N,) uint8 class ids of the nearest surface; the ignore id where none is near or it is unknown
    confidence: Float32  # (N,) float32 probability of the likeliest class, 0 where none is near or nothing voted
    distance_m: Float32  # (N,) float32 to that surface, infinite where none is near
    state: UInt8  # (N,) uint8 ``State`` of the voxel that the point itself lies in
    # (N,) bool, whether a sensor measured that surface; False where none is near; None = unknown
    measured: Bool | None = None


def at(snapshot: MapSnapshot, points: ArrayLike, radius_m: float | None = None) -> PointAnswers:
    """Class and confidence of the surface at points (N, 3), world metres, and whether they are free or occupied.

    The class is that of the voxel whose surface point is nearest, at most ``radius_m`` away: by default 2.5 voxels, at
    most 25. ``MapError``: bad points, or a radius out of range."""
    p, most = check_points(points, snapshot), MAX_RADIUS_VOXELS * snapshot.voxel_size_m
    radius = RADIUS_VOXELS if radius_m is None else check_positive(radius_m, "radius_m", most) / snapshot.voxel_size_m
    slot, voxel, distance = np.empty(len(p), np.int64), np.empty(len(p), np.int64), np.empty(len(p))
    find_nearest_voxels(p, radius, snapshot.index, snapshot.voxels, slot, voxel, distance)
    label, confidence, _ = snapshot.read(slot, voxel)
    distance_m = (distance * snapshot.voxel_size_m).astype(np.float32)
    return PointAnswers(label, confidence, distance_m, read_states(p, snapshot), snapshot.measured(slot, voxel))


@kernel
def find_nearest_voxels(
    points: Float64,
    radius: float,
    index: BlockIndex,
    voxels: BlockVoxels,
    slots: Int64,
    chosen: Int64,
    distances: Float64,
) -> None:
    """Write slot (-1 = none) and voxel (N,) of the surface point nearest to points (N, 3) within a radius, and its
    distance (N,), all in units of voxels."""
    ...
