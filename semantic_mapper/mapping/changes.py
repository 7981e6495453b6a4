"""What changed in a map since a version, small enough to be sent: 3.1 KB a block instead of 12 KB and 1 KB a class.

The TSDF is rounded to 1/127 of the truncation without ever changing its sign, so that the surface stays between the
same voxels. Class evidence is decided where it lies: one class and its probability a voxel."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import BlockGrid
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, BlockValues, PackedBlocks
from semantic_mapper.mapping.fusion import MEASURED, SURFACE_WEIGHT, evidence_of
from semantic_mapper.types import Bool, Int32, Int64, UInt8

TSDF_STEPS = 127  # of the quantised TSDF, a truncation
UNOBSERVED = -128  # in the quantised TSDF
CONFIDENCE_STEPS = 255
_READ_AT_ONCE = 512  # blocks copied at a time
MAX_ROWS = 1 << 16  # that a map and a mirror keep: 2 MB


class ClearedBlocks(NamedTuple):
    """N times that a frame cleared voxels of a block, oldest frame first; all (N,) int64."""

    packed: Int64  # key of the block
    voxels: Int64  # how many of its voxels were part of a surface, or behind one, and are free now
    version: Int64  # of the map, with that frame
    stamp_ns: Int64  # of the frame

    def between(self, after: int, up_to: int) -> ClearedBlocks:
        """The rows of versions above ``after``, up to ``up_to``."""
        chosen = (self.version > after) & (self.version <= up_to)
        return ClearedBlocks(*(column[chosen] for column in self))

    def followed_by(self, later: ClearedBlocks) -> ClearedBlocks:
        """The latest ``MAX_ROWS`` of both."""
        if not len(later.packed):
            return self
        return ClearedBlocks(*(np.concatenate(pair)[-MAX_ROWS:] for pair in zip(self, later, strict=True)))


NONE_CLEARED = ClearedBlocks(*(np.empty(0, np.int64) for _ in range(4)))


@dataclass(frozen=True, slots=True, eq=False)
class BlockChanges:
    """Blocks of a map that changed after one version, as they are now; voxels in the order [z][y][x]."""

    since: int  # who has all up to this version
    version: int  # has, with these blocks, all up to this one
    newest: int  # version of the map: where it is ``version``, nothing is missing
    # of the map. Where it is another than before, blocks of before are gone: those of the new epoch come all.
    epoch: int
    keys: Int32  # (B, 3) int32 block coordinates in lexicographic order
    tsdf: NDArray[np.int8]  # (B, 512) int8 signed distance over truncation, times 127; -128 where not observed
    label: UInt8  # (B, 512) uint8 class ids, the ignore id where nothing voted, or the map is too unsure
    confidence: UInt8  # (B, 512) uint8 probability of the likeliest class, times 255; 0 where nothing voted
    rgb: UInt8  # (B, 512, 3) uint8
    scale_known: bool = True  # whether lengths of the map are metres
    # (B, 512) uint8, 1 where no sensor measured what was observed; None = it did everywhere
    computed: UInt8 | None = None
    # which of these blocks lost surface that frames saw through after ``since``, and when; the latest
    cleared: ClearedBlocks = NONE_CLEARED

    @property
    def observed(self) -> Bool:
        """(B, 512) whether enough depth measurements saw the voxel."""
        return self.tsdf != UNOBSERVED


class Decision(NamedTuple):
    """How class evidence is read: see ``surface``. Voxels of less than ``min_weight`` are not observed."""

    vote_discount: float
    unknown_below: float
    min_weight: float


@dataclass(frozen=True, slots=True, eq=False)
class CopiedChanges:
    """Blocks of a map as they were, not compact yet: what a thread that must not be held up hands to another one."""

    result: BlockChanges  # of ``empty_changes``, to be filled
    parts: Iterable[tuple[Int64, PackedBlocks]]  # rows of the result, and the blocks there
    label_set: LabelSet
    decision: Decision

    def compact(self) -> BlockChanges:
        """The blocks as they were; any thread may call it, once, without the map."""
        to, ids = self.result, np.array((*self.label_set.ids, self.label_set.ignore_id), np.uint8)
        assert to.computed is not None
        voxels = to.tsdf, to.label, to.confidence, to.rgb, to.computed
        for rows, blocks in self.parts:
            _compact_blocks(blocks, np.ascontiguousarray(rows), ids, self.decision, *voxels)
            del blocks  # while the next ones are read
        return to


def empty_changes(
    since: int, version: int, newest: int, epoch: int, keys: Int32, *, scale_known: bool, cleared: ClearedBlocks
) -> BlockChanges:
    """Changes of blocks (B, 3) whose voxels are still to be filled."""
    flat = (len(keys), BLOCK_VOXELS)
    label, confidence, computed = (np.empty(flat, np.uint8) for _ in range(3))
    voxels = np.empty(flat, np.int8), label, confidence, np.empty((*flat, 3), np.uint8)
    return BlockChanges(since, version, newest, epoch, keys, *voxels, scale_known, computed, cleared)


def packed_parts(grid: BlockGrid, packed: Int64) -> Iterator[tuple[Int64, PackedBlocks]]:
    """Existing blocks (B,), wherever they are; those on disk stay there."""
    for start in range(0, len(packed), _READ_AT_ONCE):
        for rows, blocks in grid.pack(packed[start : start + _READ_AT_ONCE]):
            yield rows + start, blocks


def oldest_first(versions: Int64, since: int, limit: int, newest: int) -> tuple[Int64, int]:
    """Which of the blocks (B,) changed after ``since`` come first: ascending positions, of whole versions until it is
    ``limit`` blocks or more (0 = all); and the version that they complete, ``newest``, the map's, where it is all.
    Else a frame with more blocks would never come while each frame leaves some of the frames before it behind.
    ``MapError``: ``since`` is no version of the map, or ``limit`` is negative."""
    if not 0 <= since <= newest or limit < 0:
        raise MapError(
            f"changes since version {since}, limit {limit}: this map has versions 0 to {newest}; a mirror of another "
            "map restarts from 0, and a limit is not negative"
        )
    if not limit or len(versions) <= limit:
        return np.arange(len(versions)), newest
    distinct, counts = np.unique(versions, return_counts=True)
    version = int(distinct[np.searchsorted(np.cumsum(counts), limit)])
    return np.flatnonzero(versions <= version), version


def received_parts(changes: BlockChanges, label_set: LabelSet) -> Iterator[tuple[Int32, BlockValues]]:
    """Keys and voxels of blocks that read as ``changes`` do; see ``VoxelMap.received``."""
    for start in range(0, len(changes.keys), _READ_AT_ONCE):
        part = slice(start, start + _READ_AT_ONCE)
        label, confidence, observed = changes.label[part], changes.confidence[part], changes.observed[part]
        computed = 0 if changes.computed is None else changes.computed[part]
        weight = np.where(observed, np.where(computed, SURFACE_WEIGHT, MEASURED), 0).astype(np.float32)
        tsdf = np.where(observed, changes.tsdf[part] / np.float32(TSDF_STEPS), np.float32(0))
        known = label != label_set.ignore_id
        log_p = np.zeros((*label.shape, len(label_set)), np.float32)
        # The softmax of 0 for one of L classes, and -e for the others, is p: e = log(p / (1 - p) * (L - 1)).
        p = np.clip(confidence[known], 0.5, CONFIDENCE_STEPS - 0.5) / CONFIDENCE_STEPS
        odds = p / (1 - p) * max(1, len(label_set) - 1)
        log_p[known] = -np.log(np.maximum(odds, 1.001))[:, None]
        log_p[(*np.nonzero(known), label_set.to_channels(label[known]))] = 0
        color, votes = changes.rgb[part].astype(np.float32), known.astype(np.float32)
        yield changes.keys[part], BlockValues(tsdf, weight, color, evidence_of(log_p), votes)


# Serial: it runs next to the mapper, which needs the other threads.
@kernel
def _compact_blocks(
    blocks: PackedBlocks,
    rows: Int64,
    ids: UInt8,
    decision: Decision,
    tsdf: NDArray[np.int8],
    label: UInt8,
    confidence: UInt8,
    rgb: UInt8,
    computed: UInt8,
) -> None:
    """Write packed blocks (B,) to ``rows`` (B,) of the output; ``ids`` (L + 1,) of the classes, and the ignore id."""
