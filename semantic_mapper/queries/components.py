"""Pieces of surface that hang together: connected components of surface voxels of one class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from semantic_mapper.mapping.storage.block_index import unpack_keys
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
    pairs = _touching_voxels(surface)
    edges = coo_array((np.ones(len(pairs), np.bool_), tuple(pairs.T)), shape=(len(surface.voxel),) * 2)
    _, piece = connected_components(edges, directed=False)
    _, first, piece, sizes = np.unique(piece, return_index=True, return_inverse=True, return_counts=True)
    large = np.flatnonzero(sizes >= min_voxels)
    large = large[np.argsort(first[large])]
    number = np.full(len(sizes), -1, np.int64)
    number[large] = np.arange(len(large))
    component = number[piece]
    kept = np.flatnonzero(component >= 0)
    # Numpy sorts integers of 16 bits, which nearly always suffice, much faster than longer ones.
    order = kept[np.argsort(component[kept].astype(np.min_scalar_type(len(large))), kind="stable")]
    return Components(component, order, np.cumsum(sizes[large]))


def _touching_voxels(surface: ClassSurface) -> NDArray[np.intp]:
    """Pairs (E, 2) of voxels of one class that touch, each pair once."""
    if not len(surface.voxel):
        return np.empty((0, 2), np.intp)
    voxel = surface.voxel
    blocks = unpack_keys(np.repeat(surface.packed, np.diff(surface.start)))
    places = 8.0 * blocks + np.stack((voxel & 7, (voxel >> 3) & 7, voxel >> 6), axis=1)
    tree = KDTree(places, compact_nodes=False, balanced_tree=False)
    pairs = tree.query_pairs(1.0, np.inf, output_type="ndarray")
    return pairs[surface.label[pairs[:, 0]] == surface.label[pairs[:, 1]]]
