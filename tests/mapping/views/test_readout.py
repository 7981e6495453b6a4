from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.fusion.depth_trust import MEASURED
from semantic_mapper.mapping.views.readout import decide, read_points
from tests.mapping.grids import corners, random_grid, sums_of


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


def test_below_the_threshold_the_class_is_unknown_and_the_confidence_stays() -> None:
    evidence = np.log(np.array([0.3, 0.6, 0.1]))
    assert decide(evidence, 1.0, 0.75, 0.55) == (1, pytest.approx(0.6))
    assert decide(evidence, 1.0, 0.75, 0.65) == (-1, pytest.approx(0.6))


@pytest.mark.parametrize("weight", [1e-3, 0.2, 1.0])
def test_a_single_vote_means_what_the_field_said_however_little_it_is_trusted(weight: float) -> None:
    p = np.array([0.1, 0.85, 0.05])
    assert decide(weight * np.log(p), weight, 0.75) == (1, pytest.approx(0.85))


def test_agreement_for_ever_stays_below_the_effective_count() -> None:
    """With rho = 0.5 endless votes of p = 0.7 / 0.3 are worth two independent ones."""
    evidence = 1e5 * np.log(np.array([0.7, 0.3]))
    _, confidence = decide(evidence, 1e5, 0.5)
    assert confidence == pytest.approx(0.49 / (0.49 + 0.09), abs=1e-4)


@pytest.mark.parametrize("evidence", ["float32", "int16"])
def test_points_are_read_as_plain_numpy_reads_them(evidence: str, rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng, evidence)
    labels, rho, sums = (
        make_label_set("four", ("a", "b", "c", "d"), ids=(7, 1, 4, 2), ignore_id=0),
        0.4,
        sums_of(buffers),
    )
    points = rng.uniform(-12, 18, (400, 3))
    points[::5] = np.round(points[::5])  # at voxels: the others count nothing
    rgb, label, confidence, measured = read_points(points, index, buffers, labels, rho, 0.0)
    assert 20 < measured.sum() < len(points) - 20
    for n, p in enumerate(points):
        around = [(f, at) for f, at in corners(buffers, p) if f >= 1e-3]
        seen = [(f, at) for f, at in around if buffers.weight[at] > 0]
        assert measured[n] == (bool(seen) and min(buffers.weight[at] for _, at in seen) >= MEASURED)
        color = sum((f * buffers.color[at].astype(float) for f, at in seen), np.zeros(3)) / (
            sum(f for f, _ in seen) or 1
        )
        np.testing.assert_allclose(rgb[n], color, atol=0.501)
        voted = [(f, at) for f, at in around if buffers.votes[at] > 0]
        fraction = sum(f for f, _ in voted)
        if not voted:
            assert (label[n], confidence[n]) == (0, 0.0)
            continue
        total, votes = (
            sum(f * sums[at] for f, at in voted) / fraction,
            sum(f * buffers.votes[at] for f, at in voted) / fraction,
        )
        worth = 1 / (1 + rho * (votes - 1)) if votes > 1 else 1 / votes
        p_class = np.exp((total - total.max()) * worth)
        assert label[n] == labels.ids[int(total.argmax())]
        assert confidence[n] == pytest.approx(p_class.max() / p_class.sum(), rel=1e-5)


def test_points_beyond_all_numbers_do_no_harm_and_unknown_ones_are_unknown(rng: np.random.Generator) -> None:
    index, buffers = random_grid(rng)
    labels = make_label_set("four", ("a", "b", "c", "d"), ignore_id=0)
    wild = np.array([[np.nan] * 3, [np.inf, 0, 0], [1e300, -1e300, 0], [-1e19] * 3, [1e9] * 3])
    assert np.isin(read_points(wild, index, buffers, labels, 0.5, 0.0)[1], (0, *labels.ids)).all()
    for points in (np.full((2, 3), 300.0), wild[:0]):
        assert not any(values.any() for values in read_points(points, index, buffers, labels, 0.5, 0.0))
