"""What a ray meets: the map's own way of walking along rays (``march`` of ray_casting.h) on a snapshot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.blocks import BlockIndex
from semantic_mapper.queries.checks import (
    as_numbers,
    check_direction,
    check_points,
    check_positive,
)
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float32, Float64, Int64, UInt8

MAX_RANGE_M = 100.0  # beyond, a ray through nothing takes long


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """What N rays meet.

    Args:
        distance_m: (N,) float32 along the ray, 0 where it meets no surface.
        label: (N,) uint8 class ids, the ignore id at misses and where unknown.
        confidence: (N,) float32 probability of the likeliest class, 0 at misses and where nothing voted.
        rgb: (N, 3) uint8.
        measured: (N,) bool, whether a sensor measured that surface; False at misses; None = unknown.
    """

    distance_m: Float32
    label: UInt8
    confidence: Float32
    rgb: UInt8
    measured: Bool | None = None


def cast_rays(snapshot: MapSnapshot, origins: ArrayLike, directions: ArrayLike, max_m: float = 10.0) -> RayHits:
    """The first surface that each ray meets from its front.

    Args:
        snapshot: The map.
        origins: (N, 3) or (3,) world metres.
        directions: (N, 3) or (3,), of any length; one origin or direction stands for all.
        max_m: How far rays go, at most 100.

    Raises:
        MapError: see ``checks``; shapes that do not go together; a range out of bounds.
    """
    origin = check_points(np.atleast_2d(as_numbers(origins, "origins")), snapshot, "origins")
    direction = np.atleast_2d(check_direction(directions, "directions"))
    if len(origin) != len(direction) and 1 not in (len(origin), len(direction)):
        raise MapError(f"cast_rays: {len(origin)} origins and {len(direction)} directions do not go together")
    count = max(len(origin), len(direction)) if len(origin) and len(direction) else 0
    origin, direction = np.broadcast_to(origin, (count, 3)), np.broadcast_to(direction, (count, 3))
    if check_positive(max_m, "max_m") > MAX_RANGE_M:
        raise MapError(f"max_m must be at most {MAX_RANGE_M:g}, got {max_m}")
    step = np.ascontiguousarray(direction / snapshot.voxel_size_m)
    distance, slot, voxel = np.empty(count, np.float32), np.empty(count, np.int64), np.empty(count, np.int64)
    march_rays(
        np.ascontiguousarray(origin),
        step,
        snapshot.voxels_per_step,
        max_m,
        snapshot.index,
        snapshot.voxels,
        distance,
        slot,
        voxel,
    )
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
    """Write distances (N,), 0 = miss, and the observed voxel nearest to each place that was hit, among the eight round
    it; of those with votes if any has some.

    Args:
        origins: (N, 3) in units of voxels.
        directions: (N, 3) voxels a unit of the distance.
        voxels_per_step: Length of one step of the quantised TSDF.
        max_m: Where rays end, in units of the distance.
        index, voxels: Of the snapshot.
        distance, slots, chosen: (N,) written.
    """
    ...
