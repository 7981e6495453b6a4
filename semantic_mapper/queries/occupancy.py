"""What is free, occupied, unknown or has something that moves: points, and the voxels of a box with their distances."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import scipy  # loads `ndimage` when it is first used
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.blocks import BlockIndex
from semantic_mapper.queries.checks import check_box, check_points
from semantic_mapper.queries.snapshot import BlockVoxels, MapSnapshot
from semantic_mapper.types import Float32, Float64, Int64, UInt8

MAX_BOX_VOXELS = 1 << 24  # 134 m^3 at 2 cm; about 0.5 GB while the distances are computed


class State(IntEnum):
    """What is known of a voxel.

    Occupied: the surface is at most half a voxel in front of it, or up to the truncation. Unknown is also the air far
    from any surface, where the map keeps no blocks. Moving: something that moves, and is left out of the map, was there
    within the last second."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2
    MOVING = 3


@dataclass(frozen=True, slots=True, eq=False)
class DistanceField:
    """Distances on the voxel grid of a box."""

    origin_m: Float64  # (3,) float64 centre of voxel [0, 0, 0] in the world
    voxel_size_m: float  # step along each axis
    # (X, Y, Z) float32 from voxel centre to the centre of the nearest occupied or moving voxel, 0 in those, infinite
    # where the box holds none
    distance_m: Float32
    state: UInt8  # (X, Y, Z) uint8 ``State``


def occupancy(snapshot: MapSnapshot, points: ArrayLike) -> UInt8:
    """``State`` (N,) of the voxels in which points (N, 3), world metres, lie; MapError for bad ones."""
    return read_states(check_points(points, snapshot), snapshot)


def distance_field(
    snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike, *, unknown_is_occupied: bool = False
) -> DistanceField:
    """Euclidean distance to the nearest occupied or moving voxel for every voxel with its centre in a box with corners
    (3,), world metres; only voxels in the box count as obstacles, what was never seen where ``unknown_is_occupied``.
    ``MapError``: a bad box, or no voxel or more than ``MAX_BOX_VOXELS`` in it."""
    low, high = check_box(lower, upper, snapshot)
    first = np.ceil(low - 1e-6).astype(np.int64)  # 1e-6 voxels: corners that were meant to be voxel centres
    shape = np.floor(high + 1e-6).astype(np.int64) - first + 1
    count = float(np.prod(np.maximum(shape, 0).astype(np.float64)))
    if not 0 < count <= MAX_BOX_VOXELS:
        raise MapError(
            f"distance_field: the box holds {' x '.join(map(str, shape))} voxels of {snapshot.voxel_size_m} m, "
            f"allowed are 1 to {MAX_BOX_VOXELS}; take a {'smaller' if count else 'larger'} box"
        )
    state = np.empty(tuple(shape), np.uint8)
    fill_box_states(first, snapshot.index, snapshot.voxels, snapshot.voxels_per_step, state)
    moving = snapshot.moving - first
    state[tuple(moving[((moving >= 0) & (moving < shape)).all(axis=1)].T)] = State.MOVING
    obstacle = (state >= State.OCCUPIED) | ((state == State.UNKNOWN) & unknown_is_occupied)
    distance = np.full(state.shape, np.inf)
    if obstacle.any():
        distance = scipy.ndimage.distance_transform_edt(~obstacle, sampling=snapshot.voxel_size_m)
    return DistanceField(
        first.astype(np.float64) * snapshot.voxel_size_m, snapshot.voxel_size_m, np.asarray(distance, np.float32), state
    )


def read_states(points: Float64, snapshot: MapSnapshot) -> UInt8:
    """``State`` (N,) of the voxels in which points (N, 3), units of voxels, lie."""
    places, states = np.floor(points + 0.5).astype(np.int64), np.empty(len(points), np.uint8)
    read_voxel_states(places, snapshot.index, snapshot.voxels, snapshot.voxels_per_step, states)
    if len(snapshot.moving):
        first, last = snapshot.moving.min(axis=0), snapshot.moving.max(axis=0)
        near = np.flatnonzero(((places >= first) & (places <= last)).all(axis=1))
        shape = tuple((last - first + 1).tolist())
        here, there = (np.ravel_multi_index(tuple((v - first).T), shape) for v in (places[near], snapshot.moving))
        states[near[np.isin(here, there)]] = State.MOVING
    return states


@kernel
def read_voxel_states(
    places: Int64, index: BlockIndex, voxels: BlockVoxels, voxels_per_step: float, states: UInt8
) -> None:
    """Write ``State`` (N,) of voxels with coordinates (N, 3)."""
    ...


@kernel
def fill_box_states(
    first: Int64, index: BlockIndex, voxels: BlockVoxels, voxels_per_step: float, states: UInt8
) -> None:
    """Write ``State`` of all voxels (X, Y, Z) from ``first`` (3,) on."""
    ...
