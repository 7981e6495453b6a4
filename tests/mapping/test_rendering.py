from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.render import softmax
from semantic_mapper.mapping.rendering import (
    LEAST_SHARE,
    RateController,
    RenderedView,
    add_own_image,
    likeliest,
    upsample,
)


def test_depths_that_are_no_numbers_leave_every_pixel_with_one_of_its_neighbours():
    rng = np.random.default_rng(4)
    p = rng.random((6, 8, 3)).astype(np.float32)
    rgb, low = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
    odd = np.array([np.nan, np.inf, -np.inf, -1, 0, 1e-30, 1e30, 2], np.float32)
    depth, depth_low = rng.choice(odd, (24, 32)), rng.choice(odd, (6, 8))
    rows = upsample(p, np.ones((6, 8), bool), low, depth_low, rgb, depth)
    row, column = np.divmod(rows, 8)
    v, u = np.mgrid[0:24, 0:32] // 4
    near = (np.abs(row - v) <= 1) & (np.abs(column - u) <= 1)
    assert ((rows == -1) | near).all() and near.mean() > 0.5


@pytest.mark.parametrize("classes", [1, 8, 21, 256])
def test_probabilities_and_the_likeliest_class_are_those_of_numpy(classes: int):
    logits = np.random.default_rng(classes).normal(0, 20, (5, 7, classes)).astype(np.float32)
    raised = np.exp(logits.astype(np.float64) - logits.max(axis=2, keepdims=True))
    found = softmax(logits)
    np.testing.assert_allclose(found, raised / raised.sum(axis=2, keepdims=True), rtol=2e-5, atol=1e-30)
    channel, most = likeliest(found)
    assert np.array_equal(channel, found.argmax(axis=2)) and np.array_equal(most, found.max(axis=2))


def rendered(probabilities: np.ndarray, known: np.ndarray) -> RenderedView:
    return RenderedView(probabilities.astype(np.float32), known, np.ones(known.shape, np.float32), 1, 1)


def test_both_opinions_are_joined_as_their_geometric_mean_where_the_view_is_known(rng: np.random.Generator) -> None:
    view_p, own_p = rng.dirichlet(np.ones(4), (3, 5)), rng.dirichlet(np.ones(4), (3, 5))
    known = rng.random((3, 5)) < 0.7
    found = add_own_image(rendered(view_p, known), np.log(own_p), 0.3)
    expected = np.maximum(own_p, 1e-4) ** 0.3 * np.maximum(view_p, 1e-4) ** 0.7
    expected /= expected.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(found.probabilities[known], expected[known], atol=1e-5)
    np.testing.assert_array_equal(found.probabilities[~known], view_p.astype(np.float32)[~known])
    assert found.probabilities.dtype == np.float32
    where = rng.random((3, 5)) < 0.5
    between = add_own_image(rendered(view_p, known), np.log(own_p), 0.3, where).probabilities
    np.testing.assert_array_equal(between[where], found.probabilities[where])
    np.testing.assert_array_equal(between[~where], view_p.astype(np.float32)[~where])


PIXELS = 19_200
SAMPLING = SamplingConfig(guided=8, free_space=1)


def held(
    pace: RateController, sample_ms: float, other_ms: float, frames: int = 30
) -> tuple[float, SamplingConfig, float]:
    """Fraction, sampling and time of a frame after some frames on a machine of this speed."""
    fraction, sampling = pace.choose(PIXELS)
    for _ in range(frames):
        rays = round(fraction * PIXELS)
        pace.note(rays * sampling.guided * sample_ms, other_ms, rays, sampling.guided)
        fraction, sampling = pace.choose(PIXELS)
    return fraction, sampling, round(fraction * PIXELS) * sampling.guided * sample_ms + other_ms


def test_a_slower_machine_gives_up_rays_first_then_samples_and_holds_the_rate():
    fraction, sampling, ms = held(RateController(5, 0.5, SAMPLING), 0.002, 60)
    assert LEAST_SHARE < fraction < 0.5 and sampling == SAMPLING and ms == pytest.approx(180, abs=1)
    fraction, sampling, ms = held(RateController(5, 0.5, SAMPLING), 0.01, 60)
    assert 2 <= sampling.guided < 8 and sampling.guided - sampling.free_space >= 2
    assert fraction >= LEAST_SHARE and ms == pytest.approx(180, abs=1)
