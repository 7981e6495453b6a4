"""Which voxels are one thing: those that touch, have one class, and of which the network says the same centre.

Inside of a thing the centres that its voxels point to are near each other, or drift slowly; where two things touch,
they jump. So neighbours are joined where their centres agree. Pieces that are too small to be things, as along such a
border, go to the neighbouring piece with the nearest centre.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.instance_layer import pack_voxels
from semantic_mapper.memory import check_room_for_scipy
from semantic_mapper.types import Float32, Float64

AGREE_M = 0.09  # centres of neighbours that are farther apart belong to two things
LEAST_VOXELS = 60  # of a piece that stands for itself where it touches others of its class
_ROUNDS = 50
_HALF_SPHERE = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)]) - 1  # 13 of 26 neighbours


def group_things(
    voxels: NDArray[np.int64], channel: NDArray[np.int64], way_m: Float32, voxel_m: float
) -> NDArray[np.int64]:
    """The thing (N,) that each voxel belongs to, numbered from 0.

    Args:
        voxels: (N, 3) unique coordinates.
        channel: (N,) class of each.
        way_m: (N, 3) from each to the centre of its thing, along the axes of ``voxels``.
        voxel_m: Edge of a voxel.
    """
    if not len(voxels):
        return np.zeros(0, np.int64)
    first, second = _neighbours(voxels)
    same = channel[first] == channel[second]
    first, second = first[same], second[same]
    centre = voxels.astype(np.float64) * voxel_m + way_m.astype(np.float64)
    agree = np.linalg.norm(centre[first] - centre[second], axis=1) < AGREE_M
    piece = _components(len(voxels), first[agree], second[agree])
    return _join_small_pieces(piece, first, second, centre)


def _join_small_pieces(
    piece: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64], centre: Float64
) -> NDArray[np.int64]:
    """Pieces (N,); small ones that touch large ones, by the pairs ``first``, ``second``, are part of them now."""
    size = np.bincount(piece)
    middle = np.stack([np.bincount(piece, centre[:, axis]) for axis in range(3)], axis=1) / size[:, None]
    large = size >= LEAST_VOXELS
    for _ in range(_ROUNDS):
        a, b = piece[first], piece[second]
        touching = np.concatenate(
            (np.stack((a, b), axis=1)[~large[a] & large[b]], np.stack((b, a), axis=1)[~large[b] & large[a]])
        )
        if not len(touching):
            break
        touching = np.unique(touching, axis=0)
        apart = np.linalg.norm(middle[touching[:, 0]] - middle[touching[:, 1]], axis=1)
        touching = touching[np.lexsort((apart, touching[:, 0]))]
        small, row = np.unique(touching[:, 0], return_index=True)
        becomes = np.arange(len(size))
        becomes[small] = touching[row, 1]
        piece = becomes[piece]
    return np.unique(piece, return_inverse=True)[1].reshape(-1)


def _neighbours(voxels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of voxels that touch by face, edge or corner."""
    keys = pack_voxels(voxels)
    order = np.argsort(keys)
    keys = keys[order]
    first: list[NDArray[np.int64]] = []
    second: list[NDArray[np.int64]] = []
    for step in _HALF_SPHERE:
        wanted = pack_voxels(voxels + step)
        row = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        there = np.flatnonzero(keys[row] == wanted)
        first.append(there)
        second.append(order[row[there]])
    return np.concatenate(first), np.concatenate(second)


def _components(count: int, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    check_room_for_scipy()
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)
