"""Which frames of a log to label: the few that show most of what the log shows, or most that no labelled frame shows.

What a frame shows are the 10 cm cells that its pixels fall in. A cell is worth as much as pixels of the whole log fall
in it; what a chosen frame shows is taken from the worth of the others.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import transform, unproject
from semantic_mapper.imaging import resize_depth, working_intrinsics
from semantic_mapper.types import Float64, PosedFrame

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
    Frames without depth are spread evenly over time instead. ``seed`` draws among picks within 2 % of the best."""
    count = min(count, len(candidates))
    if any(len(c.cells) == 0 for c in candidates):
        return sorted({int(i) for i in np.linspace(0, len(candidates) - 1, count + 2)[1:-1].round()})
    owner, cell, worth = _cells(candidates)
    rng = np.random.default_rng(seed)
    chosen: list[int] = []
    while len(chosen) < count:
        gain = np.bincount(owner, weights=worth[cell], minlength=len(candidates))
        gain[chosen] = -1.0
        best = int(rng.choice(np.flatnonzero(gain >= 0.98 * gain.max())))
        chosen.append(best)
        worth[cell[owner == best]] = 0
    return sorted(chosen)


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A frame to label."""

    index: int  # of the candidate
    # Fraction of the log's pixels that it adds to what labelled and earlier suggested frames show; None without depth
    gain: float | None
    shown: float | None  # fraction that all of them show then; None likewise


def suggest_frames(candidates: Sequence[Candidate], count: int, labelled: Collection[int] = ()) -> list[Suggestion]:
    """The most useful frames to label, best first; fewer where the others would add nothing.

    Where no candidate has depth, each suggestion is the frame farthest in time from all labelled ones. ``labelled``:
    indices of candidates.
    """
    if not any(len(c.cells) for c in candidates):
        return [Suggestion(index, None, None) for index in _farthest_in_time(candidates, count, labelled)]
    owner, cell, worth = _cells(candidates)
    total = worth.sum()
    taken = list(labelled)
    worth[cell[np.isin(owner, taken)]] = 0
    found: list[Suggestion] = []
    while len(found) < count:
        gain = np.bincount(owner, weights=worth[cell], minlength=len(candidates))
        gain[taken] = 0
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        worth[cell[owner == best]] = 0
        taken.append(best)
        found.append(Suggestion(best, float(gain[best] / total), float(1 - worth.sum() / total)))
    return found


def _cells(candidates: Sequence[Candidate]) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """Pairs of a candidate and a cell that it shows, each once: both (Q,); and what each cell is worth."""
    sizes = [len(c.cells) for c in candidates]
    _, cell = np.unique(np.concatenate([c.cells for c in candidates]), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    worth = np.bincount(cell).astype(np.float64)
    pairs = np.unique(np.stack((np.repeat(np.arange(len(candidates)), sizes), cell), axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1], worth


def _farthest_in_time(candidates: Sequence[Candidate], count: int, labelled: Collection[int]) -> list[int]:
    """Indices of frames, each as long as can be before and after all that are labelled or chosen."""
    stamps = np.array([c.stamp_ns for c in candidates], np.float64)
    distance = np.full(len(stamps), np.inf)
    chosen: list[int] = []
    for index in labelled:
        distance = np.minimum(distance, np.abs(stamps - stamps[index]))
    while len(chosen) < min(count, len(stamps)) and distance.max() > 0:
        first = not np.isfinite(distance).all()  # nothing is labelled: the middle
        best = int(np.abs(stamps - stamps.mean()).argmin() if first else distance.argmax())
        distance = np.minimum(distance, np.abs(stamps - stamps[best]))
        chosen.append(best)
    return chosen
