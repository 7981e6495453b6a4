"""What changed in a map since a version, small enough to be sent: 3.1 KB a block instead of 12 KB and 2 KB a class.

The TSDF is rounded to 1/127 of the truncation (0.6 mm at 2 cm voxels) without ever changing its sign, so that the
surface stays between the same voxels. Class evidence is decided where it lies : one class and its
probability a voxel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import unpack_keys
from semantic_mapper.mapping.storage.block_store import BLOCK_VOXELS, BlockValues, PackedBlocks, pack_blocks
from semantic_mapper.types import Float32, Int64, UInt8

TSDF_STEPS = 127  # of the quantised TSDF, a truncation
UNOBSERVED = -128  # in the quantised TSDF
CONFIDENCE_STEPS = 255
_READ_AT_ONCE = 512  # blocks copied at a time
MAX_ROWS = 1 << 16  # that a map and a mirror keep: 2 MB


class ClearedBlocks(NamedTuple):
    """N times that a frame cleared voxels of a block, oldest frame first.

    Args:
        packed: (N,) int64 key of the block.
        voxels: (N,) int64 how many of its voxels were part of a surface, or behind one, and are free now.
        version: (N,) int64 of the map, with that frame.
        stamp_ns: (N,) int64 of the frame.
    """

    packed: NDArray[np.int64]
    voxels: NDArray[np.int64]
    version: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]

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
    """Blocks of a map that changed after one version, as they are now; voxels in the order [z][y][x].

    Args:
        since: Who has all up to this version
        version: has, with these blocks, all up to this one.
        newest: Version of the map: where it is ``version``, nothing is missing.
        epoch: Of the map. Where it is another than before, blocks of before are gone: those of the new epoch come all.
        keys: (B, 3) int32 block coordinates in lexicographic order.
        tsdf: (B, 512) int8 signed distance over truncation, times 127; -128 where not observed.
        label: (B, 512) uint8 class ids, the ignore id where nothing voted, or the map is too unsure.
        confidence: (B, 512) uint8 probability of the likeliest class, times 255; 0 where nothing voted.
        rgb: (B, 512, 3) uint8.
        scale_known: Whether lengths of the map are metres.
        computed: (B, 512) uint8, 1 where no sensor measured what was observed; None = it did everywhere.
        cleared: Which of these blocks lost surface that frames saw through after ``since``, and when; the latest.
    """

    since: int
    version: int
    newest: int
    epoch: int
    keys: NDArray[np.int32]
    tsdf: NDArray[np.int8]
    label: UInt8
    confidence: UInt8
    rgb: UInt8
    scale_known: bool = True
    computed: UInt8 | None = None
    cleared: ClearedBlocks = NONE_CLEARED

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(B, 512) whether enough depth measurements saw the voxel."""
        return self.tsdf != UNOBSERVED


class ChosenBlocks(NamedTuple):
    """Which blocks are to be reported, and how.

    Args:
        packed: (B,) sorted keys of existing blocks.
        since, version, newest, epoch: Of the result.
        label_set: For the ids.
        vote_discount, unknown_below: See ``readout``.
        min_weight: Voxels with fewer measurements count as not observed; > 0.
        scale_known, cleared: Of the result.
    """

    packed: NDArray[np.int64]
    since: int
    version: int
    newest: int
    epoch: int
    label_set: LabelSet
    vote_discount: float
    unknown_below: float
    min_weight: float
    scale_known: bool = True
    cleared: ClearedBlocks = NONE_CLEARED


class CopiedChanges(NamedTuple):
    """Blocks of a map as they were, not compact yet: what a thread that must not be held up hands to another one.

    Args:
        chosen: What they are.
        parts: Rows of the result, and the blocks there.
    """

    chosen: ChosenBlocks
    parts: tuple[tuple[NDArray[np.int64], PackedBlocks], ...]

    @property
    def version(self) -> int:
        """Of the result."""
        return self.chosen.version

    def compact(self) -> BlockChanges:
        """What ``read_changes`` would have given at that moment; any thread may call it, without the map."""
        out = _room_for(self.chosen)
        for rows, blocks in self.parts:
            _compact_into(out, rows, blocks, self.chosen)
        return out


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


