"""Surface voxels: the observed voxels that the surface passes, each with one point of it.

A zero crossing of the TSDF on the edge between two observed voxels belongs to the nearer of the two (half way: to the
lower). A voxel with crossings is a surface voxel; their mean is its surface point. So every surface point has the
class, confidence and colour of its own voxel.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.blocks import BlockIndex
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.queries.checks import check_box, rows_in_box
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float64, Int32, Int64, UInt8

NEAREST_STEPS = 60  # farther from zero, a voxel is the nearer end of no crossing; as in surface.h


class SurfaceVoxels(NamedTuple):
    """N surface voxels, blocks in lexicographic order, voxels in the order [z][y][x].

    Args:
        row: (N,) int32 position of the block in the snapshot's ``packed``.
        voxel: (N,) int32 within the block.
        point: (N, 3) float64 surface point in units of voxels.
    """

    row: NDArray[np.int32]
    voxel: NDArray[np.int32]
    point: Float64


def surface_voxels(snapshot: MapSnapshot, rows: NDArray[np.int64] | None = None) -> SurfaceVoxels:
    """Surface voxels of some blocks (ascending positions in ``packed``), by default of all."""
    rows = np.arange(snapshot.block_count) if rows is None else rows
    keys, slots = snapshot.keys[rows], snapshot.slots[rows]
    counts = np.empty(len(rows), np.int64)
    count_surface_voxels(keys, slots, snapshot.index, snapshot.voxels, counts)
    total = int(counts.sum())
    voxel, point = np.empty(total, np.int32), np.empty((total, 3), np.float64)
    collect_surface_voxels(keys, slots, counts, snapshot.index, snapshot.voxels, voxel, point)
    return SurfaceVoxels(np.repeat(rows, counts).astype(np.int32), voxel, point)


def surface_points(snapshot: MapSnapshot, surface: SurfaceVoxels) -> MapPoints:
    """Surface points with class, confidence and colour, in the order of ``surface``."""
    slots = snapshot.slots[surface.row].astype(np.int64)
    voxel = surface.voxel.astype(np.int64)
    label, confidence, rgb = snapshot.read(slots, voxel)
    xyz = (surface.point * snapshot.voxel_size_m).astype(np.float32)
    return MapPoints(xyz, rgb, label, confidence, snapshot.measured(slots, voxel))


def points_in_box(snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike) -> MapPoints:
    """Surface points in a box, one a surface voxel, in a fixed order.

    Args:
        snapshot: The map.
        lower, upper: (3,) corners, world metres.

    Raises:
        MapError: see ``checks.check_box``.
    """
    low, high = check_box(lower, upper, snapshot)
    surface = surface_voxels(snapshot, rows_in_box(snapshot, low, high))
    inside = ((surface.point >= low) & (surface.point <= high)).all(axis=1)
    return surface_points(snapshot, SurfaceVoxels(surface.row[inside], surface.voxel[inside], surface.point[inside]))


@kernel
def count_surface_voxels(keys: Int32, slots: Int32, index: BlockIndex, voxels: BlockVoxels, counts: Int64) -> None:
    """Write the number of surface voxels (B,) of blocks with keys (B, 3)."""
    ...


@kernel
def collect_surface_voxels(
    keys: Int32, slots: Int32, counts: Int64, index: BlockIndex, voxels: BlockVoxels, voxel: Int32, point: Float64
) -> None:
    """Write ``voxel`` (N,) and ``point`` (N, 3) of ``SurfaceVoxels``, of which each block has ``counts`` (B,)."""
    ...


ScalarT = TypeVar("ScalarT", bound=np.generic)

_ROOM = 1 << 14  # voxels that the first memory for new ones holds


class ClassSurface(NamedTuple):
    """N surface voxels in the B blocks of a map, ordered as in ``SurfaceVoxels``.

    Args:
        packed: (B,) int64 sorted keys.
        serials: (B,) int64 which content the blocks had.
        fresh: (B,) bool whether the block's voxels were computed again, because it or a neighbour has changed.
        start: (B + 1,) int64; block b has the voxels ``start[b] .. start[b + 1] - 1``.
        voxel: (N,) int32 within the block, ascending in each.
        point: (N, 3) float64 surface point in units of voxels.
        label: (N,) uint8 class ids.
        confidence: (N,) uint8 probability of ``label``, times 255.
    """

    packed: NDArray[np.int64]
    serials: NDArray[np.int64]
    fresh: NDArray[np.bool_]
    start: NDArray[np.int64]
    voxel: NDArray[np.int32]
    point: Float64
    label: UInt8
    confidence: UInt8


def class_surface(snapshot: MapSnapshot, wanted: NDArray[np.bool_], before: ClassSurface | None = None) -> ClassSurface:
    """The surface voxels of some classes.

    Args:
        snapshot: The map.
        wanted: (256,) which class ids.
        before: The same for an earlier state of any map; saves time, and changes nothing but ``fresh``.
    """
    before = before or _nothing()
    row_of = np.empty(len(snapshot.voxels.tsdf), np.int32)
    row_of[snapshot.slots] = np.arange(snapshot.block_count, dtype=np.int32)
    source = np.empty(snapshot.block_count, np.int64)
    changed = np.empty(snapshot.block_count + len(before.packed), np.int64)
    packed, serials = snapshot.packed, snapshot.serials
    find_block_sources(packed, serials, snapshot.index, row_of, before.packed, before.serials, changed, source)
    return ClassSurface(packed, serials, source < 0, *_collect(snapshot, source, np.ascontiguousarray(wanted), before))


def _nothing() -> ClassSurface:
    none, byte = np.empty(0, np.int64), np.empty(0, np.uint8)
    start, voxel = np.zeros(1, np.int64), np.empty(0, np.int32)
    return ClassSurface(none, none, np.empty(0, np.bool_), start, voxel, np.empty((0, 3)), byte, byte)


def _collect(
    snapshot: MapSnapshot, source: Int64, wanted: Bool, before: ClassSurface
) -> tuple[Int64, Int32, Float64, UInt8, UInt8]:
    """``start``, ``voxel``, ``point``, ``label`` and ``confidence`` of a ``ClassSurface``."""
    start, room = np.zeros(snapshot.block_count + 1, np.int64), len(before.voxel) + _ROOM
    voxel, point = np.empty(room, np.int32), np.empty((room, 3))
    label, confidence = np.empty(room, np.uint8), np.empty(room, np.uint8)
    blocks, row = (snapshot.packed, snapshot.slots, source, snapshot.index, snapshot.voxels), 0
    while True:
        row = collect_class_surface(*blocks, wanted, before, row, start, voxel, point, label, confidence)
        count = int(start[row])
        if row == snapshot.block_count:
            return start, voxel[:count].copy(), point[:count].copy(), label[:count].copy(), confidence[:count].copy()
        room *= 2
        voxel, point = _enlarge(voxel, room, count), _enlarge(point, room, count)
        label, confidence = _enlarge(label, room, count), _enlarge(confidence, room, count)


def _enlarge(values: NDArray[ScalarT], room: int, count: int) -> NDArray[ScalarT]:
    """An array of ``room`` rows with the first ``count`` of ``values``."""
    larger = np.empty((room, *values.shape[1:]), values.dtype)
    larger[:count] = values[:count]
    return larger


@kernel
def find_block_sources(
    packed: Int64,
    serials: Int64,
    index: BlockIndex,
    row_of: Int32,
    old_packed: Int64,
    old_serials: Int64,
    changed: Int64,
    source: Int64,
) -> None:
    """Write the row (B,) of each block in an earlier state, -1 where it or one of its six neighbours has changed.

    Args:
        packed, serials, index: Of the B blocks.
        row_of: (S,) row of the block that lies in each slot.
        old_packed, old_serials: (A,) of the earlier state.
        changed: (A + B,) scratch.
        source: (B,) written.
    """
    ...


@kernel
def collect_class_surface(
    packed: Int64,
    slots: Int32,
    source: Int64,
    index: BlockIndex,
    voxels: BlockVoxels,
    wanted: Bool,
    before: ClassSurface,
    first_row: int,
    start: Int64,
    voxel: Int32,
    point: Float64,
    label: UInt8,
    confidence: UInt8,
) -> int:
    """Write the arrays of a ``ClassSurface`` from a row on, as far as there is room; returns the row it came to."""
    ...
