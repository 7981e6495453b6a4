"""The map as it was at one moment, while frames go on changing it: copy on write."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from itertools import islice
from pathlib import Path

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.localization.places import Place
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.block_grid import BlockGrid
from semantic_mapper.mapping.blocks import BlockValues, ScratchFile, find_sorted, unpack_blocks, unpack_keys
from semantic_mapper.mapping.map_file import CHUNK_BLOCKS, BlockPart, MapManifest, write_map
from semantic_mapper.types import Int64

MOST_IN_MEMORY = 2048  # copied blocks, some 20 KB each; of more, the first go to disk

_log = get_logger(__name__)


class FrozenMap:
    """A map as it was when this was made, to be written, or to be begun with again. Close it when it has served.

    A block of ``grid`` that is about to change is copied first, until ``close``. Where it cannot be copied, the frame
    that changes it goes on, and the next reading fails. The caller holds the ``lock`` of the map meanwhile."""

    def __init__(
        self,
        grid: BlockGrid,
        lock: AbstractContextManager[object],
        manifest: MapManifest,
        places: tuple[Place, ...],
        objects: bytes,
    ) -> None:
        self.manifest, self.places, self.objects = manifest, places, objects
        self._grid, self._lock = grid, lock
        self._keys = grid.all_packed()
        self._settled = np.zeros(len(self._keys), np.bool_)  # copied, or not needed any more
        self._copies: dict[int, bytes | memoryview] = {}  # in memory, oldest first
        self._scratch: ScratchFile | None = None
        self._failure: MapError | None = None
        grid.watchers.append(self._copy)

    def write(self, path: Path, between: Callable[[], object] = lambda: None) -> None:
        """Write a map file, whole or not at all; closes this. ``between`` is called after each ``CHUNK_BLOCKS``,
        without the lock; an error of its own ends the writing. ``MapError``: it cannot be written, or the disk fails; a
        file that was there is as it was."""
        try:
            manifest = write_map(path, self.manifest, self.parts(between, last=True), self.places, self.objects)
        finally:
            self.close()
        size = path.stat().st_size
        _log.info("map_saved", path=str(path), frames=manifest.frames, blocks=manifest.blocks, bytes=size)

    def parts(self, between: Callable[[], object] = lambda: None, *, last: bool = False) -> Iterator[BlockPart]:
        """All blocks in lexicographic order, ``CHUNK_BLOCKS`` at a time; the ``last`` time, copies go when read."""
        for start in range(0, len(self._keys), CHUNK_BLOCKS):
            packed = self._keys[start : start + CHUNK_BLOCKS]
            with self._lock:
                values = self._read(packed)
                if last:
                    self._settled[start : start + CHUNK_BLOCKS] = True
                    for key in packed.tolist():
                        self._copies.pop(key, None)
            yield unpack_keys(packed), values
            between()

    def close(self) -> None:
        """Give memory and disk back and watch the grid no more. Harmless when repeated."""
        with self._lock:
            if self._copy in self._grid.watchers:
                self._grid.watchers.remove(self._copy)
            self._copies.clear()
            if self._scratch is not None:
                self._scratch.close()

    def _read(self, packed: Int64) -> BlockValues:
        """Blocks (B,) bit for bit as they were."""
        if self._failure is not None:
            raise self._failure
        rows, _ = find_sorted(self._keys, packed)
        values, copied = self._grid.read(packed), np.flatnonzero(self._settled[rows])
        for array in values:
            array[copied] = 0
        keys = packed[copied].tolist()
        away = [key for key in keys if key not in self._copies]
        stored = dict(zip(away, self._scratch.get(away), strict=True)) if self._scratch is not None else {}
        unpack_blocks([stored[key] if key in stored else self._copies[key] for key in keys], values, copied)
        return values

    def _copy(self, packed: Int64) -> None:
        """Blocks (B,) are about to change."""
        rows, there = find_sorted(self._keys, packed)
        rows = np.unique(rows[there])
        rows = rows[~self._settled[rows]]
        if self._failure is not None or not len(rows):
            return
        try:
            keys = self._keys[rows]
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
