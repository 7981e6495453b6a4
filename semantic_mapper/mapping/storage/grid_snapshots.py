"""The blocks of a grid as they were at moments of its past, without a copy of all of it: copy on write.

Before a block changes for the first time after the newest moment, it is copied, packed, and goes to disk little by
little (scratch space of this process, see ``block_store``). A block of an older moment is the first copy from that
moment on, or else the block that the grid has now. So a moment takes room for what changes until the next one, and to
drop the oldest costs nothing.
"""

from __future__ import annotations

from itertools import islice

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.block_store import BlockStore, BlockValues, unpack_blocks

MOST_IN_MEMORY = 2048  # copies, some 20 KB each; of more, the first go to disk
_WRITTEN_AT_ONCE = 256  # blocks


class GridSnapshots:
    """Moments of a grid's past, oldest first; the first one is now. Reads are of the oldest.

    The caller of any of this, or a method of the grid, holds the lock of the map. Where a block cannot be copied, the
    frame that changes it goes on; the next ``read`` or ``write`` fails.

    Args:
        grid: Is watched until ``close``.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, grid: BlockGrid) -> None:
        self._grid = grid
        self._failure: MapError | None = None
        self._moments = [_Moment(grid)]
        grid.watchers.append(self._copy)

    @property
    def keys(self) -> NDArray[np.int64]:
        """Packed keys (B,) of the blocks that the grid had at the oldest moment, sorted."""
        return self._moments[0].keys

    @property
    def in_memory(self) -> int:
        """Copies that wait for the disk."""
        return sum(len(moment.copies) for moment in self._moments)

    @property
    def disk_bytes(self) -> int:
        """Size of the files."""
        return sum(moment.store.file_bytes for moment in self._moments)

    def take(self) -> None:
        """Begin a new moment, which is now.

        Raises:
            MapError: as for the class.
        """
        self._moments.append(_Moment(self._grid))

    def drop_oldest(self) -> None:
        """Give back what the oldest moment takes; there has to be another one."""
        self._moments.pop(0).store.close()

    def read(self, packed: NDArray[np.int64]) -> BlockValues:
        """Blocks (B,) of ``keys``, bit for bit as they were at the oldest moment.

        Raises:
            MapError: the disk is full or fails, or has failed.
        """
        self._check()
        values, left = self._grid.read(packed), np.arange(len(packed))
        for moment in self._moments:
            held = moment.holds(packed[left])
            moment.read_into(values, left[held], packed[left[held]])
            left = left[~held]
        return values

    def release(self, packed: NDArray[np.int64]) -> None:
        """Forget blocks (B,) of the oldest moment, which must be the only one: nobody reads them again."""
        self._moments[0].release(packed)

    def write(self, blocks: int | None = None) -> None:
        """Put this many of the copies in memory on disk, or all.

        Raises:
            MapError: the disk is full or fails, or has failed; what is in memory stays there.
        """
        self._check()
        left = self.in_memory if blocks is None else blocks
        for moment in self._moments:
            left -= moment.write(left)

    def close(self) -> None:
        """Give memory and disk back and watch the grid no more. Harmless when repeated."""
        if self._copy in self._grid.watchers:
            self._grid.watchers.remove(self._copy)
        for moment in self._moments:
            moment.copies.clear()
            moment.store.close()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _copy(self, packed: NDArray[np.int64]) -> None:
        """Blocks (B,) are about to change."""
        if self._failure is not None:
            return
        try:
            self._moments[-1].copy(self._grid, packed)
            self.write(max(0, self.in_memory - MOST_IN_MEMORY))
        except MapError as error:
            self._failure = error


class _Moment:
    """The blocks of now, and room for copies of those that change."""

    def __init__(self, grid: BlockGrid) -> None:
        self.keys = pack_keys(grid.all_keys())
        self.copies: dict[int, memoryview] = {}  # in memory, packed, oldest first
        self.store = BlockStore(grid.classes, grid.evidence)
        self._done = np.zeros(len(self.keys), np.bool_)  # copied, or released

    def copy(self, grid: BlockGrid, packed: NDArray[np.int64]) -> None:
        rows, there = self._find(packed)
        rows = np.unique(rows[there])
        rows = rows[~self._done[rows]]
        keys = self.keys[rows]
        for part, blocks in grid.pack(keys):
            self.copies.update(zip(keys[part].tolist(), blocks.blobs(), strict=True))
        self._done[rows] = True

    def holds(self, packed: NDArray[np.int64]) -> NDArray[np.bool_]:
        rows, there = self._find(packed)
        there[there] = self._done[rows[there]]
        return there

    def read_into(self, values: BlockValues, rows: NDArray[np.int64], packed: NDArray[np.int64]) -> None:
        """Put copies of blocks (B,) in ``rows`` (B,) of ``values``."""
        here = np.array([key in self.copies for key in packed.tolist()], np.bool_)
        for now in values:
            now[rows[here]] = 0
        unpack_blocks([self.copies[key] for key in packed[here].tolist()], values, rows[here])
        if not here.all():
            for now, stored in zip(values, self.store.get(packed[~here]), strict=True):
                now[rows[~here]] = stored

    def release(self, packed: NDArray[np.int64]) -> None:
        self._done[self._find(packed)[0]] = True
        for key in packed.tolist():
            self.copies.pop(key, None)
        self.store.drop(packed[self.store.holds(packed)])

    def write(self, count: int) -> int:
        """Put this many copies on disk, or as many as are in memory; returns how many."""
        count = left = min(count, len(self.copies))
        while left:
            some = dict(islice(self.copies.items(), min(left, _WRITTEN_AT_ONCE)))
            keys = np.array(list(some), np.int64)
            self.store.put_packed(keys, np.zeros(len(some), np.int64), list(some.values()))
            for key in some:  # only now: a full disk loses none
                del self.copies[key]
            left -= len(some)
        return count

    def _find(self, packed: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Rows of blocks (B,) among the keys, and whether they are there."""
        rows = np.searchsorted(self.keys, packed)
        there = rows < len(self.keys)
        there[there] = self.keys[rows[there]] == packed[there]
        return rows, there
