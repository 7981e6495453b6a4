"""Since when the blocks of a map are as they are, as far as somebody has watched it."""

from __future__ import annotations

import numpy as np

from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64


class BlockAges:
    """Follows the snapshots of a map; what was there in the first one counts as changed then."""

    def __init__(self) -> None:
        self._packed = np.empty(0, np.int64)
        self._serials = np.empty(0, np.int64)
        self._changed_s = np.empty(0, np.float64)

    def follow(self, snapshot: MapSnapshot, now_s: float) -> Float64:
        """Seconds (B,) since each block of a snapshot last changed, as seen here.

        Args:
            snapshot: A later one than before, of whichever mirror.
            now_s: When the map was like this, on any one clock.
        """
        changed_s = np.full(snapshot.block_count, now_s)
        if len(self._packed):
            row = np.minimum(np.searchsorted(self._packed, snapshot.packed), len(self._packed) - 1)
            same = (self._packed[row] == snapshot.packed) & (self._serials[row] == snapshot.serials)
            changed_s[same] = self._changed_s[row[same]]
        self._packed, self._serials, self._changed_s = snapshot.packed, snapshot.serials, changed_s
        return now_s - changed_s
