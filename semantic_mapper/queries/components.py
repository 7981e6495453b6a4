"""Pieces of surface that hang together: connected components of surface voxels of one class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import key_part, pack_key
from semantic_mapper.queries.class_surface import ClassSurface


class Components(NamedTuple):
    """C components of N surface voxels.

    Args:
        component: (N,) int64 0..C-1, numbered in the order of their first voxels; -1 = in a piece that is too small.
        order: (M,) int64 voxels of the first component, ascending, then those of the second, and so on.
        ends: (C,) int64 where in ``order`` each component ends.
    """

    component: NDArray[np.int64]
    order: NDArray[np.int64]
    ends: NDArray[np.int64]


def find_components(surface: ClassSurface, min_voxels: int) -> Components:
    """Surface voxels of one class that touch by face, edge or corner; pieces of fewer voxels are left out."""
    return Components(*_components(surface.packed, surface.start, surface.voxel, surface.label, min_voxels))


@kernel(inline=True)
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel()
def _find_rows(packed, start, row, near):
    """Rows (3, 3, 3) of the blocks round one that come before it in order and have voxels, -1 = none; and its own."""
    key = packed[row]
    x, y, z = key_part(key, 0), key_part(key, 1), key_part(key, 2)
    for i in range(14):
        dx, dy, dz = i // 9 - 1, i // 3 % 3 - 1, i % 3 - 1
        wanted = pack_key(x + dx, y + dy, z + dz)
        at = np.searchsorted(packed[: row + 1], wanted)
        found = at <= row and packed[at] == wanted and start[at + 1] > start[at]
        near[dx + 1, dy + 1, dz + 1] = at if found else -1


@kernel()
def _connect(packed, start, voxel, label):
    """Union-find over 26 neighbours: for each voxel (N,) the first voxel of its component."""
    parent = np.arange(len(voxel))
    used = np.cumsum(start[1:] > start[:-1]) - 1
    node = np.full(((used[-1] + 1) if len(used) else 0, 512), -1, np.int32)
    near = np.full((3, 3, 3), -1, np.int64)
    for row in range(len(packed)):
        if start[row + 1] == start[row]:
            continue
        _find_rows(packed, start, row, near)
        for i in range(start[row], start[row + 1]):
            node[used[row], voxel[i]] = i
        for i in range(start[row], start[row + 1]):
            x, y, z = voxel[i] & 7, (voxel[i] >> 3) & 7, voxel[i] >> 6
            for step in range(27):
                nx, ny, nz = x + step % 3 - 1, y + step // 3 % 3 - 1, z + step // 9 - 1
                at = near[(nx >> 3) + 1, (ny >> 3) + 1, (nz >> 3) + 1]
                if at < 0 or (at == row and step >= 13):  # that one looks at this voxel itself
                    continue
                j = node[used[at], ((nz & 7) << 6) | ((ny & 7) << 3) | (nx & 7)]
                if j >= 0 and label[j] == label[i]:
                    a, b = _root(parent, i), _root(parent, np.int64(j))
                    parent[max(a, b)] = min(a, b)
    for i in range(len(voxel)):
        parent[i] = _root(parent, i)
    return parent


@kernel()
def _components(packed, start, voxel, label, min_voxels):
    component = _connect(packed, start, voxel, label)
    sizes = np.zeros(len(voxel), np.int64)
    for i in range(len(voxel)):
        sizes[component[i]] += 1
    number = np.full(len(voxel), -1, np.int64)
    large = np.flatnonzero(sizes >= min_voxels)
    number[large] = np.arange(len(large))
    ends = np.cumsum(sizes[large])
    order = np.empty(sizes[large].sum(), np.int64)
    at = ends - sizes[large]
    for i in range(len(voxel)):
        c = number[component[i]]
        component[i] = c
        if c >= 0:
            order[at[c]] = i
            at[c] += 1
    return component, order, ends
