from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.mapping.readout import decide


@pytest.mark.parametrize("votes", [0.3, 1.0, 4.0, 90.0])
@pytest.mark.parametrize("rho", [0.0, 0.5, 1.0])
def test_decision_is_the_discounted_softmax(votes: float, rho: float, rng: np.random.Generator) -> None:
    evidence = rng.uniform(-5, 0, 7) * votes
    n_eff = votes / (1 + rho * (votes - 1)) if votes > 1 else 1
    logits = evidence * n_eff / votes
    p = np.exp(logits - logits.max())
    p /= p.sum()
    channel, confidence = decide(evidence, votes, rho)
    assert channel == p.argmax()
    assert confidence == pytest.approx(p.max(), rel=1e-9)


def test_no_votes_no_decision() -> None:
    assert decide(np.zeros(4), 0.0, 0.5) == (-1, 0.0)


@pytest.mark.parametrize("weight", [1e-3, 0.2, 1.0])
def test_a_single_vote_means_what_the_field_said_however_little_it_is_trusted(weight: float) -> None:
    p = np.array([0.1, 0.85, 0.05])
    assert decide(weight * np.log(p), weight, 0.75) == (1, pytest.approx(0.85))


def test_agreement_for_ever_stays_below_the_effective_count() -> None:
    """With rho = 0.5 endless votes of p = 0.7 / 0.3 are worth two independent ones."""
    evidence = 1e5 * np.log(np.array([0.7, 0.3]))
    _, confidence = decide(evidence, 1e5, 0.5)
    assert confidence == pytest.approx(0.49 / (0.49 + 0.09), abs=1e-4)
