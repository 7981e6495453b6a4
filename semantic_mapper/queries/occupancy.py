"""Free, occupied or unknown: at points, and as distances to obstacles on the voxels of a box."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from semantic_mapper.errors import MapError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import find_block, pack_key
from semantic_mapper.queries.checks import check_box, check_points
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float32, Float64, UInt8

MAX_BOX_VOXELS = 1 << 24  # 134 m^3 at 2 cm; about 0.5 GB while the distances are computed


class State(IntEnum):
    """What is known of a voxel.

    Occupied: the surface is at most half a voxel in front of it, or it lies behind a surface, up to the truncation.
    Unknown is also the air that cameras looked through far from any surface: the map keeps no blocks there.
    """

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


@dataclass(frozen=True, slots=True, eq=False)
class DistanceField:
    """Distances on the voxel grid of a box.

    Args:
        origin_m: (3,) float64 centre of voxel [0, 0, 0] in the world.
        voxel_size_m: Step along each axis.
        distance_m: (X, Y, Z) float32 from voxel centre to the centre of the nearest occupied voxel, 0 in those,
            infinite where the box holds none.
        state: (X, Y, Z) uint8 ``State``.
    """

    origin_m: Float64
    voxel_size_m: float
    distance_m: Float32
    state: UInt8


def occupancy(snapshot: MapSnapshot, points: ArrayLike) -> UInt8:
    """``State`` (N,) of the voxels in which points (N, 3), world metres, lie.

    Raises:
        MapError: see ``checks.check_points``.
    """
    p = check_points(points, snapshot)
    return read_states(np.floor(p + 0.5).astype(np.int64), snapshot.index, snapshot.voxels, snapshot.voxels_per_step)


def distance_field(
    snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike, *, unknown_is_occupied: bool = False
) -> DistanceField:
    """Euclidean distance to the nearest occupied voxel for every voxel with its centre in a box.

    Only voxels in the box count as obstacles: give the box a margin of the distance that matters.

    Args:
        snapshot: The map.
        lower, upper: (3,) corners, world metres.
        unknown_is_occupied: Whether what was never seen is an obstacle, too.

    Raises:
        MapError: see ``checks.check_box``; no voxel or more than ``MAX_BOX_VOXELS`` in it.
    """
    low, high = check_box(lower, upper, snapshot)
    first = np.ceil(low - 1e-6).astype(np.int64)  # 1e-6 voxels: corners that were meant to be voxel centres
    shape = np.floor(high + 1e-6).astype(np.int64) - first + 1
    count = float(np.prod(np.maximum(shape, 0).astype(np.float64)))
    if not 0 < count <= MAX_BOX_VOXELS:
        raise MapError(
            f"distance_field: the box holds {' x '.join(map(str, shape))} voxels of {snapshot.voxel_size_m} m, "
            f"allowed are 1 to {MAX_BOX_VOXELS}; take a {'smaller' if count else 'larger'} box"
        )
    state = np.zeros(tuple(shape), np.uint8)
    _fill_box(first, state, snapshot.index, snapshot.voxels, snapshot.voxels_per_step)
    obstacle = (state == State.OCCUPIED) | ((state == State.UNKNOWN) & unknown_is_occupied)
    if obstacle.any():
        distance = ndimage.distance_transform_edt(~obstacle, sampling=snapshot.voxel_size_m)
    else:
        distance = np.full(state.shape, np.inf)
    origin = first.astype(np.float64) * snapshot.voxel_size_m
    return DistanceField(origin, snapshot.voxel_size_m, np.asarray(distance, np.float32), state)


@kernel(inline=True)
def _state(slot, x, y, z, voxels, voxels_per_step):
    """``State`` of voxel (x, y, z), which lies in block ``slot``."""
    voxel = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
    if not voxels.weight[slot, voxel]:
        return 0
    return 2 if voxels.tsdf[slot, voxel] * voxels_per_step <= 0.5 else 1


@kernel()
def read_states(places, index, voxels, voxels_per_step):
    """``State`` (N,) uint8 of voxels with integer coordinates (N, 3)."""
    states = np.zeros(len(places), np.uint8)
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        slot = find_block(index, pack_key(x >> 3, y >> 3, z >> 3))
        if slot >= 0:
            states[n] = _state(slot, x, y, z, voxels, voxels_per_step)
    return states


@kernel()
def _fill_box(first, states, index, voxels, voxels_per_step):
    """Write ``State`` of all voxels (X, Y, Z) from ``first`` (3,) on; what is unknown stays as it is."""
    for i in range(states.shape[0]):
        for j in range(states.shape[1]):
            x, y = first[0] + i, first[1] + j
            last, slot = np.int64(0), np.int64(-1)
            for k in range(states.shape[2]):
                z = first[2] + k
                if k == 0 or z >> 3 != last:
                    last, slot = z >> 3, find_block(index, pack_key(x >> 3, y >> 3, z >> 3))
                if slot >= 0:
                    states[i, j, k] = _state(slot, x, y, z, voxels, voxels_per_step)
