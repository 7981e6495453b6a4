"""What a map was at moments of its past, without a copy of all of it: only blocks that have changed since are kept.

Before a block changes for the first time after the newest moment, it is put aside, packed, and goes to disk little by
little (scratch space of this process, see ``block_store``). A block of an older moment is the first that was put aside
from that moment on, or else the one that the map has now. So a moment takes room for what changes until the next one,
and to forget the oldest costs nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.block_store import BlockStore
from semantic_mapper.mapping.voxel_map import VoxelMap

_WRITTEN_AT_ONCE = 256  # blocks
_MOST_ASIDE = 1024  # blocks in memory that wait for the disk, some 20 KB each


class _Moment:
    """The map of now, and room for its blocks as they are before they change."""

    def __init__(self, voxel_map: VoxelMap, grid: BlockGrid, number: int) -> None:
        self.number = number
        self.frames, self.last_stamp_ns = voxel_map.frames, voxel_map.last_stamp_ns
        self.keys = pack_keys(grid.all_keys())
        self.aside: list[tuple[int, memoryview]] = []
        self.store = BlockStore(len(voxel_map.label_set), voxel_map.config.evidence)
        self._taken = np.zeros(len(self.keys), np.bool_)  # in the store or aside

    def take(self, grid: BlockGrid, packed: NDArray[np.int64]) -> None:
        """Put those of these blocks (B,) aside that were there and have not been taken yet."""
        if not len(self.keys):
            return
        slots, there = self._slots(packed)
        slots = np.unique(slots[there & ~self._taken[slots]])
        keys = self.keys[slots]
        for part, blocks in grid.pack(keys):
            self.aside += zip(keys[part].tolist(), blocks.blobs(), strict=True)
        self._taken[slots] = True

    def holds(self, packed: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of these blocks (B,) are here as they were."""
        if not len(self.keys):
            return np.zeros(len(packed), np.bool_)
        slots, there = self._slots(packed)
        return there & self._taken[slots]

    def write(self, count: int) -> int:
        """Put so many blocks on disk, or as many as there are; returns how many."""
        count = written = min(count, len(self.aside))
        while written:
            some = self.aside[: min(written, _WRITTEN_AT_ONCE)]
            keys = np.array([key for key, _ in some], np.int64)
            self.store.put_packed(keys, np.full(len(some), self.frames), [voxels for _, voxels in some])
            del self.aside[: len(some)]  # only now: a full disk loses none
            written -= len(some)
        return count

    def _slots(self, packed: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Where these blocks (B,) are, or would be, among the keys, and whether they are."""
        slots = np.minimum(np.searchsorted(self.keys, packed), len(self.keys) - 1)
        return slots, self.keys[slots] == packed


class MapJournal:
    """Moments of a map's past, oldest first, each by a number that the caller gives. Safe to call from several threads.

    Args:
        voxel_map: Is watched until ``close``.
        number: Of the first moment, which is now.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, voxel_map: VoxelMap, number: int) -> None:
        self._map = voxel_map
        self._failure: MapError | None = None
        with voxel_map.locked() as grid:
            self._grid = grid
            self._moments = [_Moment(voxel_map, grid, number)]
            grid.watchers.append(self._keep)

    @property
    def numbers(self) -> list[int]:
        """Of all moments, oldest first; never empty."""
        return [moment.number for moment in self._moments]

    @property
    def waiting(self) -> int:
        """Blocks that wait in memory for the disk."""
        return sum(len(moment.aside) for moment in self._moments)

    @property
    def disk_bytes(self) -> int:
        """Size of the files."""
        return sum(moment.store.file_bytes for moment in self._moments)

    def belong_to(self, voxel_map: VoxelMap) -> None:
        """Follow a map that has taken over the one watched so far."""
        self._map = voxel_map

    def mark(self, number: int) -> None:
        """Begin a new moment, which is now.

        Raises:
            MapError: as for the class.
        """
        with self._map.locked():
            self._moments.append(_Moment(self._map, self._grid, number))

    def forget_oldest(self) -> None:
        """Give back what the oldest moment takes; there has to be another one."""
        with self._map.locked():
            self._moments.pop(0).store.close()

    def go_on(self, blocks: int | None = None) -> None:
        """Put so many of the blocks that wait in memory on disk, or all.

        Raises:
            MapError: the disk is full or fails, or has failed since the last call.
        """
        with self._map.locked():
            if self._failure is not None:
                raise self._failure
            left = self.waiting if blocks is None else blocks
            for moment in self._moments:
                left -= moment.write(left)

    def oldest_keys(self) -> NDArray[np.int64]:
        """Packed keys (B,) of the blocks that the map had at the oldest moment."""
        return self._moments[0].keys

    def restore(self, voxel_map: VoxelMap, keys: NDArray[np.int64]) -> None:
        """Put blocks (B,) of ``oldest_keys`` into another map, bit for bit as they were at the oldest moment.

        Raises:
            MapError: the disk fails, or the map has no room.
        """
        with self._map.locked(), voxel_map.locked() as grid:
            self.go_on()  # what is on disk can be read
            oldest = self._moments[0]
            for moment in self._moments:
                held = moment.holds(keys)
                if held.any():
                    grid.mark_changed(grid.fill(keys[held], moment.store.get(keys[held])), oldest.frames)
                keys = keys[~held]
            if len(keys):  # have not changed since
                grid.mark_changed(grid.fill(keys, self._grid.read(keys)), oldest.frames)
            voxel_map.frames = voxel_map.version = oldest.frames
            voxel_map.last_stamp_ns = oldest.last_stamp_ns

    def close(self) -> None:
        """Give the disk space back; the map is watched no more. Harmless when repeated."""
        with self._map.locked():
            if self._keep in self._grid.watchers:
                self._grid.watchers.remove(self._keep)
            for moment in self._moments:
                moment.aside.clear()
                moment.store.close()

    def _keep(self, packed: NDArray[np.int64]) -> None:
        """Blocks (B,) are about to be used. A failure is the journal's, not the frame's that is being fused."""
        if self._failure is not None:
            return
        try:
            self._moments[-1].take(self._grid, packed)
            if self.waiting > _MOST_ASIDE:
                self.go_on(self.waiting - _MOST_ASIDE)
        except MapError as error:
            self._failure = error
