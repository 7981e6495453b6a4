"""Pieces of surface that hang together: connected components of surface voxels of one class."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semantic_mapper.mapping.block_index import find_block, make_block_index, pack_key, unpack_keys
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.types import Float64, UInt8


class Components(NamedTuple):
    """N surface voxels in C components, ordered as in ``SurfaceVoxels``.

    Args:
        component: (N,) int64 0..C-1, numbered in the order of their first voxels.
        row: (N,) int32 position of the block in the snapshot's ``packed``.
        voxel: (N,) int32 within the block.
        point: (N, 3) float64 surface point in units of voxels.
        label: (N,) uint8 class ids.
    """

    component: NDArray[np.int64]
    row: NDArray[np.int32]
    voxel: NDArray[np.int32]
    point: Float64
    label: UInt8


def find_components(snapshot: MapSnapshot, class_ids: Collection[int], min_voxels: int) -> Components:
    """Components of the classes with these ids: surface voxels of one class that touch by face, edge or corner.

    Args:
        snapshot: The map.
        class_ids: Classes that are looked at.
        min_voxels: Components with fewer voxels are left out.
    """
    wanted = np.zeros(256, np.bool_)
    wanted[list(class_ids)] = True
    surface = surface_voxels(snapshot)
    label = snapshot.voxels.label[snapshot.slots[surface.row], surface.voxel]
    keep = wanted[label]
    row, voxel, point, label = surface.row[keep], surface.voxel[keep], surface.point[keep], label[keep]
    used, block = np.unique(row, return_inverse=True)
    keys = unpack_keys(snapshot.packed[used])
    node = np.full((len(used), 512), -1, np.int32)
    node[block, voxel] = np.arange(len(voxel), dtype=np.int32)
    index = make_block_index(keys, np.arange(len(used), dtype=np.int32))
    roots = _connect(keys, block, voxel, label, node, index)
    _, component, counts = np.unique(roots, return_inverse=True, return_counts=True)
    large = counts >= min_voxels
    keep = large[component]
    number = np.cumsum(large) - 1
    return Components(number[component[keep]], row[keep], voxel[keep], point[keep], label[keep])


@njit(nogil=True, cache=True, inline="always")
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(nogil=True, cache=True)
def _connect(keys, block, voxel, label, node, index):
    """Union-find over 26 neighbours: for each voxel (N,) the first voxel of its component."""
    parent = np.arange(len(voxel))
    for i in range(len(voxel)):
        key = keys[block[i]]
        x, y, z = key[0] * 8 + (voxel[i] & 7), key[1] * 8 + ((voxel[i] >> 3) & 7), key[2] * 8 + (voxel[i] >> 6)
        for step in range(13):  # the other half of the neighbours looks at this voxel itself
            nx, ny, nz = x + step % 3 - 1, y + (step // 3) % 3 - 1, z + step // 9 - 1
            at = find_block(index, pack_key(nx >> 3, ny >> 3, nz >> 3))
            if at < 0:
                continue
            j = node[at, ((nz & 7) << 6) | ((ny & 7) << 3) | (nx & 7)]
            if j < 0 or label[j] != label[i]:
                continue
            a, b = _root(parent, i), _root(parent, np.int64(j))
            parent[max(a, b)] = min(a, b)
    for i in range(len(voxel)):
        parent[i] = _root(parent, i)
    return parent
