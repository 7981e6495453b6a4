"""Which blocks lost surface because a frame saw through it: the latest rows, for who asks what has gone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class ClearedLog:
    """The rows of one map; each new one takes the place of the oldest beyond ``MAX_ROWS``."""

    def __init__(self) -> None:
        self._ring = ClearedBlocks(*np.empty((4, MAX_ROWS), np.int64))
        self._added = 0

    def add(self, packed: NDArray[np.int64], voxels: NDArray[np.int64], version: int, stamp_ns: int) -> None:
        """Note how many voxels (B,) of blocks with keys (B,) a frame has cleared; blocks of 0 are left out."""
        rows = np.flatnonzero(voxels)
        latest = rows[-len(self._ring.packed) :]
        self._added += len(rows)
        places = np.arange(self._added - len(latest), self._added) % len(self._ring.packed)
        for column, values in zip(self._ring, (packed[latest], voxels[latest], version, stamp_ns), strict=True):
            column[places] = values

    def between(self, after: int, up_to: int) -> ClearedBlocks:
        """The rows of versions above ``after``, up to ``up_to``."""
        version = self._ring.version[: self._added]
        chosen = np.flatnonzero((version > after) & (version <= up_to))
        if not len(chosen):
            return NONE_CLEARED
        chosen = chosen[np.argsort((chosen - self._added) % len(self._ring.packed))]
        return ClearedBlocks(*(column[chosen] for column in self._ring))
