import math

import torch

from semantic_mapper.fields.volume import composite, composite_depth, compositing_weights, interval_lengths


def test_weights_match_a_hand_computed_ray():
    sigma = torch.tensor([[0.0, 1.0, 2.0]])
    delta = torch.tensor([[0.5, 0.5, 0.25]])
    weights = compositing_weights(sigma, delta)
    first, second = 1 - math.exp(-0.5), math.exp(-0.5) * (1 - math.exp(-0.5))
    torch.testing.assert_close(weights, torch.tensor([[0.0, first, second]]))


def test_transparent_ray_has_no_opacity_and_no_depth():
    weights = compositing_weights(torch.zeros(2, 4), torch.ones(2, 4))
    assert weights.sum() == 0
    assert composite_depth(weights, torch.ones(2, 4)).tolist() == [0, 0]


def test_opaque_first_sample_hides_the_rest():
    weights = compositing_weights(torch.tensor([[1e6, 5.0, 5.0]]), torch.full((1, 3), 0.1))
    torch.testing.assert_close(weights, torch.tensor([[1.0, 0.0, 0.0]]))


def test_opacity_is_one_minus_the_transmittance_of_the_whole_ray():
    sigma, delta = torch.rand(7, 9) * 3, torch.rand(7, 9)
    opacity = compositing_weights(sigma, delta).sum(1)
    torch.testing.assert_close(opacity, 1 - torch.exp(-(sigma * delta).sum(1)))


def test_interval_lengths_are_metric_along_an_oblique_ray():
    z = torch.tensor([[1.0, 2.0, 4.0]])
    direction = torch.tensor([[1.0, 0.0, 1.0]])  # 45 degrees: one metre of z is sqrt(2) metres of ray
    delta = interval_lengths(z, direction.norm(dim=-1))
    torch.testing.assert_close(delta, math.sqrt(2) * torch.tensor([[1.0, 2.0, 2.0]]))


def test_rendering_is_independent_of_how_a_homogeneous_medium_is_cut():
    coarse = compositing_weights(torch.full((1, 4), 0.7), torch.full((1, 4), 0.5)).sum()
    fine = compositing_weights(torch.full((1, 16), 0.7), torch.full((1, 16), 0.125)).sum()
    torch.testing.assert_close(coarse, fine)


def test_composite_sums_values_by_weight():
    weights = torch.tensor([[0.25, 0.5]])
    values = torch.tensor([[[1.0, 2.0], [4.0, 8.0]]])
    torch.testing.assert_close(composite(weights, values), torch.tensor([[2.25, 4.5]]))


def test_volume_rendering_passes_gradcheck():
    sigma = (torch.rand(2, 5, dtype=torch.float64) + 0.1).requires_grad_()
    delta = (torch.rand(2, 5, dtype=torch.float64) + 0.1).requires_grad_()
    values = torch.rand(2, 5, 3, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d, v: composite(compositing_weights(s, d), v), (sigma, delta, values))
