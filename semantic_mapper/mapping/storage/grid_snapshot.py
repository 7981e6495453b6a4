"""The blocks of a grid as they were at one moment, read part by part while the grid goes on changing."""

from __future__ import annotations

from itertools import islice

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import pack_keys, unpack_keys
from semantic_mapper.mapping.storage.block_store import BlockStore, BlockValues, unpack_blocks

MOST_ASIDE = 2048  # blocks in memory that frames have changed, some 20 KB each; of more, the first go to disk


class GridSnapshot:
    """Copy on write: blocks that may be about to change are put aside first, unless they have been read already.

    That costs a copy of each block that frames touch meanwhile, once: in memory, packed, which takes a fifth of the
    time that the disk would. Whoever calls ``read``, ``close`` or a method of the grid holds the lock of the map.

    Args:
        grid: To be read; the snapshot is of now.
        classes: L.
    """

    def __init__(self, grid: BlockGrid, classes: int) -> None:
        self._grid = grid
        self._classes = classes
        self._waiting = pack_keys(grid.all_keys())  # not read yet, sorted
        self._aside: dict[int, memoryview] = {}
        self._kept: BlockStore | None = None
        self._failure: MapError | None = None
        grid.watchers.append(self._keep)

    def __len__(self) -> int:
        """Blocks that wait to be read."""
        return len(self._waiting)

    def read(self, count: int) -> tuple[NDArray[np.int32], BlockValues]:
        """The next ``count`` blocks (B <= count): keys (B, 3) in lexicographic order, and voxels.

        Raises:
            MapError: blocks could not be kept, or not be read back, because a disk is full or fails.
        """
        if self._failure is not None:
            raise self._failure
        part, self._waiting = self._waiting[:count], self._waiting[count:]
        values = self._grid.read(part)
        kept = self._kept
        if kept is not None:
            old = kept.holds(part)
            for now, then in zip(values, kept.get(part[old]), strict=True):
                now[old] = then
            kept.drop(part[old])
        aside = [n for n, key in enumerate(part.tolist()) if key in self._aside]
        for now in values:
            now[aside] = 0
        unpack_blocks([self._aside.pop(key) for key in part[aside].tolist()], values, np.array(aside, np.int64))
        return unpack_keys(part), values

    def close(self) -> None:
        """Let the grid change without being watched."""
        self._grid.watchers.remove(self._keep)
        self._aside.clear()
        if self._kept is not None:
            self._kept.close()

    def _keep(self, packed: NDArray[np.int64]) -> None:
        """Blocks (B,) are about to be used. A failure is the reader's, not the frame's that is being fused."""
        if self._failure is not None or not len(self._waiting):
            return
        slots = np.minimum(np.searchsorted(self._waiting, packed), len(self._waiting) - 1)
        found = packed[self._waiting[slots] == packed]
        kept = self._kept
        new = found if kept is None else found[~kept.holds(found)]
        new = new[[key not in self._aside for key in new.tolist()]]
        try:
            for part, blocks in self._grid.pack(new):
                self._aside.update(zip(new[part].tolist(), blocks.blobs(), strict=True))
            if len(self._aside) > MOST_ASIDE:
                self._put_on_disk(len(self._aside) - MOST_ASIDE)
        except MapError as error:
            self._failure = error

    def _put_on_disk(self, count: int) -> None:
        if self._kept is None:
            self._kept = BlockStore(self._classes, self._grid.evidence)
        keys = np.array(list(islice(self._aside, count)), np.int64)
        self._kept.put_packed(keys, np.zeros(count, np.int64), [self._aside.pop(key) for key in keys.tolist()])
