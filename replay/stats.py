"""What a session counts, in memory that does not grow with its length: a mapper may run for days."""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, TypeVar

import numpy as np

ItemT = TypeVar("ItemT")

BIN_GROWTH = 1.005  # each bin of a histogram of times is so much longer than the one before
SHORTEST_MS, LONGEST_MS = 1e-3, 1e7  # times beyond count as these
_BINS = math.ceil(math.log(LONGEST_MS / SHORTEST_MS) / math.log(BIN_GROWTH))


class BoundedLog(Generic[ItemT]):
    """Counts all items, and keeps the first ones and the last one.

    Args:
        most: How many of the first to keep.
    """

    def __init__(self, most: int) -> None:
        self.first: list[ItemT] = []
        self._most = most
        self._last: deque[ItemT] = deque(maxlen=1)
        self._count = 0

    def __len__(self) -> int:
        """How many there were, kept or not."""
        return self._count

    @property
    def last(self) -> ItemT:
        """The newest one.

        Raises:
            IndexError: there was none.
        """
        return self._last[0]

    def append(self, item: ItemT) -> None:
        """Count one more."""
        self._count += 1
        self._last.append(item)
        if len(self.first) < self._most:
            self.first.append(item)

    def skip(self, count: int) -> None:
        """Count this many more, of which nothing is known."""
        self._count += count


class LatencyHistogram:
    """Milliseconds of steps: the first one, and percentiles of the others, right to a quarter of a percent."""

    def __init__(self) -> None:
        self.first: float | None = None  # stands by itself: it may compile kernels, once on a machine
        self._counts = np.zeros(_BINS, np.int64)
        self._least, self._most = math.inf, -math.inf

    def add(self, ms: float) -> None:
        """Count one more step."""
        if self.first is None:
            self.first = ms
            return
        at = math.log(max(ms, SHORTEST_MS) / SHORTEST_MS) / math.log(BIN_GROWTH)
        self._counts[min(int(at), _BINS - 1)] += 1
        self._least, self._most = min(self._least, ms), max(self._most, ms)

    def percentile(self, percent: float) -> float | None:
        """As ``np.percentile`` of all steps but the first; of the first where it is the only one, None without any."""
        count = int(self._counts.sum())
        if not count:
            return self.first
        rank = percent / 100 * (count - 1)
        low, high = self._ranked(math.floor(rank)), self._ranked(math.ceil(rank))
        return low + (high - low) * (rank - math.floor(rank))

    def _ranked(self, rank: int) -> float:
        """About the time that this many are shorter than."""
        at = int(np.searchsorted(np.cumsum(self._counts), rank, side="right"))
        return min(max(SHORTEST_MS * BIN_GROWTH ** (at + 0.5), self._least), self._most)
