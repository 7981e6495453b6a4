"""What is at a point: class, confidence, state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.storage.block_index import BlockIndex
from semantic_mapper.queries.checks import check_points, check_positive
from semantic_mapper.queries.occupancy import read_states
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Bool, Float32, Float64, Int64, UInt8

RADIUS_VOXELS = 2.5  # default: bridges half a voxel of rounding and a little noise, not the gap between two objects
MAX_RADIUS_VOXELS = 25.0  # work grows with its cube; ``nearest`` searches farther


@dataclass(frozen=True, slots=True, eq=False)
class PointAnswers:
    """What is at N points.

    Args:
        label: (N,) uint8 class ids of the nearest surface; the ignore id where none is near or it is unknown.
        confidence: (N,) float32 probability of the likeliest class, 0 where none is near or nothing voted.
        distance_m: (N,) float32 to that surface, infinite where none is near.
        state: (N,) uint8 ``State`` of the voxel that the point itself lies in.
        measured: (N,) bool, whether a sensor measured that surface; False where none is near; None = unknown.
    """

    label: UInt8
    confidence: Float32
    distance_m: Float32
    state: UInt8
    measured: Bool | None = None


def at(snapshot: MapSnapshot, points: ArrayLike, radius_m: float | None = None) -> PointAnswers:
    """Class and confidence of the surface at points, and whether these are free, occupied or unknown.

    The class is that of the surface voxel whose surface point is nearest, where that is at most ``radius_m`` away.

    Args:
        snapshot: The map.
        points: (N, 3) world metres.
        radius_m: How far to look; by default 2.5 voxels, at most 25.

    Raises:
        MapError: see ``checks.check_points``; or a radius out of range.
    """
    p = check_points(points, snapshot)
    radius = RADIUS_VOXELS
    if radius_m is not None:
        radius = check_positive(radius_m, "radius_m") / snapshot.voxel_size_m
    if radius > MAX_RADIUS_VOXELS:
        most = MAX_RADIUS_VOXELS * snapshot.voxel_size_m
        raise MapError(f"at: radius_m must be at most {most:g} in this map, got {radius_m}; `nearest` searches farther")
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
    """Write slot (-1 = none) and voxel (N,) of the surface point nearest to points (N, 3), and its distance (N,).

    All in units of voxels; surface points beyond ``radius`` do not count.
    """
    ...
