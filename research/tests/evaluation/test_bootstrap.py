from __future__ import annotations

import numpy as np
import pytest

from research.evaluation.bootstrap import paired_bootstrap
from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.labels import make_label_set

THREE = make_label_set("three", ["wall", "chair", "lamp"])


def scenes(rng: np.random.Generator, accuracy: float, count: int = 12, pixels: int = 400) -> list[ConfusionMatrix]:
    found = []
    for _ in range(count):
        truth = rng.integers(1, 4, pixels).astype(np.uint8)
        guess = rng.integers(0, 4, pixels).astype(np.uint8)
        found.append(confusion_of(truth, np.where(rng.random(pixels) < accuracy, truth, guess), THREE))
    return found


def test_a_clear_difference_has_an_interval_that_holds_it_and_not_zero(rng: np.random.Generator) -> None:
    good, bad = scenes(rng, 0.8), scenes(rng, 0.4)
    found = paired_bootstrap(good, bad, resamples=2000)
    whole = [sum(side, ConfusionMatrix(THREE)).metrics().miou for side in (good, bad)]
    assert whole[0] is not None and whole[1] is not None
    assert found.observed == pytest.approx(whole[0] - whole[1])
    assert 0 < found.low < found.observed < found.high
    assert found.mean == pytest.approx(found.observed, abs=0.01)
    reverse = paired_bootstrap(bad, good, resamples=2000)
    assert reverse.observed == -found.observed and reverse.high == pytest.approx(-found.low)


def test_two_scenes_by_hand() -> None:
    # First method: scene A all right, scene B all wrong; second method: nothing right. One class, so IoU = hits / all.
    right, wrong = np.array([1, 1], np.uint8), np.array([2, 2], np.uint8)
    first = [confusion_of(right, right, THREE), confusion_of(right, wrong, THREE)]
    second = [confusion_of(right, wrong, THREE)] * 2
    found = paired_bootstrap(first, second, resamples=4000)
    # Resamples draw AA (difference 1), AB or BA (1/2), BB (0) with probabilities 1/4, 1/2, 1/4.
    assert found.observed == pytest.approx(0.5)
    assert found.mean == pytest.approx(0.5, abs=0.02)
    assert (found.low, found.high) == (0, 1)


def test_equal_methods_do_not_differ_and_the_seed_decides(rng: np.random.Generator) -> None:
    same = scenes(rng, 0.5)
    assert paired_bootstrap(same, same, resamples=200).high == 0
    other = scenes(rng, 0.6)
    a, b = (paired_bootstrap(same, other, resamples=200, seed=s) for s in (1, 1))
    assert a == b


def test_other_numbers_of_scenes_and_a_single_one_are_refused(rng: np.random.Generator) -> None:
    few = scenes(rng, 0.5, count=2)
    with pytest.raises(ShapeError, match="same scenes"):
        paired_bootstrap(few, few[:1])
    with pytest.raises(ShapeError, match="at least 2"):
        paired_bootstrap(few[:1], few[:1])
