from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.mapping.rendering import (
    COLOUR_RATE,
    DEPTH_SIGMA,
    LARGEST_STEP,
    LEAST_SHARE,
    LEAST_WEIGHT,
    RateController,
    RenderedView,
    add_own_image,
    upsample,
)


def spoken_by(v, u, p, known, rgb_low, depth_low, rgb, depth):
    """The rule of ``upsample`` in plain words, for one pixel where the classes differ."""
    height, width = known.shape
    y, x = (v + 0.5) * height / depth.shape[0] - 0.5, (u + 0.5) * width / depth.shape[1] - 0.5
    j0, i0 = math.floor(y + 0.5), math.floor(x + 0.5)
    round_it = [
        (j, i) for j in range(j0 - 1, j0 + 2) for i in range(i0 - 1, i0 + 2) if 0 <= j < height and 0 <= i < width
    ]
    if all(known[at] and p[at].argmax() == p[j0, i0].argmax() for at in round_it):
        return j0 * width + i0
    weight = {}
    for j, i in round_it:
        if known[j, i]:
            cost = (y - j) ** 2 + (x - i) ** 2
            cost += COLOUR_RATE * ((rgb[v, u].astype(float) - rgb_low[j, i]) ** 2).sum()
            if depth[v, u] > 0 and depth_low[j, i] > 0:
                cost += min(((depth[v, u] - depth_low[j, i]) / (DEPTH_SIGMA * depth[v, u])) ** 2, LARGEST_STEP)
            weight[j, i] = math.exp(-cost) + LEAST_WEIGHT
    if not weight:
        return -1
    total = {int(p[at].argmax()): 0.0 for at in weight}
    total = {c: sum(w * p[at][c] for at, w in weight.items()) for c in total}
    top = max(total, key=total.__getitem__)
    j, i = max((at for at in weight if p[at].argmax() == top), key=weight.__getitem__)
    return j * width + i


@pytest.mark.parametrize(
    ("size", "full", "known"),
    [
        ((6, 8), (24, 32), 1.0),
        ((6, 8), (24, 32), 0.5),
        ((1, 1), (5, 3), 0.8),
        ((1, 7), (2, 20), 0.8),
        ((9, 8), (4, 5), 0.8),
    ],
)
def test_a_pixel_takes_the_most_alike_of_the_class_that_all_give_together(
    size: tuple[int, int], full: tuple[int, int], known: float
):
    rng = np.random.default_rng(sum(size))
    p = rng.dirichlet(np.ones(5), size).astype(np.float32)
    seen = rng.random(size) < known
    low = rng.integers(0, 60, (*size, 3), dtype=np.uint8), (1 + 0.05 * rng.random(size)).astype(np.float32)
    rgb, depth = rng.integers(0, 60, (*full, 3), dtype=np.uint8), (1 + 0.05 * rng.random(full)).astype(np.float32)
    if known == 0.5:
        depth[rng.random(depth.shape) < 0.3] = 0
    rows = upsample(p, seen, *low, rgb, depth)
    expected = [[spoken_by(v, u, p, seen, *low, rgb, depth) for u in range(full[1])] for v in range(full[0])]
    assert (rows == np.array(expected)).mean() > 0.995  # float32 may decide a tie the other way


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


class Says:
    """A field with a given opinion (1, L, h, w) of images."""

    def __init__(self, logits: torch.Tensor | None) -> None:
        self.logits = logits

    def source_logits(self, sources):
        return self.logits


def rendered(probabilities: np.ndarray, known: np.ndarray) -> RenderedView:
    return RenderedView(probabilities.astype(np.float32), known, np.ones(known.shape, np.float32), 1, 1)


def test_both_opinions_are_joined_as_their_geometric_mean_where_the_view_is_known(rng: np.random.Generator) -> None:
    view_p, own_p = rng.dirichlet(np.ones(4), (3, 5)), rng.dirichlet(np.ones(4), (3, 5))
    known = rng.random((3, 5)) < 0.7
    field = Says(torch.from_numpy(np.log(own_p)).permute(2, 0, 1)[None])
    found = add_own_image(rendered(view_p, known), field, None, 0.3)  # type: ignore[arg-type]
    expected = np.maximum(own_p, 1e-4) ** 0.3 * np.maximum(view_p, 1e-4) ** 0.7
    expected /= expected.sum(axis=2, keepdims=True)
    np.testing.assert_allclose(found.probabilities[known], expected[known], atol=1e-5)
    np.testing.assert_array_equal(found.probabilities[~known], view_p.astype(np.float32)[~known])
    assert found.probabilities.dtype == np.float32


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
