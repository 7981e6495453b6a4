"""Storage of the map: sparse voxel blocks in one pool of memory, with one index, and growth in bounded steps.

With a limit on memory, the blocks that were used longest ago go to a ``BlockStore`` on disk and come back, equal to the
bit, when they are requested; ``MapError`` where the map would exceed ``max_blocks``, or the disk fails.

A block holds 8 x 8 x 8 voxels in the order [z][y][x]; voxel (i, j, k) of block (x, y, z) is the point ``(8 * (x, y, z)
+ (i, j, k)) * voxel_size_m`` in the world."""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.blocks import (
    BLOCK_VOXELS,
    BlockIndex,
    BlockStore,
    BlockValues,
    PackedBlocks,
    empty_blocks,
    find_blocks,
    has_room,
    insert_blocks,
    make_block_index,
    pack_blocks,
    pack_keys,
    unpack_keys,
)
from semantic_mapper.types import Bool, Float32, Int32, Int64, UInt8, UInt16

BLOCK_SIDE = 8
LEAST_RESIDENT = 256  # blocks that memory has room for, whatever the limit
EVICTED_AT_ONCE = 32  # at least, and
EVICTED_SHARE = 32  # at least this part of what memory has room for: sorting out what to evict looks at all of it
TILE_BLOCKS = 4096  # blocks read at a time; Open3D fails past 262,100, and needs 8 KiB a block to mesh
SPARE_SHARE = 1.5  # of what one frame touches, where memory is to have room for it without pushing the last one out
NEIGHBOURS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)
_MOVED_BYTES = 1 << 22  # a whole number of pages
_READ_AT_ONCE = 256  # blocks between memory and disk: a copy of them takes room next to both
_FREE = -1  # no packed key is negative
_NO_SURFACE, _SURFACE, _UNKNOWN = 0, 1, 2  # whether a block holds a surface; unknown since it was last changed

_log = get_logger(__name__)


class GridBuffers(NamedTuple):
    """The grid's memory; growing replaces it. Voxels are (capacity, 512, ...) float32, evidence uint16."""

    keys: Int32  # (capacity, 3) block coordinates
    tsdf: Float32  # signed distance over truncation in [-1, 1]
    weight: Float32  # number of depth measurements (capped); below 1 the depth was computed
    color: Float32  # (..., 3) in 0..255
    evidence: UInt16  # (..., L) mean of what votes say; see ``fusion``
    votes: Float32  # sum of vote weights

    @property
    def values(self) -> BlockValues:
        """The same without the keys."""
        return BlockValues(*self[1:])


