"""Surface voxels: the observed voxels that the surface passes, each with one point of it.

A zero crossing of the TSDF on the edge between two observed voxels belongs to the nearer of the two (half way: to the
lower). A voxel with crossings is a surface voxel; their mean is its surface point. So every surface point has the
class, confidence and colour of its own voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import find_block, pack_key
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64

_LARGEST_STEPS = 120  # two neighbours that differ by more straddle a depth edge (0.95 of the truncation, as in extract)
NEAREST_STEPS = 60  # half of it: farther from zero, a voxel is the nearer end of no crossing


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
    counts = _count(keys, slots, snapshot.index, snapshot.voxels)
    total = int(counts.sum())
    voxel, point = np.empty(total, np.int32), np.empty((total, 3), np.float64)
    _collect(keys, slots, counts, snapshot.index, snapshot.voxels, voxel, point)
    return SurfaceVoxels(np.repeat(rows, counts).astype(np.int32), voxel, point)


def surface_points(snapshot: MapSnapshot, surface: SurfaceVoxels) -> MapPoints:
    """Surface points with class, confidence and colour, in the order of ``surface``."""
    slots = snapshot.slots[surface.row].astype(np.int64)
    label, confidence, rgb = snapshot.read(slots, surface.voxel.astype(np.int64))
    return MapPoints((surface.point * snapshot.voxel_size_m).astype(np.float32), rgb, label, confidence)


@kernel()
def neighbour_slots(x, y, z, index, near):
    """Slots of the blocks at -x, +x, -y, +y, -z, +z of block (x, y, z), -1 where there is none."""
    near[0], near[1] = find_block(index, pack_key(x - 1, y, z)), find_block(index, pack_key(x + 1, y, z))
    near[2], near[3] = find_block(index, pack_key(x, y - 1, z)), find_block(index, pack_key(x, y + 1, z))
    near[4], near[5] = find_block(index, pack_key(x, y, z - 1)), find_block(index, pack_key(x, y, z + 1))


@kernel(inline=True)
def may_be_surface(slot, voxel, voxels):
    """Whether a voxel is observed and near enough to the surface to ask ``surface_offset``, which costs much more."""
    return voxels.weight[slot, voxel] != 0 and abs(np.int64(voxels.tsdf[slot, voxel])) <= NEAREST_STEPS


@kernel(inline=True)
def surface_offset(slot, voxel, near, voxels, offset):
    """Whether a voxel is one of the surface; ``offset`` (3,) then leads from its centre to its surface point.

    Args:
        slot, voxel: The voxel.
        near: (6,) of ``neighbour_slots``.
        voxels: ``BlockVoxels``.
        offset: (3,) float64, written; in units of voxels.
    """
    if not may_be_surface(slot, voxel, voxels):
        return False
    a = np.int64(voxels.tsdf[slot, voxel])
    offset[:] = 0
    crossings = 0
    for face in range(6):
        shift, upper = 3 * (face >> 1), face & 1
        position, step = (voxel >> shift) & 7, (1 << shift) if upper else -(1 << shift)
        inside = position < 7 if upper else position > 0
        block = slot if inside else near[face]
        other = voxel + step if inside else voxel - 7 * step
        if block < 0 or voxels.weight[block, other] == 0:
            continue
        b = np.int64(voxels.tsdf[block, other])
        if (a > 0) == (b > 0) or abs(a - b) > _LARGEST_STEPS:
            continue
        along = a / (a - b)
        if along < 0.5 or (along == 0.5 and upper):
            offset[face >> 1] += along if upper else -along
            crossings += 1
    if crossings:
        offset /= crossings
    return crossings > 0


@kernel()
def _count(keys, slots, index, voxels):
    counts = np.zeros(len(keys), np.int64)
    near, offset = np.empty(6, np.int64), np.empty(3)
    for n in range(len(keys)):
        neighbour_slots(keys[n, 0], keys[n, 1], keys[n, 2], index, near)
        for v in range(512):
            if may_be_surface(slots[n], v, voxels):
                counts[n] += surface_offset(slots[n], v, near, voxels, offset)
    return counts


@kernel()
def _collect(keys, slots, counts, index, voxels, voxel, point):
    near, offset = np.empty(6, np.int64), np.empty(3)
    at = 0
    for n in range(len(keys)):
        if counts[n] == 0:
            continue
        neighbour_slots(keys[n, 0], keys[n, 1], keys[n, 2], index, near)
        for v in range(512):
            if may_be_surface(slots[n], v, voxels) and surface_offset(slots[n], v, near, voxels, offset):
                voxel[at] = v
                point[at, 0] = keys[n, 0] * 8 + (v & 7) + offset[0]
                point[at, 1] = keys[n, 1] * 8 + ((v >> 3) & 7) + offset[1]
                point[at, 2] = keys[n, 2] * 8 + (v >> 6) + offset[2]
                at += 1
