"""Which thing each voxel of a refined map belongs to: a table beside the blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_BITS, _HALF = 21, 1 << 20  # of a packed coordinate: blocks lie within +-2^17 (``block_index.KEY_LIMIT``)


@dataclass(frozen=True, slots=True, eq=False)
class InstanceLayer:
    """Voxels that belong to things; others belong to none.

    Args:
        packed: (N,) int64 ascending, of ``pack_voxels``.
        number: (N,) int32 from 0, the same for all voxels of a thing; those of a thing have one class.
    """

    packed: NDArray[np.int64]
    number: NDArray[np.int32]

    def at(self, voxels: NDArray[np.integer]) -> NDArray[np.int64]:
        """The things (M,) that voxels (M, 3) belong to; -1 = none."""
        wanted = pack_voxels(voxels)
        if not len(self.packed):
            return np.full(len(wanted), -1, np.int64)
        row = np.minimum(np.searchsorted(self.packed, wanted), len(self.packed) - 1)
        return np.where(self.packed[row] == wanted, self.number[row], -1).astype(np.int64)

    @property
    def is_sound(self) -> bool:
        """Whether voxels ascend, and things count from 0."""
        return bool((np.diff(self.packed) > 0).all()) and int(self.number.min(initial=0)) >= 0


def instance_layer(voxels: NDArray[np.integer], number: NDArray[np.integer]) -> InstanceLayer:
    """Of unique voxels (N, 3) and the things (N,) they belong to; -1 = none."""
    kept = number >= 0
    packed = pack_voxels(voxels[kept])
    order = np.argsort(packed)
    return InstanceLayer(packed[order], number[kept][order].astype(np.int32))


def pack_voxels(voxels: NDArray[np.integer]) -> NDArray[np.int64]:
    """Keys (N,) of voxel coordinates (N, 3) within +-2^20."""
    shifted = voxels.astype(np.int64) + _HALF
    return (shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2]
