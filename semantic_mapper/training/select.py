"""Which frames of a log to label: the few that show most of what the log shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import transform, unproject
from semantic_mapper.imaging import resize_depth, working_intrinsics
from semantic_mapper.types import PosedFrame

CELL_M = 0.1
CANDIDATE_WIDTH = 48


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """What the choice needs to know of a frame: the 10 cm cells (P, 3) int64 that its pixels fall in."""

    stamp_ns: int
    cells: NDArray[np.int64]


def candidate_from_frame(frame: PosedFrame) -> Candidate:
    """Reduce a frame to the cells it sees; none for a frame without depth."""
    intrinsics = working_intrinsics(frame.intrinsics, CANDIDATE_WIDTH)
    depth = resize_depth(frame, intrinsics)
    points = unproject(depth, intrinsics)[depth > 0]
    cells = np.floor(transform(frame.T_world_camera, points) / CELL_M).astype(np.int64)
    return Candidate(frame.stamp_ns, cells)


def choose_keyframes(candidates: Sequence[Candidate], count: int, seed: int) -> list[int]:
    """Greedy cover: each pick adds the cells that most pixels of the whole log fall in. Sorted indices.

    Labels play no part. Frames without depth are spread evenly over time instead. ``seed`` draws among picks that are
    within 2 % of the best.
    """
    count = min(count, len(candidates))
    if any(len(c.cells) == 0 for c in candidates):
        return sorted({int(i) for i in np.linspace(0, len(candidates) - 1, count + 2)[1:-1].round()})
    owner = np.repeat(np.arange(len(candidates)), [len(c.cells) for c in candidates])
    _, cell = np.unique(np.concatenate([c.cells for c in candidates]), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    worth = np.bincount(cell).astype(np.float64)
    pairs = np.unique(np.stack((owner, cell), axis=1), axis=0)
    rng = np.random.default_rng(seed)
    chosen: list[int] = []
    while len(chosen) < count:
        gain = np.bincount(pairs[:, 0], weights=worth[pairs[:, 1]], minlength=len(candidates))
        gain[chosen] = -1.0
        best = int(rng.choice(np.flatnonzero(gain >= 0.98 * gain.max())))
        chosen.append(best)
        worth[pairs[pairs[:, 0] == best, 1]] = 0
    return sorted(chosen)