def choose_blocks(
    grid: BlockGrid, versions: tuple[int, int, int], limit: int, decision: tuple[LabelSet, float, float, float]
) -> ChosenBlocks:
    """Which blocks have changed after a version, and how they are to be reported.

    Args:
        grid: The map's storage.
        versions: ``since``, and the map's version and epoch.
        limit: See ``VoxelMap.changes``.
        decision: The last four of ``ChosenBlocks``.

    Raises:
        MapError: ``since`` is not a version of the map, or a negative ``limit``.
    """
    since, newest, epoch = versions
    if not 0 <= since <= newest or limit < 0:
        raise MapError(
            f"changes since version {since}, limit {limit}: versions of this map go from 0 to {newest}, and a limit "
            "is not negative; a mirror of another map restarts from version 0"
        )
    packed, changed_at = grid.versions_since(since)
    rows, version = oldest_first(changed_at, limit, newest)
    return ChosenBlocks(packed[rows], since, version, newest, epoch, *decision)


def read_changes(grid: BlockGrid, chosen: ChosenBlocks) -> BlockChanges:
    """Compact form of existing blocks, wherever they are; those on disk stay there."""
    out = _room_for(chosen)
    for start in range(0, len(chosen.packed), _READ_AT_ONCE):
        for rows, blocks in grid.pack(chosen.packed[start : start + _READ_AT_ONCE]):
            _compact_into(out, rows + start, blocks, chosen)
    return out


def copy_changes(grid: BlockGrid, chosen: ChosenBlocks) -> CopiedChanges:
    """A copy of existing blocks to be made compact later, which takes four times as long as copying."""
    return CopiedChanges(chosen, tuple(grid.pack(chosen.packed)))


def compact_saved(parts: Iterable[tuple[NDArray[np.int32], BlockValues]], chosen: ChosenBlocks) -> BlockChanges:
    """Compact form of all blocks of a saved map, of which one part is in memory at a time.

    Args:
        parts: Keys (P, 3) and voxels of blocks, in lexicographic order.
        chosen: What they are; of ``packed`` only the size counts.
    """
    out, row = _room_for(chosen), 0
    for keys, values in parts:
        rows = np.arange(row, row + len(keys))
        out.keys[rows] = keys
        _compact_into(out, rows, pack_blocks(values, np.arange(len(keys), dtype=np.int32)), chosen)
        row += len(keys)
        del values  # while the next ones are read
    return out


def _room_for(chosen: ChosenBlocks) -> BlockChanges:
    flat = (len(chosen.packed), BLOCK_VOXELS)
    return BlockChanges(
        chosen.since,
        chosen.version,
        chosen.newest,
        chosen.epoch,
        unpack_keys(chosen.packed),
        np.empty(flat, np.int8),
        np.empty(flat, np.uint8),
        np.empty(flat, np.uint8),
        np.empty((*flat, 3), np.uint8),
        chosen.scale_known,
        np.empty(flat, np.uint8),
        chosen.cleared,
    )


def _compact_into(out: BlockChanges, rows: NDArray[np.int64], blocks: PackedBlocks, chosen: ChosenBlocks) -> None:
    assert out.computed is not None
    labels = chosen.label_set
    ids = np.array((*labels.ids, labels.ignore_id), np.uint8)
    _compact_blocks(
        blocks.data,
        blocks.ends,
        np.ascontiguousarray(rows),
        ids,
        chosen.vote_discount,
        chosen.unknown_below,
        chosen.min_weight,
        out.tsdf,
        out.label,
        out.confidence,
        out.rgb,
        out.computed,
    )


# Serial: it runs next to the mapper, which needs the other threads.
@kernel
def _compact_blocks(
    data: Float32,
    ends: Int64,
    rows: Int64,
    ids: UInt8,
    vote_discount: float,
    unknown_below: float,
    min_weight: float,
    tsdf: NDArray[np.int8],
    label: UInt8,
    confidence: UInt8,
    rgb: UInt8,
    computed: UInt8,
) -> None:
    """Write packed blocks (B,) to ``rows`` (B,) of the output.

    Args:
        data, ends: Of ``PackedBlocks``.
        rows: (B,) of the output.
        ids: (L + 1,) of the classes, and the ignore id.
        vote_discount, unknown_below, min_weight: See ``ChosenBlocks``.
        tsdf, label, confidence, rgb, computed: As in ``BlockChanges``.
    """
    ...
