"""What a process beside it costs a mapper's step: the same frames over and over, with it at work and with it frozen.

Frames are played in laps. In each lap every other block of frames is mapped while the process is frozen; in the next
lap, the other blocks are. So each frame is mapped in both ways, one lap apart, and half of them either way first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

BLOCK = 6  # frames between freezing and thawing
BLOCKS = 4  # of a lap; even, so that a lap has as many frames in one way as in the other
LAP = BLOCK * BLOCKS


@dataclass(frozen=True, slots=True)
class Turn:
    """One frame of a lap.

    Args:
        loop: Which of the stretches of frames that are played in laps.
        lap: From 0.
        place: Of the frame in its lap.
    """

    loop: int
    lap: int
    place: int

    @property
    def frozen(self) -> bool:
        """Whether the process is to be frozen meanwhile."""
        return (self.place // BLOCK + self.lap) % 2 == 1

    @property
    def counts(self) -> bool:
        """Not what warms up: the first lap, and the first frame of a block, which may have had both."""
        return self.lap > 0 and self.place % BLOCK > 0

    def after(self) -> Turn:
        """The next one."""
        last = self.place == LAP - 1
        return Turn(self.loop, self.lap + last, 0 if last else self.place + 1)


def slowdown(steps: Sequence[tuple[Turn, float]]) -> dict[str, Any]:
    """Steps beside a process at work against those of the same frames beside a frozen one.

    The last lap of a loop is left out: the work may have ended in it.

    Args:
        steps: Each with how long it took, ms.

    Returns:
        Median and 95th percentile of both in ms, their ratios, median and quartiles of the ratios frame by frame, and
        the number of pairs; empty where there are none.
    """
    last = {turn.loop: turn.lap for turn, _ in steps}
    took = {(t.loop, t.lap, t.place): (t, ms) for t, ms in steps if t.counts and t.lap < last[t.loop]}
    pairs: list[tuple[float, float]] = []  # without, with
    for turn, ms in took.values():
        other = took.get((turn.loop, turn.lap + 1, turn.place))
        if turn.lap % 2 == 1 and other is not None:  # laps 1 and 2, 3 and 4, ...
            pairs.append((ms, other[1]) if turn.frozen else (other[1], ms))
    if not pairs:
        return {}
    without, beside = np.array(pairs).T
    ratios = np.percentile(beside / without, (25, 50, 75))
    return {
        "step_ms_without": {"median": float(np.median(without)), "p95": float(np.percentile(without, 95))},
        "step_ms_with": {"median": float(np.median(beside)), "p95": float(np.percentile(beside, 95))},
        "ratio_of_medians": float(np.median(beside) / np.median(without)),
        "ratio_of_p95": float(np.percentile(beside, 95) / np.percentile(without, 95)),
        "ratio_median": float(ratios[1]),
        "ratio_quartiles": [float(ratios[0]), float(ratios[2])],
        "pairs": len(pairs),
    }
