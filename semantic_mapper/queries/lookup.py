"""What is at a point: class, confidence, state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import find_block, pack_key
from semantic_mapper.queries.checks import check_points, check_positive
from semantic_mapper.queries.occupancy import read_states
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import neighbour_slots, surface_offset
from semantic_mapper.types import Float32, UInt8

RADIUS_VOXELS = 2.5  # default: bridges half a voxel of rounding and a little noise, not the gap between two objects
MAX_RADIUS_VOXELS = 25.0  # work grows with its cube; ``nearest`` searches farther


@dataclass(frozen=True, slots=True, eq=False)
class PointAnswers:
    """What is at N points.

    Args:
        label: (N,) uint8 class ids of the nearest surface; the ignore id where none is near, or nothing voted there.
        confidence: (N,) float32 probability of ``label``, 0 at the ignore id.
        distance_m: (N,) float32 to that surface, infinite where none is near.
        state: (N,) uint8 ``State`` of the voxel that the point itself lies in.
    """

    label: UInt8
    confidence: Float32
    distance_m: Float32
    state: UInt8


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
    slot, voxel, distance = _nearest_voxels(p, radius, snapshot.index, snapshot.voxels)
    label, confidence, _ = snapshot.read(slot, voxel)
    places: NDArray[np.int64] = np.floor(p + 0.5).astype(np.int64)
    state = read_states(places, snapshot.index, snapshot.voxels, snapshot.voxels_per_step)
    return PointAnswers(label, confidence, (distance * snapshot.voxel_size_m).astype(np.float32), state)


@kernel()
def _nearest_voxels(points, radius, index, voxels):
    """Slot and voxel (N,) of the nearest surface point within ``radius`` (voxels), slot -1 = none; distances (N,)."""
    slots, chosen = np.full(len(points), -1, np.int64), np.zeros(len(points), np.int64)
    distances = np.full(len(points), np.inf)
    near, offset = np.empty(6, np.int64), np.empty(3)
    reach = radius + 0.5  # a surface point is at most half a voxel from its voxel's centre
    for n in range(len(points)):
        px, py, pz = points[n]
        best = radius * radius
        last_key, slot = np.int64(-1), np.int64(-1)
        for z in range(int(np.ceil(pz - reach)), int(np.floor(pz + reach)) + 1):
            for y in range(int(np.ceil(py - reach)), int(np.floor(py + reach)) + 1):
                for x in range(int(np.ceil(px - reach)), int(np.floor(px + reach)) + 1):
                    key = pack_key(x >> 3, y >> 3, z >> 3)
                    if key != last_key:
                        last_key, slot = key, find_block(index, key)
                        if slot >= 0:
                            neighbour_slots(x >> 3, y >> 3, z >> 3, index, near)
                    if slot < 0:
                        continue
                    voxel = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
                    if not surface_offset(slot, voxel, near, voxels, offset):
                        continue
                    d = (x + offset[0] - px) ** 2 + (y + offset[1] - py) ** 2 + (z + offset[2] - pz) ** 2
                    if d < best or (d == best and slots[n] < 0):
                        best = d
                        slots[n], chosen[n], distances[n] = slot, voxel, np.sqrt(d)
    return slots, chosen, distances
