"""Fit how a segmenter joins the vote on some recordings, and test that on others.

python -m research.experiments.fit_segmenter DIR TABLE --fit kitchen --test flat kitchen val [--every 8]

DIR is that of ``kept_votes --segmenter``. Coarse pixels of every so many-th frame, each shown to the segmenter, as the
mapper joins them. ``NAME:0/2`` are the even ones of these frames, ``NAME:1/2`` the odd ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from research.experiments.kept_votes import Kept, load_all
from semantic_mapper.config import SegmenterConfig
from semantic_mapper.evaluation.metrics import ConfidenceScores, ConfusionMatrix
from semantic_mapper.imaging import resize_label
from semantic_mapper.labels import IGNORE_CHANNEL, LabelSet
from semantic_mapper.mapping.rendering import RenderedView
from semantic_mapper.mapping.segmenter import Opinion, Segmenter

GRID = {
    "miss": (0.3, 0.5, 0.7, 0.85),
    "false_alarm": (0.01, 0.02, 0.05, 0.1, 0.2),
    "weight": (0.5, 1.0),
    "temperature": (1.0, 2.0),
}
OFF = {"weight": 0.0}


class Score(NamedTuple):
    """Of the coarse pixels of some frames."""

    miou: float
    ece: float
    nll: float  # mean of -log p of the true class, nats


class Replayed(Segmenter):
    """A segmenter whose outputs were kept, with another table."""

    def with_table(self, values: dict[str, float]) -> None:
        """Go on with other values."""
        self._first = getattr(self, "_first", self.table)
        self._use(msgspec.structs.replace(self._first, **values))

    def opinion(self, kept: Kept) -> Opinion:
        """Of a frame that is shown to it."""
        values = self._likelihood(kept.asked, kept.known.shape)
        return Opinion(values[..., :-1], self._group, values[..., -1] > 1)


def score(frames: Sequence[Kept], segmenter: Replayed, labels: LabelSet, values: dict[str, float]) -> Score:
    """Of frames, joined by a table with some values."""
    segmenter.with_table(values)
    confusion, sure, losses = ConfusionMatrix(labels), ConfidenceScores(), list[float]()
    for kept in frames:
        assert kept.frame.label is not None
        truth = resize_label(kept.frame.label, kept.coarse)
        view = RenderedView(kept.rendered, kept.known, kept.rendered[..., 0])
        p = segmenter.opinion(kept).join(view).probabilities
        label = np.where(kept.known, labels.to_ids(p.argmax(axis=2)), labels.ignore_id).astype(np.uint8)
        confusion.update(truth, label, "frame")
        channel = labels.to_channels(truth, "frame")
        at = np.nonzero((channel != IGNORE_CHANNEL) & kept.known)
        sure.update(p.max(axis=2)[at], (label == truth)[at], np.zeros(len(at[0]), np.bool_))
        losses.append(float(-np.log(np.maximum(p[*at, channel[at]], 1e-6)).mean()))
    return Score(confusion.metrics().miou or 0.0, sure.calibration_error or 0.0, float(np.mean(losses)))


def frames_of(folder: Path, name: str, every: int) -> tuple[LabelSet, list[Kept]]:
    """Classes and frames of a source, its recordings one after the other."""
    name, _, part = name.partition(":")
    first, step = map(int, part.split("/")) if part else (0, 1)
    recordings = list(load_all(folder, name))
    found = [kept for r in recordings for kept in r.frames[:: every if len(r.frames) > 4 * every else 1]]
    return recordings[0].label_set, found[first::step]


def main() -> None:
    """Fit and test what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("table")
    parser.add_argument("--fit", nargs="+", required=True, help="sources; A+B: the mean of two")
    parser.add_argument("--test", nargs="+", required=True)
    parser.add_argument("--every", type=int, default=8)
    given = parser.parse_args()
    grid = [OFF, {}, *(dict(zip(GRID, values, strict=True)) for values in product(*GRID.values()))]
    found: dict[str, list[Score]] = {}
    for name in sorted({n for of in (*given.fit, *given.test) for n in of.split("+")}):
        labels, frames = frames_of(given.folder, name, given.every)
        segmenter = Replayed(SegmenterConfig(table=given.table), labels)
        found[name] = [score(frames, segmenter, labels, values) for values in grid]
    print(
        f"| fitted on | {' | '.join(GRID)} | {' | '.join(given.test)} |\n|{'---|' * (1 + len(GRID) + len(given.test))}"
    )
    chosen = {"no segmenter": 0, "the table as it is": 1}
    for of in given.fit:
        means = np.mean([found[name] for name in of.split("+")], axis=0)  # (grid, figures of ``Score``)
        chosen |= {f"{of}, by mIoU": int(means[:, 0].argmax()), f"{of}, by likelihood": int(means[:, 2].argmin())}
    for of, at in chosen.items():
        cells = [str(grid[at].get(key, "-")) for key in GRID]
        scores = (found[name][at] for name in given.test)
        cells += [f"{100 * s.miou:.1f}; {100 * s.ece:.1f}; {s.nll:.3f}" for s in scores]
        print(f"| {of} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
