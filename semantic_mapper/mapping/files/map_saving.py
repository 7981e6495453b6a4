"""Saving a map while frames go on changing it: copy on write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.localization.places import Place
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.files.map_file import CHUNK_BLOCKS, BlockPart, MapManifest, write_map
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import unpack_keys
from semantic_mapper.mapping.storage.block_store import BlockValues, find_sorted, unpack_blocks
from semantic_mapper.mapping.storage.scratch import ScratchFile

MOST_IN_MEMORY = 2048  # copied blocks, some 20 KB each; of more, the first go to disk

_log = get_logger(__name__)


class GridSnapshot:
    """The blocks of a grid as they were when this was made; each can be taken once.

    A block that is about to change is copied first. The caller of any of this, or a method of the grid, holds the lock
    of the map. Where a block cannot be copied, the frame that changes it goes on; the next ``take`` fails.

    Args:
        grid: Is watched until ``close``.
    """

    def __init__(self, grid: BlockGrid) -> None:
        self._grid = grid
        self.keys = grid.all_packed()
        self._settled = np.zeros(len(self.keys), np.bool_)  # copied or taken
        self._copies: dict[int, memoryview] = {}  # in memory, oldest first
        self._scratch: ScratchFile | None = None
        self._failure: MapError | None = None
        grid.watchers.append(self._copy)

    def take(self, packed: NDArray[np.int64]) -> BlockValues:
        """Blocks (B,) of ``keys``, bit for bit as they were; nobody takes them again.

        Raises:
            MapError: the disk is full or fails, or has failed.
        """
        if self._failure is not None:
            raise self._failure
        rows, _ = find_sorted(self.keys, packed)
        values, copied = self._grid.read(packed), np.flatnonzero(self._settled[rows])
        self._settled[rows] = True
        for array in values:
            array[copied] = 0
        keys = packed[copied].tolist()
        away = [key for key in keys if key not in self._copies]
        stored = dict(zip(away, self._scratch.get(away), strict=True)) if self._scratch is not None else {}
        unpack_blocks([stored[key] if key in stored else self._copies.pop(key) for key in keys], values, copied)
        return values

    def close(self) -> None:
        """Give memory and disk back and watch the grid no more. Harmless when repeated."""
        if self._copy in self._grid.watchers:
            self._grid.watchers.remove(self._copy)
        self._copies.clear()
        if self._scratch is not None:
            self._scratch.close()

    def _copy(self, packed: NDArray[np.int64]) -> None:
        """Blocks (B,) are about to change."""
        rows, there = find_sorted(self.keys, packed)
        rows = np.unique(rows[there])
        rows = rows[~self._settled[rows]]
        if self._failure is not None or not len(rows):
            return
        try:
            keys = self.keys[rows]
            for part, blocks in self._grid.pack(keys):
                self._copies.update(zip(keys[part].tolist(), blocks.blobs(), strict=True))
            self._settled[rows] = True
            excess = dict(islice(self._copies.items(), max(0, len(self._copies) - MOST_IN_MEMORY)))
            if excess:
                if self._scratch is None:
                    self._scratch = ScratchFile("blocks", "choose another folder by it")
                self._scratch.put(list(excess), list(excess.values()))
                for key in excess:  # only now: a full disk loses none
                    del self._copies[key]
        except MapError as error:
            self._failure = error


class MapSaving:
    """The map as it was when this was made; to be written once, by whichever thread.

    Until it is written, blocks that frames change are put aside first: write it soon.

    Args:
        locked: Gives the storage of the map, alone; it is held while this is made.
        manifest: Settings, classes and counters of the map.
        places: What the map is found again by.
    """

    def __init__(
        self,
        locked: Callable[[], AbstractContextManager[BlockGrid]],
        manifest: MapManifest,
        places: tuple[Place, ...] = (),
    ) -> None:
        self._locked = locked
        self._manifest = manifest
        self._places = places
        with locked() as grid:
            self._snapshot = GridSnapshot(grid)

    def write(self, path: Path, between: Callable[[], object] = lambda: None) -> None:
        """Write the file, whole or not at all, in memory for ``CHUNK_BLOCKS``.

        Args:
            path: Of the file.
            between: Called after every ``CHUNK_BLOCKS``, without the lock; an error of its own ends the writing.

        Raises:
            MapError: the file cannot be written; one that was there before is as it was.
        """
        try:
            manifest = write_map(path, self._manifest, self._parts(between), self._places)
        finally:
            with self._locked():
                self._snapshot.close()
        _log.info(
            "map_saved", path=str(path), frames=manifest.frames, blocks=manifest.blocks, bytes=path.stat().st_size
        )

    def _parts(self, between: Callable[[], object]) -> Iterator[BlockPart]:
        keys = self._snapshot.keys
        for start in range(0, len(keys), CHUNK_BLOCKS):
            part = keys[start : start + CHUNK_BLOCKS]
            with self._locked():
                values = self._snapshot.take(part)
            yield unpack_keys(part), values
            between()
