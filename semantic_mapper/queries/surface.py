"""The surface: its voxels, each with one point of it, and what a ray meets.

A zero crossing of the TSDF on the edge between two observed voxels belongs to the nearer of the two (half way: to the
lower). The mean of a voxel's crossings is its surface point, which has class, confidence and colour of the voxel."""

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, BlockIndex
from semantic_mapper.mapping.floor_plan import Band, OccupancyGrid, find_up, occupancy_grid
from semantic_mapper.mapping.map_types import MapPoints, require_metres
from semantic_mapper.queries import checks
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float32, Float64, Int32, Int64, UInt8

READ_AT_ONCE = 1024  # blocks, for which there is room for the surface of each voxel
MAX_RANGE_M = 100.0  # beyond, a ray through nothing takes long


class SurfaceVoxels(NamedTuple):
    """N surface voxels, blocks in lexicographic order, voxels in the order [z][y][x]."""

    row: NDArray[np.int32]  # (N,) int32 position of the block in the snapshot's ``packed``
    voxel: NDArray[np.int32]  # (N,) int32 within the block
    point: Float64  # (N, 3) float64 surface point in units of voxels


def surface_voxels(snapshot: MapSnapshot, rows: NDArray[np.int64] | None = None) -> SurfaceVoxels:
    """Surface voxels of some blocks (ascending positions in ``packed``), by default of all."""
    rows = np.arange(snapshot.block_count) if rows is None else rows
    keys, slots, counts = snapshot.keys[rows], snapshot.slots[rows], np.empty(len(rows), np.int64)
    voxels, points = [np.empty(0, np.int32)], [np.empty((0, 3))]
    voxel, point = np.empty(BLOCK_VOXELS * READ_AT_ONCE, np.int32), np.empty((BLOCK_VOXELS * READ_AT_ONCE, 3))
    for start in range(0, len(rows), READ_AT_ONCE):
        part = slice(start, start + READ_AT_ONCE)
        blocks = keys[part], slots[part], snapshot.index, snapshot.voxels
        count = collect_surface_voxels(*blocks, counts[part], voxel, point)
        voxels.append(voxel[:count].copy())
        points.append(point[:count].copy())
    return SurfaceVoxels(np.repeat(rows, counts).astype(np.int32), np.concatenate(voxels), np.concatenate(points))


def surface_points(snapshot: MapSnapshot, surface: SurfaceVoxels) -> MapPoints:
    """Surface points with class, confidence and colour, in the order of ``surface``."""
    slots = snapshot.slots[surface.row].astype(np.int64)
    voxel = surface.voxel.astype(np.int64)
    label, confidence, rgb = snapshot.read(slots, voxel)
    xyz = (surface.point * snapshot.voxel_size_m).astype(np.float32)
    return MapPoints(xyz, rgb, label, confidence, snapshot.measured(slots, voxel))


def points_in_box(snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike) -> MapPoints:
    """Surface points in a box with corners (3,), world metres, one a voxel, in fixed order; ``MapError``: a bad box."""
    low, high = checks.check_box(lower, upper, snapshot)
    surface = surface_voxels(snapshot, checks.rows_in_box(snapshot, low, high))
    inside = ((surface.point >= low) & (surface.point <= high)).all(axis=1)
    return surface_points(snapshot, SurfaceVoxels(surface.row[inside], surface.voxel[inside], surface.point[inside]))


_ups: WeakKeyDictionary[MapSnapshot, Float64] = WeakKeyDictionary()


def up_in(snapshot: MapSnapshot) -> Float64:
    """Unit vector up (3,) in the world, found by the floor, once a snapshot. ``MapError`` as of ``find_up``."""
    if snapshot not in _ups:
        _ups[snapshot] = find_up(surface_points(snapshot, surface_voxels(snapshot)), snapshot.label_set)
    return _ups[snapshot]


def costmap(
    snapshot: MapSnapshot,
    radius_m: float,
    *,
    up: ArrayLike | None = None,
    height_m: Band | None = None,
    floor_m: float | None = None,
) -> OccupancyGrid:
    """Where the middle of a round robot of ``radius_m`` can be: the floor plan, inflated, without what moves.

    ``height_m``: LOW and HIGH above the floor, between which the robot hits surface, by default 0.1 and 1.8. ``up``,
    (3,) in the world, and ``floor_m``, the floor's height along it, are found by default. ``MapError``: a bad number;
    no metres; no floor, or nothing near it."""
    require_metres(snapshot.scale_known, "costmap")
    axis = up_in(snapshot) if up is None else checks.check_up(up)
    points = surface_points(snapshot, surface_voxels(snapshot))
    return occupancy_grid(points, axis, snapshot.voxel_size_m, height_m, floor_m).inflated(radius_m)


@kernel
def collect_surface_voxels(
    keys: Int32, slots: Int32, index: BlockIndex, voxels: BlockVoxels, counts: Int64, voxel: Int32, point: Float64
) -> int:
    """Write ``voxel`` (512 B,), ``point`` (512 B, 3) of ``SurfaceVoxels``, as many as it returns, ``counts`` (B,)."""
    ...


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """What N rays meet."""

    distance_m: Float32  # (N,) float32 along the ray, 0 where it meets no surface
    label: UInt8  # (N,) uint8 class ids, the ignore id at misses and where unknown
    confidence: Float32  # (N,) float32 probability of the likeliest class, 0 at misses and where nothing voted
    rgb: UInt8  # (N, 3) uint8
    measured: Bool | None = None  # (N,) bool, whether a sensor measured that surface; False at misses; None = unknown


def cast_rays(snapshot: MapSnapshot, origins: ArrayLike, directions: ArrayLike, max_m: float = 10.0) -> RayHits:
    """The first surface that each ray meets from its front, at most ``max_m`` away (up to 100). ``origins`` (world
    metres) and ``directions`` (of any length) are (N, 3) or (3,), which stands for all. ``MapError``: bad arguments, or
    shapes that do not go together."""
    checks.check_positive(max_m, "max_m", MAX_RANGE_M)
    origin = checks.check_points(np.atleast_2d(checks.as_numbers(origins, "origins")), snapshot, "origins")
    direction = checks.check_directions(directions, "directions")
    if len(origin) != len(direction) and 1 not in (len(origin), len(direction)):
        raise MapError(f"cast_rays: {len(origin)} origins and {len(direction)} directions do not go together")
    count = max(len(origin), len(direction)) if len(origin) and len(direction) else 0
    start = np.ascontiguousarray(np.broadcast_to(origin, (count, 3)))
    step = np.ascontiguousarray(np.broadcast_to(direction, (count, 3)) / snapshot.voxel_size_m)
    found = distance, slot, voxel = np.empty(count, np.float32), np.empty(count, np.int64), np.empty(count, np.int64)
    march_rays(start, step, snapshot.voxels_per_step, max_m, snapshot.index, snapshot.voxels, *found)
    label, confidence, rgb = snapshot.read(slot, voxel)
    return RayHits(distance, label, confidence, rgb, snapshot.measured(slot, voxel))


@kernel
def march_rays(
    origins: Float64,
    directions: Float64,
    voxels_per_step: float,
    max_m: float,
    index: BlockIndex,
    voxels: BlockVoxels,
    distance: Float32,
    slots: Int64,
    chosen: Int64,
) -> None:
    """Write distances (N,), 0 = miss, and slot and voxel (N,) of the observed voxel nearest to each hit, among the
    eight round it; of those with votes if any has some. Origins (N, 3) are in units of voxels, directions (N, 3) in
    voxels a unit of the distance, which ends at ``max_m``."""
    ...
