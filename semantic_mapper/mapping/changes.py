"""What changed in a map since a version, small enough to be sent: 3.1 KB a block instead of 12 KB and 2 KB a class.

The TSDF is rounded to 1/127 of the truncation (0.6 mm at 2 cm voxels) without ever changing its sign, so that the
surface stays between the same voxels. Class evidence is decided where it lies (``readout.decide``): one class and its
probability a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import ATTRIBUTES, BLOCK_VOXELS, BlockGrid
from semantic_mapper.mapping.block_index import find_blocks, unpack_keys
from semantic_mapper.mapping.block_store import BlockValues
from semantic_mapper.mapping.readout import decide
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import UInt8

TSDF_STEPS = 127  # of the quantised TSDF, a truncation
UNOBSERVED = -128  # in the quantised TSDF
CONFIDENCE_STEPS = 255
_READ_AT_ONCE = 512  # blocks on disk, whose evidence takes much room


@dataclass(frozen=True, slots=True, eq=False)
class BlockChanges:
    """Blocks of a map that changed after one version, as they are now; voxels in the order [z][y][x].

    Args:
        since: Who has all up to this version
        version: has, with these blocks, all up to this one.
        epoch: Of the map. Where it is another than before, these are all of its blocks, and older ones are gone.
        keys: (B, 3) int32 block coordinates in lexicographic order.
        tsdf: (B, 512) int8 signed distance over truncation, times 127; -128 where not observed.
        label: (B, 512) uint8 class ids, the ignore id where nothing voted or nothing was observed.
        confidence: (B, 512) uint8 probability of ``label``, times 255; 0 at the ignore id.
        rgb: (B, 512, 3) uint8.
    """

    since: int
    version: int
    epoch: int
    keys: NDArray[np.int32]
    tsdf: NDArray[np.int8]
    label: UInt8
    confidence: UInt8
    rgb: UInt8

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(B, 512) whether enough depth measurements saw the voxel."""
        return self.tsdf != UNOBSERVED


def oldest_first(versions: NDArray[np.int64], limit: int, newest: int) -> tuple[NDArray[np.int64], int]:
    """Which of the changed blocks come first: whole versions, at least one, and else at most ``limit`` blocks.

    Args:
        versions: (B,) when each block last changed.
        limit: 0 = all.
        newest: Version of the map.

    Returns:
        Positions of the blocks in ``versions``, ascending, and the version that they complete.
    """
    if not limit or len(versions) <= limit:
        return np.arange(len(versions)), newest
    distinct, counts = np.unique(versions, return_counts=True)
    whole = max(1, int(np.searchsorted(np.cumsum(counts), limit, side="right")))
    version = int(distinct[whole - 1])
    return np.flatnonzero(versions <= version), version


def read_changes(
    grid: BlockGrid,
    packed: NDArray[np.int64],
    versions: tuple[int, int, int],
    label_set: LabelSet,
    vote_discount: float,
    min_weight: float,
) -> BlockChanges:
    """Compact form of existing blocks, wherever they are; those on disk stay there.

    Args:
        grid: The map's storage.
        packed: (B,) sorted keys.
        versions: ``since``, ``version`` and ``epoch`` of the result.
        label_set: For the ids.
        vote_discount: rho, see ``readout``.
        min_weight: Voxels with fewer measurements count as not observed.
    """
    flat = (len(packed), BLOCK_VOXELS)
    out = BlockChanges(
        *versions,
        unpack_keys(packed),
        np.empty(flat, np.int8),
        np.empty(flat, np.uint8),
        np.empty(flat, np.uint8),
        np.empty((*flat, 3), np.uint8),
    )
    arrays = (out.tsdf, out.label, out.confidence, out.rgb)
    ids = np.array((*label_set.ids, label_set.ignore_id), np.uint8)
    found = find_blocks(grid.index, packed)
    here = np.flatnonzero(found >= 0)
    buffers = grid.buffers()
    values = BlockValues(*(getattr(buffers, name) for name in ATTRIBUTES))
    _compact(values, found[here], here, ids, vote_discount, min_weight, *arrays)
    away = np.flatnonzero(found < 0)
    for start in range(0, len(away), _READ_AT_ONCE):
        rows = away[start : start + _READ_AT_ONCE]
        indices = np.arange(len(rows), dtype=np.int32)
        _compact(grid.read(packed[rows]), indices, rows, ids, vote_discount, min_weight, *arrays)
    return out


@parallel_kernel()
def _compact(values, indices, rows, ids, vote_discount, min_weight, tsdf, label, confidence, rgb):
    """Write blocks ``indices`` (B,) of ``values`` to ``rows`` (B,) of the output."""
    for n in prange(len(indices)):
        block, row = indices[n], rows[n]
        for voxel in range(BLOCK_VOXELS):
            tsdf[row, voxel] = UNOBSERVED
            label[row, voxel] = ids[-1]
            confidence[row, voxel] = 0
            for c in range(3):
                rgb[row, voxel, c] = 0
            if values.weight[block, voxel] < min_weight:
                continue
            distance = values.tsdf[block, voxel]
            steps = int(np.rint(min(max(distance, -1.0), 1.0) * TSDF_STEPS))
            tsdf[row, voxel] = max(steps, 1) if distance > 0 else steps
            for c in range(3):
                rgb[row, voxel, c] = np.uint8(min(max(values.color[block, voxel, c] + 0.5, 0.0), 255.0))
            best, p = decide(values.evidence[block, voxel], values.votes[block, voxel], vote_discount)
            if best >= 0:
                label[row, voxel] = ids[best]
                confidence[row, voxel] = np.uint8(p * CONFIDENCE_STEPS + 0.5)
