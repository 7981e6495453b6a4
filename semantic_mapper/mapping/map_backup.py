"""A map as it was, kept on disk beside the one that goes on: scratch space of this process, see ``block_store``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.block_grid import BlockGrid
from semantic_mapper.mapping.block_index import pack_keys
from semantic_mapper.mapping.block_store import BlockStore

_AT_ONCE = 256  # blocks


class MapBackup(NamedTuple):
    """Blocks, their packed keys (B,), and how far the map was."""

    store: BlockStore
    keys: NDArray[np.int64]
    frames: int
    last_stamp_ns: int


def take_backup(grid: BlockGrid, classes: int, frames: int, last_stamp_ns: int) -> MapBackup:
    """Copy all blocks of a grid with L = ``classes`` to disk.

    Raises:
        MapError: the disk is full or fails.
    """
    store, keys = BlockStore(classes), pack_keys(grid.all_keys())
    for part in _parts(keys):
        store.put(part, np.full(len(part), frames), grid.read(part))
    return MapBackup(store, keys, frames, last_stamp_ns)


def fill_from(backup: MapBackup, grid: BlockGrid) -> None:
    """Put the blocks into an empty grid, equal to the bit; the backup stays.

    Raises:
        MapError: the disk fails, or the grid has no room.
    """
    for part in _parts(backup.keys):
        grid.mark_changed(grid.fill(part, backup.store.get(part)), backup.frames)


def _parts(keys: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for start in range(0, len(keys), _AT_ONCE):
        yield keys[start : start + _AT_ONCE]
