"""Surface voxels: the observed voxels that the surface passes, each with one point of it.

A zero crossing of the TSDF on the edge between two observed voxels belongs to the nearer of the two (half way: to the
lower). A voxel with crossings is a surface voxel; their mean is its surface point. So every surface point has the
class, confidence and colour of its own voxel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.storage.block_index import BlockIndex
from semantic_mapper.queries.checks import check_box, rows_in_box
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Float64, Int32, Int64

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