class BlockGrid:
    """Blocks of 8^3 voxels by their key; grows by half when full and never past ``max_blocks``, in memory and on disk.

    ``classes`` L are the channels of evidence, ``memory_bytes`` the limit of blocks in memory, 0 = none. ``watchers``
    are called with the packed keys that ``activate`` gets, before it does anything."""

    def __init__(
        self, voxel_size_m: float, classes: int, initial_blocks: int, max_blocks: int, memory_bytes: int = 0
    ) -> None:
        self._max_blocks = max_blocks
        self._voxel_size_m = voxel_size_m
        self.classes = classes
        self.block_bytes = BLOCK_VOXELS * (4 * (1 + 1 + 3 + 1) + 2 * classes) + 12
        self._max_resident = max_blocks
        if memory_bytes > 0:
            self._max_resident = min(max_blocks, max(LEAST_RESIDENT, memory_bytes // self.block_bytes))
            initial_blocks = self._max_resident  # at once: growing needs room for the old memory and the new one
        capacity = max(1, min(initial_blocks, max_blocks))
        self._buffers = self._make_buffers(capacity)
        self._index = make_block_index(np.empty((0, 3), np.int32), np.empty(0, np.int32))
        self._store = BlockStore()
        self._warned_of_batches = False
        self._clock = 0
        # By buffer index:
        self._packed = np.full(capacity, _FREE, np.int64)  # key of the block there
        self._used = np.zeros(capacity, np.int64)  # when last requested
        self._version = np.zeros(capacity, np.int64)  # see ``mark_changed``
        self._surface = np.zeros(capacity, np.uint8)
        self._resident_count = 0
        self._ever_used = 0  # from here on, buffers are as they were made: zero
        self.watchers: list[Callable[[Int64], None]] = []

    @property
    def index(self) -> BlockIndex:
        """Block key -> buffer index; valid until the next ``activate``."""
        return self._index

    @property
    def block_count(self) -> int:
        """Blocks in the map, in memory and on disk."""
        return self._resident_count + self.stored_count

    @property
    def stored_count(self) -> int:
        """Blocks on disk."""
        return len(self._store)

    @property
    def stored_bytes(self) -> int:
        """Bytes that the file of those on disk takes."""
        return self._store.file_bytes

    @property
    def stored_surface(self) -> Int64:
        """Packed keys, sorted, of blocks on disk that hold a surface."""
        return self._store.keys[self._store.surface]

    @property
    def capacity(self) -> int:
        """Blocks there is memory for."""
        return len(self._packed)

    @property
    def memory_bytes(self) -> int:
        """Bytes held for voxels and block tables, used or not."""
        return self.capacity * self.block_bytes + self._index.slot_keys.nbytes + self._index.slot_values.nbytes

    @property
    def room(self) -> int:
        """Blocks that memory may ever hold."""
        return self._max_resident

    def buffers(self) -> GridBuffers:
        """The present buffers. Take them again after every ``activate``: growth moves the memory."""
        return self._buffers

    def sorted_blocks(self) -> tuple[Int32, Int32]:
        """Keys (B, 3) in lexicographic order and their buffer indices (B,), of blocks in memory."""
        indices = np.flatnonzero(self._packed != _FREE).astype(np.int32)
        indices = indices[np.argsort(self._packed[indices])]
        return self._buffers.keys[indices], indices

    def all_packed(self) -> Int64:
        """Packed keys (B,) of all blocks, sorted."""
        return np.sort(np.concatenate((self._packed[self._packed != _FREE], self._store.keys)))

    def all_keys(self) -> Int32:
        """Keys (B, 3) of all blocks in lexicographic order."""
        return unpack_keys(self.all_packed())

    def keys_between(self, low: Int64, high: Int64) -> Int32:
        """Those of ``all_keys`` from ``low`` (3,) to ``high`` (3,), both included, without sorting the others."""
        keys = np.concatenate((self._buffers.keys[self._packed != _FREE], unpack_keys(self._store.keys)))
        keys = keys[((keys >= low) & (keys <= high)).all(axis=1)]
        return keys[np.argsort(pack_keys(keys))]

    def activate(self, packed: Int64) -> Int32:
        """Make sure that blocks of unique packed keys (B,), about to change, are in memory, which has room for them;
        returns indices (B,). New ones are zero. After an error no block has changed."""
        for watcher in self.watchers:
            watcher(packed)
        found = self._bring_together(packed)
        self._surface[found] = _UNKNOWN
        return found

    def batches(self, packed: Int64) -> Iterator[Int32]:
        """``activate`` unique packed keys (B,), as many at a time as memory has room for, checked as a whole first:
        buffer indices of a part of them, valid until the next; one empty part where there are no keys."""
        if len(packed) > self._max_resident:
            found = find_blocks(self._index, packed)
            self._check_room(packed[found < 0])
            if not self._warned_of_batches:
                self._warned_of_batches = True
                advised = advised_mb(len(packed), self.block_bytes)
                _log.warning(
                    "memory_is_short",
                    blocks=len(packed),
                    room=self._max_resident,
                    reason="a frame touches more blocks than memory has room for and goes through the disk, which is "
                    f"slow; raise voxel_map.memory_mb to {advised} or more, or use larger voxels",
                )
            packed = packed[np.argsort(found < 0, kind="stable")]  # first those in memory: they need not come back
        for start in range(0, max(len(packed), 1), self._max_resident):
            yield self.activate(packed[start : start + self._max_resident])

    def page_in(self, packed: Int64) -> Int32:
        """Bring the first of these existing blocks (B,) into memory to be read, as many as have room: their indices."""
        return self._bring_together(packed[: self._max_resident])

    def reserve(self, blocks: int) -> None:
        """Make room for this many blocks at once, as far as the limit on memory goes."""
        if min(blocks, self._max_resident) > self.capacity:
            self._grow(blocks)

    def may_hold_surface(self) -> UInt8:
        """A copy of (capacity,), by buffer index: 0 where there is no block, or one without a surface."""
        return self._surface.copy()

    def hold_surface(self, blocks: Int32) -> Bool:
        """Whether the blocks (B,) in memory hold a surface: a voxel that ``mapping/clearing.py`` may have to clear."""
        unknown = blocks[self._surface[blocks] == _UNKNOWN]
        holds = np.empty(len(unknown), np.uint8)
        blocks_hold_surface(unknown, self._buffers.tsdf, self._buffers.weight, holds)
        self._surface[unknown] = np.where(holds, _SURFACE, _NO_SURFACE)
        return self._surface[blocks] == _SURFACE

    def mark_changed(self, blocks: Int32, version: int) -> None:
        """Note that blocks with these buffer indices were changed at ``version`` of the map."""
        self._version[blocks] = version

    def mark_all_changed(self, version: int, each: int) -> int:
        """Note that all blocks were changed, ``each`` of them at a version, from ``version`` on; returns the last."""
        _, indices = self.sorted_blocks()
        count = self.block_count
        versions = version + np.arange(count) // each
        self._version[indices] = versions[: len(indices)]
        self._store.versions = versions[len(indices) :].copy()
        return version + max(count - 1, 0) // each

    def versions_since(self, version: int) -> tuple[Int64, Int64]:
        """Packed keys (B,) of all blocks that were changed after ``version``, sorted, and when each was: (B,)."""
        there = self._packed != _FREE
        packed = np.concatenate((self._packed[there], self._store.keys))
        versions = np.concatenate((self._version[there], self._store.versions))
        newer = np.flatnonzero(versions > version)
        newer = newer[np.argsort(packed[newer])]
        return packed[newer], versions[newer]

    def tiles(self) -> Iterator[tuple[Int32, Int32, BlockGrid]]:
        """All blocks, in lexicographic order, in parts: keys (B, 3), their buffer indices (B,) in a grid, and that
        grid, which also holds the next blocks along each axis; see ``holding``."""
        everything = self.all_packed()
        for start in range(0, max(len(everything), 1), TILE_BLOCKS):
            part = everything[start : start + TILE_BLOCKS]
            around = np.unique(pack_keys((unpack_keys(part)[:, None] + NEIGHBOURS).reshape(-1, 3)))
            at = np.searchsorted(everything[:-1], around)
            tile = self.holding(around[everything[at] == around])
            yield unpack_keys(part), find_blocks(tile.index, part), tile

    def holding(self, packed: Int64) -> BlockGrid:
        """A grid with these existing blocks (B,) in memory: this one where nothing is on disk, else a temporary one."""
        if not self.stored_count:
            return self
        copy = BlockGrid(self._voxel_size_m, self.classes, len(packed), len(packed))
        copy.fill(packed, self.read(packed))
        return copy

    def read(self, packed: Int64) -> BlockValues:
        """A copy of blocks (B,) that exist, from memory or disk."""
        found = find_blocks(self._index, packed)
        away = np.flatnonzero(found < 0)
        values = self._buffers.values.take(found)
        if len(away):
            for array in values:
                array[away] = 0
            self._store.read_into(values, away, packed[away])
        return values

    def pack(self, packed: Int64) -> Iterator[tuple[Int64, PackedBlocks]]:
        """A packed copy of existing blocks (B,), in parts, those in memory first: rows of ``packed`` (P,), blocks."""
        found = find_blocks(self._index, packed)
        here, away = np.flatnonzero(found >= 0), np.flatnonzero(found < 0)
        yield here, pack_blocks(self._buffers.values, found[here])
        for start in range(0, len(away), _READ_AT_ONCE):
            part = away[start : start + _READ_AT_ONCE]
            yield part, pack_blocks(self.read(packed[part]), np.arange(len(part), dtype=np.int32))

    def fill(self, packed: Int64, values: BlockValues) -> Int32:
        """Make blocks (B,) be ``values``, new or not; returns their buffer indices."""
        blocks = self.activate(packed)
        for own, given in zip(self._buffers.values, values, strict=True):
            own[blocks] = given
        return blocks

    def _bring_together(self, packed: Int64) -> Int32:
        self._clock += 1
        found = find_blocks(self._index, packed)
        missing = packed[found < 0]
        if len(missing):
            self._check_room(missing)
            if len(packed) > self._max_resident:
                raise MapError(f"{len(packed)} blocks at once, memory has room for {self._max_resident} of them")
            self._bring_in(packed, missing)
            found = find_blocks(self._index, packed)
        self._used[found] = self._clock
        return found

    def _check_room(self, missing: Int64) -> None:
        new = len(missing) - int(self._store.find(missing)[1].sum())
        if self.block_count + new > self._max_blocks:
            raise MapError(
                f"the map is full: {self.block_count} blocks, {new} more requested, limit {self._max_blocks} "
                "(voxel_map.max_blocks). Raise the limit, use larger voxels, or start a new map; this one stays usable"
            )

    def _bring_in(self, packed: Int64, missing: Int64) -> None:
        """Make room for the missing blocks, add them, and read those that were on disk."""
        needed = self._resident_count + len(missing)
        if needed > self._max_resident:
            self._evict(needed - self._max_resident, packed)
        elif needed > self.capacity:
            self._grow(needed)
        stored = self._store
        _, there = stored.find(missing)
        back = missing[there]
        for start in range(0, len(back), _READ_AT_ONCE):
            part = back[start : start + _READ_AT_ONCE]
            rows, _ = stored.find(part)
            versions, surface = stored.versions[rows], stored.surface[rows]
            values = empty_blocks(len(part), self.classes)
            stored.read_into(values, np.arange(len(part)), part)
            stored.drop(part)  # may fail, and then the blocks are there still; what comes now does not
            indices = self._add(part)
            for own, read in zip(self._buffers.values, values, strict=True):
                own[indices] = read
            self._version[indices] = versions
            self._surface[indices] = np.where(surface, _SURFACE, _NO_SURFACE)
        self._add(missing[~there])

    def _evict(self, count: int, keep: Int64) -> None:
        """Put the ``count`` blocks that were used longest ago, and some more, on disk; those of ``keep`` stay."""
        if not self.stored_count:
            _log.info("map_pages", resident=self._max_resident, reason="voxel_map.memory_mb is used up")
        keys, indices = self.sorted_blocks()
        packed = pack_keys(keys)
        free = ~np.isin(packed, keep)
        oldest = np.flatnonzero(free)[np.argsort(self._used[indices[free]], kind="stable")]
        count = max(count, EVICTED_AT_ONCE, self._max_resident // EVICTED_SHARE)
        going = np.sort(oldest[:count])
        try:
            for start in range(0, len(going), _READ_AT_ONCE):
                part = going[start : start + _READ_AT_ONCE]
                blocks = indices[part]
                copied = pack_blocks(self._buffers.values, blocks)
                self._store.put(packed[part], copied, self._version[blocks], self.hold_surface(blocks))
                self._surface[blocks] = _NO_SURFACE
                self._packed[blocks] = _FREE
                self._resident_count -= len(blocks)
        finally:  # also where the disk is full: blocks that are there have left memory
            self._index = make_block_index(*self.sorted_blocks())

    def _make_buffers(self, capacity: int) -> GridBuffers:
        """Zeros for this many blocks; the machine gives the memory page by page as it is written."""
        needed, there = capacity * self.block_bytes, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        flat = (capacity, BLOCK_VOXELS)
        try:
            if needed > there:
                raise OSError(f"this machine has {there / 1e9:.1f} GB")
            return GridBuffers(
                keys=_zeros((capacity, 3), np.int32),
                tsdf=_zeros(flat, np.float32),
                weight=_zeros(flat, np.float32),
                color=_zeros((*flat, 3), np.float32),
                evidence=_zeros((*flat, self.classes), np.uint16),
                votes=_zeros(flat, np.float32),
            )
        except OSError as error:
            raise MapError(
                f"no memory for {capacity} blocks ({needed / 1e9:.1f} GB): {error}; free some, raise the limit "
                "(ulimit -v), lower voxel_map.max_blocks or memory_mb, or use larger voxels"
            ) from error

    def _grow(self, needed: int) -> None:
        before = self.capacity
        capacity = min(max(needed, before + before // 2), self._max_resident)
        _log.debug("map_grows", blocks=self.block_count, capacity=capacity)
        larger = self._make_buffers(capacity)
        for values, grown in zip(self._buffers, larger, strict=True):
            _move(values, grown)
        self._buffers = larger
        more = capacity - before
        self._packed = np.pad(self._packed, (0, more), constant_values=_FREE)
        self._used, self._version = np.pad(self._used, (0, more)), np.pad(self._version, (0, more))
        self._surface = np.pad(self._surface, (0, more))

    def _add(self, packed: Int64) -> Int32:
        """Give new blocks (B,) a place in the buffers, which have room; all their voxels are zero."""
        added = np.flatnonzero(self._packed == _FREE)[: len(packed)].astype(np.int32)
        self._packed[added] = packed
        self._resident_count += len(packed)
        self._buffers.keys[added] = unpack_keys(packed)
        if not has_room(self._index, self._resident_count):
            self._index = make_block_index(*self.sorted_blocks())
        else:
            insert_blocks(self._index, packed, added)
        used_before = added[added < self._ever_used]
        for values in self._buffers.values:
            values[used_before] = 0
        self._ever_used = max(self._ever_used, int(added.max(initial=-1)) + 1)
        self._version[added] = 0
        self._surface[added] = _NO_SURFACE
        return added


def advised_mb(blocks: int, block_bytes: int) -> int:
    """The ``voxel_map.memory_mb`` that this many blocks of one frame, and some of the frames before, fit in."""
    return math.ceil(SPARE_SHARE * blocks * block_bytes / 1e6)


def _zeros(shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    """As ``np.zeros``, which asks for huge pages: to find these holds up a frame for long when the map grows."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, dtype).reshape(shape)


def _move(values: NDArray[Any], grown: NDArray[Any]) -> None:
    """Copy an array of ``_zeros`` piece by piece, giving back each piece's memory: little is ever held twice."""
    old, new = (a.reshape(-1).view(np.uint8) for a in (values, grown))
    memory: mmap.mmap = values.base.base.obj  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    for start in range(0, len(old), _MOVED_BYTES):
        piece = slice(start, min(start + _MOVED_BYTES, len(old)))
        new[piece] = old[piece]
        memory.madvise(mmap.MADV_DONTNEED, start, piece.stop - start)


@kernel
def blocks_hold_surface(indices: Int32, tsdf: Float32, weight: Float32, holds: UInt8) -> None:
    """Which blocks (B,) have a voxel that may have to be cleared one day (``mapping/clearing.py``): 0 or 1 to fill."""
