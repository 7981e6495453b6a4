"""Surface voxels of some classes, kept from one state of a map to the next where nothing near them has changed."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.storage.block_index import BlockIndex
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float64, Int32, Int64, UInt8

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
