"""What a map was at moments of its past: its grid's snapshots (``grid_snapshots``) and its counters then."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.storage.grid_snapshots import GridSnapshots
from semantic_mapper.mapping.voxel_map import VoxelMap


class _Mark(NamedTuple):
    """Counters of a map at one moment."""

    number: int
    frames: int
    last_stamp_ns: int


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
        with voxel_map.locked() as grid:
            self._snapshots = GridSnapshots(grid)
            self._marks = [_Mark(number, voxel_map.frames, voxel_map.last_stamp_ns)]

    @property
    def numbers(self) -> list[int]:
        """Of all moments, oldest first; never empty."""
        return [mark.number for mark in self._marks]

    @property
    def in_memory(self) -> int:
        """Copied blocks that wait for the disk."""
        return self._snapshots.in_memory

    @property
    def disk_bytes(self) -> int:
        """Size of the files."""
        return self._snapshots.disk_bytes

    def belong_to(self, voxel_map: VoxelMap) -> None:
        """Follow a map that has taken over the one watched so far."""
        self._map = voxel_map

    def mark(self, number: int) -> None:
        """Begin a new moment, which is now.

        Raises:
            MapError: as for the class.
        """
        with self._map.locked():
            self._snapshots.take()
            self._marks.append(_Mark(number, self._map.frames, self._map.last_stamp_ns))

    def forget_oldest(self) -> None:
        """Give back what the oldest moment takes; there has to be another one."""
        with self._map.locked():
            self._snapshots.drop_oldest()
            self._marks.pop(0)

    def write(self, blocks: int | None = None) -> None:
        """Put this many of the blocks that wait in memory on disk, or all.

        Raises:
            MapError: the disk is full or fails, or has failed since the last call.
        """
        with self._map.locked():
            self._snapshots.write(blocks)

    def oldest_keys(self) -> NDArray[np.int64]:
        """Packed keys (B,) of the blocks that the map had at the oldest moment."""
        return self._snapshots.keys

    def restore(self, voxel_map: VoxelMap, keys: NDArray[np.int64]) -> None:
        """Put blocks (B,) of ``oldest_keys`` into another map, bit for bit as they were at the oldest moment.

        Raises:
            MapError: the disk fails, or the map has no room.
        """
        with self._map.locked(), voxel_map.locked() as grid:
            oldest = self._marks[0]
            grid.mark_changed(grid.fill(keys, self._snapshots.read(keys)), oldest.frames)
            voxel_map.frames = voxel_map.version = oldest.frames
            voxel_map.last_stamp_ns = oldest.last_stamp_ns

    def close(self) -> None:
        """Give the disk space back; the map is watched no more. Harmless when repeated."""
        with self._map.locked():
            self._snapshots.close()
