"""Pieces of surface that hang together: connected components of surface voxels of one class."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.queries.class_surface import ClassSurface
from semantic_mapper.types import Int32, Int64, UInt8


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
    count = len(surface.voxel)
    used = np.diff(surface.start) > 0
    node, first = np.full((int(used.sum()), 512), -1, np.int32), np.empty(count, np.int64)
    connect_voxels(surface.packed, surface.start, surface.voxel, surface.label, np.cumsum(used) - 1, node, first)
    return _kept(first, min_voxels)


def components_of(number: NDArray[np.int64], min_voxels: int) -> Components:
    """Surface voxels (N,) of the same number, whether they touch or not; -1 belongs to none."""
    _, index, inverse = np.unique(number, return_index=True, return_inverse=True)
    return _kept(index[inverse.reshape(-1)], min_voxels, number >= 0)


def _kept(first: NDArray[np.int64], min_voxels: int, wanted: NDArray[np.bool_] | None = None) -> Components:
    """The components that are large enough, given the first voxel (N,) of each voxel's; of ``wanted`` (N,) ones."""
    count = len(first)
    sizes = np.bincount(first, minlength=count)  # at the first voxel of each component
    if wanted is not None:
        sizes = sizes * wanted
    large = np.flatnonzero(sizes >= min_voxels)
    number = np.full(count, -1, np.int64)
    number[large] = np.arange(len(large))
    component = number[first]
    kept = np.flatnonzero(component >= 0)
    # Numpy sorts integers of 16 bits, which nearly always suffice, much faster than longer ones.
    order = kept[np.argsort(component[kept].astype(np.min_scalar_type(len(large))), kind="stable")]
    return Components(component, order, np.cumsum(sizes[large]))


@kernel
def connect_voxels(
    packed: Int64, start: Int64, voxel: Int32, label: UInt8, used: Int64, node: Int32, first: Int64
) -> None:
    """Write the first voxel of each voxel's component (N,): union-find over 26 neighbours.

    Args:
        packed, start, voxel, label: Of a ``ClassSurface``.
        used: (B,) number of each block among the U that have voxels.
        node: (U, 512) scratch, -1.
        first: (N,) written.
    """
    ...
