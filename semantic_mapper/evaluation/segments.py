"""Confusion matrices of stretches of a run, which comparisons of two runs draw from (a block bootstrap)."""

from __future__ import annotations

from dataclasses import dataclass

from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import LabelSet

MAX_SEGMENTS = 64


@dataclass(slots=True, eq=False)
class Segment:
    """Consecutive scored frames.

    Args:
        first: Number of its first frame among those that were scored.
        frames: How many there are.
        confusion: Of all their pixels.
    """

    first: int
    frames: int
    confusion: ConfusionMatrix


class Segments:
    """Up to 64 stretches of equal length, whatever the length of the run: neighbours are joined as it grows.

    Frames one after the other are nearly the same picture, so that a bootstrap over single frames would be too sure.
    The same frames scored give the same stretches.
    """

    def __init__(self, label_set: LabelSet) -> None:
        self.label_set = label_set
        self._frames_each = 1
        self._segments: list[Segment] = []

    def add(self, image: ConfusionMatrix) -> None:
        """Count the next scored frame."""
        last = self._segments[-1] if self._segments else None
        if last is not None and last.frames < self._frames_each:
            last.frames += 1
            last.confusion += image
            return
        first = 0 if last is None else last.first + last.frames
        self._segments.append(Segment(first, 1, ConfusionMatrix(self.label_set) + image))
        if len(self._segments) > MAX_SEGMENTS:
            self._join_neighbours()

    def _join_neighbours(self) -> None:
        """Half as many stretches, each twice as long; the last one stays short where it has no neighbour."""
        self._frames_each *= 2
        for one, other in zip(self._segments[::2], self._segments[1::2], strict=False):
            one.frames += other.frames
            one.confusion += other.confusion
        self._segments = self._segments[::2]

    def all(self) -> list[Segment]:
        """All stretches so far, in order."""
        return list(self._segments)
