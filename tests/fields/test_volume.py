"""Samples along rays and volume rendering, against numbers computed by hand."""

import math

import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.volume import (
    composite,
    compositing_weights,
    interval_lengths,
    sample_from_weights,
    sample_guided,
    sample_inverse_depth,
)
from semantic_mapper.types import RayBatch


def test_weights_and_lengths_match_hand_computed_rays():
    weights = compositing_weights(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[0.5, 0.5, 0.25]]))
    first, second = 1 - math.exp(-0.5), math.exp(-0.5) * (1 - math.exp(-0.5))
    torch.testing.assert_close(weights, torch.tensor([[0.0, first, second]]))
    z, oblique = torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([[1.0, 0.0, 1.0]])  # one metre of z is sqrt(2) of ray
    delta = interval_lengths(z, oblique.norm(dim=-1))
    torch.testing.assert_close(delta, math.sqrt(2) * torch.tensor([[1.0, 2.0, 2.0]]))


def test_volume_rendering_passes_gradcheck():
    sigma = (torch.rand(2, 5, dtype=torch.float64) + 0.1).requires_grad_()
    delta = (torch.rand(2, 5, dtype=torch.float64) + 0.1).requires_grad_()
    values = torch.rand(2, 5, 3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d, v: composite(compositing_weights(s, d), v), (sigma, delta, values))


def test_inverse_depth_midpoints_match_hand_computed_values():
    z = sample_inverse_depth(torch.tensor([1.0]), torch.tensor([4.0]), 3)
    # 1 / z from 1 to 0.25 in three intervals: midpoints 0.875, 0.625, 0.375
    torch.testing.assert_close(z, torch.tensor([[1 / 0.875, 1 / 0.625, 1 / 0.375]]))


def test_guided_samples_surround_the_prior_and_leave_some_in_free_space():
    config = SamplingConfig(guided=8, free_space=2, guided_sigma=0.02, guided_floor_m=0.04)
    one = torch.ones(1)
    z = sample_guided(RayBatch(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]), 0.3 * one, 8 * one, 2 * one), config)[0]
    assert (z[1:] > z[:-1]).all()
    torch.testing.assert_close(z[2:], 2.0 + torch.linspace(-0.08, 0.08, 6))
    assert (z[:2] < 1.92).all() and (z[:2] > 0.3).all()


def test_fine_samples_follow_a_two_peaked_distribution_in_proportion():
    z = torch.linspace(1, 5, 41)[None]
    weights = torch.zeros(1, 41)
    weights[0, 10], weights[0, 30] = 3.0, 1.0  # z = 2 and z = 4
    fine = sample_from_weights(z, weights, 400)
    assert abs((fine < 3).float().mean() - 0.75) < 0.02
