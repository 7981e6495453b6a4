"""Surface voxels of some classes, kept from one state of a map to the next where nothing near them has changed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import key_part
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import neighbour_slots, surface_offset
from semantic_mapper.types import Float64, UInt8

_ROOM = 1 << 14  # voxels that the first memory for new ones holds


class ClassSurface(NamedTuple):
    """N surface voxels in the B blocks of a map, ordered as in ``SurfaceVoxels``.

    Args:
        packed: (B,) int64 sorted keys.
        serials: (B,) int64 which content the blocks had.
        fresh: (B,) bool whether the block's voxels were computed anew, because it or a neighbour has changed.
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
    source = _find_sources(snapshot.packed, snapshot.serials, snapshot.index, row_of, before.packed, before.serials)
    return ClassSurface(
        snapshot.packed,
        snapshot.serials,
        source < 0,
        *_collect(snapshot.packed, snapshot.slots, source, snapshot.index, snapshot.voxels, wanted, before),
    )


def _nothing() -> ClassSurface:
    none, byte = np.empty(0, np.int64), np.empty(0, np.uint8)
    start, voxel = np.zeros(1, np.int64), np.empty(0, np.int32)
    return ClassSurface(none, none, np.empty(0, np.bool_), start, voxel, np.empty((0, 3)), byte, byte)


@kernel()
def _find_sources(packed, serials, index, row_of, old_packed, old_serials):
    """Row (B,) of each block in the earlier state, -1 where it or one of its six neighbours is not what it was."""
    source = np.full(len(packed), -1, np.int64)
    moved = np.empty(len(packed) + len(old_packed), np.int64)
    count, old = 0, 0
    for row in range(len(packed)):
        while old < len(old_packed) and old_packed[old] < packed[row]:  # gone
            moved[count] = old_packed[old]
            count, old = count + 1, old + 1
        if old < len(old_packed) and old_packed[old] == packed[row]:
            if old_serials[old] == serials[row]:
                source[row] = old
            old += 1
        if source[row] < 0:
            moved[count] = packed[row]
            count += 1
    moved[count : count + len(old_packed) - old] = old_packed[old:]
    count += len(old_packed) - old
    near = np.empty(6, np.int64)
    for key in moved[:count]:
        neighbour_slots(key_part(key, 0), key_part(key, 1), key_part(key, 2), index, near)
        for slot in near:
            if slot >= 0:
                source[row_of[slot]] = -1
    return source


@kernel()
def _collect(packed, slots, source, index, voxels, wanted, before):
    """``start``, ``voxel``, ``point``, ``label`` and ``confidence`` of a ``ClassSurface``."""
    start = np.zeros(len(packed) + 1, np.int64)
    room = len(before.voxel) + _ROOM
    voxel, point = np.empty(room, np.int32), np.empty((room, 3))
    label, confidence = np.empty(room, np.uint8), np.empty(room, np.uint8)
    near, offset = np.empty(6, np.int64), np.empty(3)
    at = 0
    for row in range(len(packed)):
        if at + 512 > room:
            room *= 2
            voxel, point = _grown(voxel, room), _grown(point, room)
            label, confidence = _grown(label, room), _grown(confidence, room)
        if source[row] >= 0:
            a, b = before.start[source[row]], before.start[source[row] + 1]
            end = at + b - a
            voxel[at:end], point[at:end] = before.voxel[a:b], before.point[a:b]
            label[at:end], confidence[at:end] = before.label[a:b], before.confidence[a:b]
            at = end
        else:
            slot, key = np.int64(slots[row]), packed[row]
            x, y, z = key_part(key, 0), key_part(key, 1), key_part(key, 2)
            neighbour_slots(x, y, z, index, near)
            for v in range(512):
                c = voxels.label[slot, v]
                if wanted[c] and surface_offset(slot, v, near, voxels, offset):
                    voxel[at], label[at], confidence[at] = v, c, voxels.confidence[slot, v]
                    point[at, 0] = x * 8 + (v & 7) + offset[0]
                    point[at, 1] = y * 8 + ((v >> 3) & 7) + offset[1]
                    point[at, 2] = z * 8 + (v >> 6) + offset[2]
                    at += 1
        start[row + 1] = at
    return start, voxel[:at].copy(), point[:at].copy(), label[:at].copy(), confidence[:at].copy()


@kernel()
def _grown(values: Any, room: int) -> Any:
    more = np.empty((room, *values.shape[1:]), values.dtype)
    more[: len(values)] = values
    return more
