"""Samples for the network of computed depth: the same for the same seed, and like what matching meets."""

from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.depth_from_motion.evidence import CHANNELS, HINT_CHANNELS, MEMBRANE
from semantic_mapper.training import depth_samples
from semantic_mapper.training.depth_samples import walk_samples

SEED = 90_000


@pytest.fixture(autouse=True)
def short_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_samples, "FRAMES", 8)


def test_a_walk_gives_finite_samples_with_and_without_hints_that_are_near_the_truth() -> None:
    samples = list(walk_samples(SEED))
    assert len(samples) > 2
    assert all(s.evidence.shape == (CHANNELS, 120, 160) and np.isfinite(s.evidence).all() for s in samples)
    off = [np.median(np.abs(s.evidence[MEMBRANE] - s.truth)) for s in samples]
    assert np.median(off) < 0.15
    hinted = [bool(s.evidence[HINT_CHANNELS.start + 1].any()) for s in samples]
    assert any(hinted) and not all(hinted)


def test_the_same_seed_gives_the_same_samples() -> None:
    for one, other in zip(walk_samples(SEED), walk_samples(SEED), strict=True):
        np.testing.assert_array_equal(one.evidence, other.evidence)
        np.testing.assert_array_equal(one.truth, other.truth)
