"""How sure a difference between two methods is: paired bootstrap over the scenes that both were scored on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, class_sums
from semantic_mapper.types import Float64

RESAMPLES = 10_000
_AT_ONCE = 1000  # resamples; bounds the memory of their confusion matrices


@dataclass(frozen=True, slots=True)
class Difference:
    """mIoU of one method minus that of another, in 0..1.

    Args:
        observed: On the scenes as they are.
        mean: Over the resamples.
        low, high: Ends of the interval that holds 95 % of the resamples.
        scenes: How many there were.
    """

    observed: float
    mean: float
    low: float
    high: float
    scenes: int


def paired_bootstrap(
    first: Sequence[ConfusionMatrix],
    second: Sequence[ConfusionMatrix],
    *,
    factor: float = 1.0,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Difference:
    """Percentile interval of the difference in data-set mIoU, ``first`` minus ``second``.

    Each resample draws as many scenes as there are, with replacement and the same ones for both methods, and adds up
    their confusion matrices (Efron and Tibshirani 1993, chapter 13). Raises ShapeError: other numbers of scenes, or
    fewer than 2.

    Args:
        first, second: One matrix a scene, the same scenes in the same order.
        factor: ``second`` counts this many times.
        resamples: How many are drawn.
        seed: Of the draws.
    """
    if len(first) != len(second) or len(first) < 2:
        raise ShapeError(
            f"a paired bootstrap needs the same scenes for both, at least 2; got {len(first)} and {len(second)}"
        )
    counts = np.stack([[m.counts for m in first], [m.counts for m in second]]).astype(np.float64)  # (2, S, L, L + 1)
    scenes = len(first)
    rng = np.random.default_rng(seed)
    differences: list[Float64] = []
    for start in range(0, resamples, _AT_ONCE):
        draws = min(_AT_ONCE, resamples - start)
        times = rng.multinomial(scenes, np.full(scenes, 1 / scenes), size=draws).astype(np.float64)  # (B, S)
        differences.append(_difference(counts, times, factor))
    drawn = np.concatenate(differences)
    drawn = drawn[np.isfinite(drawn)]
    low, high = np.percentile(drawn, (2.5, 97.5))
    observed = float(_difference(counts, np.ones((1, scenes)), factor)[0])
    return Difference(observed, float(drawn.mean()), float(low), float(high), scenes)


def _difference(counts: Float64, times: Float64, factor: float) -> Float64:
    """(2, S, L, L + 1) counts, (B, S) how often each scene was drawn -> (B,) difference in mIoU."""
    first, second = (miou_of_counts(np.einsum("bs,slc->blc", times, c, optimize=True)) for c in counts)
    return first - factor * second


def miou_of_counts(counts: NDArray[np.float64]) -> Float64:
    """(B, L, L + 1) -> (B,), the rules of ``ConfusionMatrix.iou``: means over classes in the truth, NaN for none."""
    hits, occurring, union = np.moveaxis(class_sums(counts), -2, 0)
    iou = np.divide(hits, union, out=np.zeros_like(hits), where=occurring > 0)
    present = (occurring > 0).sum(axis=-1)
    return np.divide(iou.sum(axis=-1), present, out=np.full(present.shape, np.nan), where=present > 0)
