"""Which frames of a log to label next: those that show most surface that no labelled frame shows.

What a frame shows are the 10 cm cells that its pixels fall in (``select``). A cell is worth as much as pixels of the
whole log fall in it. Each suggestion takes what it shows from the worth of the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.training.select import Candidate
from semantic_mapper.types import Float64


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A frame to label.

    Args:
        index: Of the candidate.
        gain: Fraction of the log's pixels that it adds to what labelled and earlier suggested frames show; None where
            the frames have no depth.
        shown: Fraction that all of them show then; None likewise.
    """

    index: int
    gain: float | None
    shown: float | None


def suggest_frames(
    candidates: Sequence[Candidate],
    count: int,
    labelled: Collection[int] = (),
    weights: Sequence[Float64] | None = None,
) -> list[Suggestion]:
    """The most useful frames to label, best first; fewer where the others would add nothing.

    Where no candidate has depth, each suggestion is the frame farthest in time from all labelled ones.

    Args:
        candidates: Frames in the order of the log, labelled ones among them.
        count: Wanted.
        labelled: Indices of those whose labels are known.
        weights: (P,) what each of a candidate's pixels counts, one array a candidate; None = all alike.
    """
    if not any(len(c.cells) for c in candidates):
        return [Suggestion(index, None, None) for index in _farthest_in_time(candidates, count, labelled)]
    owner, cell, worth = _cells(candidates, weights)
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


def _cells(
    candidates: Sequence[Candidate], weights: Sequence[Float64] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """Pairs of a candidate and a cell that it shows, each once: both (Q,); and what each cell is worth."""
    sizes = [len(c.cells) for c in candidates]
    _, cell = np.unique(np.concatenate([c.cells for c in candidates]), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    worth = np.bincount(cell, weights=None if weights is None else np.concatenate(weights)).astype(np.float64)
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
