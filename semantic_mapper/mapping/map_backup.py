"""A map as it was, kept on disk beside the one that goes on: scratch space of this process, see ``block_store``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.block_grid import BlockGrid
from semantic_mapper.mapping.block_index import pack_keys
from semantic_mapper.mapping.block_store import BlockStore
from semantic_mapper.mapping.voxel_map import VoxelMap

RESTORED_AT_ONCE = 256  # blocks
_WRITTEN_AT_ONCE = 256
_MOST_ASIDE = 1024  # blocks in memory that wait for the disk, some 20 KB each


class MapBackup:
    """The map of now, copied to disk little by little.

    Blocks that are about to change are first put aside in memory, packed, so that the copy is that of one moment
    whatever frames do meanwhile. Safe to call from several threads.

    Args:
        voxel_map: To be copied.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, voxel_map: VoxelMap) -> None:
        self._map = voxel_map
        self._store = BlockStore(len(voxel_map.label_set), voxel_map.config.evidence)
        self._aside: list[tuple[int, memoryview]] = []
        self._failure: MapError | None = None
        with voxel_map.locked() as grid:
            self._grid: BlockGrid | None = grid
            self._keys = pack_keys(grid.all_keys())
            self._taken = np.zeros(len(self._keys), np.bool_)  # on disk or aside
            self._next = 0  # of the keys; those before are taken
            self._frames, self._last_stamp_ns = voxel_map.frames, voxel_map.last_stamp_ns
            grid.watchers.append(self._keep)

    def __len__(self) -> int:
        """Blocks."""
        return len(self._keys)

    @property
    def is_whole(self) -> bool:
        """Whether all is on disk."""
        return self._grid is None

    def go_on(self, blocks: int | None = None) -> None:
        """Copy so many blocks more, or all.

        Raises:
            MapError: the disk is full or fails.
        """
        with self._map.locked():
            left = len(self._keys) if blocks is None else blocks
            while self._grid is not None and left > 0:
                if self._failure is not None:
                    raise self._failure
                left -= self._write_aside(min(left, _WRITTEN_AT_ONCE)) or self._write_next(self._grid, left)
                if not self._aside and self._next == len(self._keys):
                    self._let_go()

    def restore(self, voxel_map: VoxelMap, start: int) -> int:
        """Put the next ``RESTORED_AT_ONCE`` blocks, counted from ``start``, into a map that was empty before the first.

        Returns:
            Where to start next time; ``len(self)`` when the map is, bit for bit, what it was. The backup stays.

        Raises:
            MapError: the disk fails, or the map has no room.
        """
        end = min(start + RESTORED_AT_ONCE, len(self._keys))
        part = self._keys[start:end]
        with voxel_map.locked() as grid:
            grid.mark_changed(grid.fill(part, self._store.get(part)), self._frames)
            voxel_map.frames = voxel_map.version = self._frames
            voxel_map.last_stamp_ns = self._last_stamp_ns
        return end

    def close(self) -> None:
        """Give the disk space back."""
        with self._map.locked():
            self._let_go()
            self._store.close()

    def _keep(self, packed: NDArray[np.int64]) -> None:
        """Blocks (B,) are about to be used. A failure is the backup's, not the frame's that is being fused."""
        if self._grid is None or self._failure is not None or not len(self._keys):
            return
        slots = np.minimum(np.searchsorted(self._keys, packed), len(self._keys) - 1)
        slots = np.unique(slots[(self._keys[slots] == packed) & ~self._taken[slots]])
        try:
            self._aside += self._pack(self._grid, slots)
            if len(self._aside) > _MOST_ASIDE:
                self._write_aside(len(self._aside) - _MOST_ASIDE)
        except MapError as error:
            self._failure = error

    def _write_next(self, grid: BlockGrid, most: int) -> int:
        """Copy the next blocks that nobody has touched; returns how many keys were gone through."""
        begin = self._next
        self._next = min(begin + min(most, _WRITTEN_AT_ONCE), len(self._keys))
        waiting = begin + np.flatnonzero(~self._taken[begin : self._next])
        self._write(self._pack(grid, waiting))
        return self._next - begin

    def _pack(self, grid: BlockGrid, slots: NDArray[np.int64]) -> list[tuple[int, memoryview]]:
        """Keys and voxels of blocks, which count as taken from now on; those that the grid has on disk stay there."""
        keys = self._keys[slots]
        packed: list[tuple[int, memoryview]] = []
        for part, blocks in grid.pack(keys):
            packed += zip(keys[part].tolist(), blocks.blobs(), strict=True)
        self._taken[slots] = True
        return packed

    def _write_aside(self, count: int) -> int:
        part, self._aside = self._aside[:count], self._aside[count:]
        self._write(part)
        return len(part)

    def _write(self, part: list[tuple[int, memoryview]]) -> None:
        keys = np.array([key for key, _ in part], np.int64)
        self._store.put_packed(keys, np.full(len(part), self._frames), [voxels for _, voxels in part])

    def _let_go(self) -> None:
        if self._grid is not None:
            self._grid.watchers.remove(self._keep)
            self._grid = None
        self._aside.clear()
