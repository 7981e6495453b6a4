import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.sampling import merge_samples, sample_from_weights, sample_guided, sample_inverse_depth
from semantic_mapper.types import RayBatch


def rays_with_prior(prior: list[float], near: float = 0.3, far: float = 8.0) -> RayBatch:
    count = len(prior)
    return RayBatch(
        torch.zeros(count, 3),
        torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3),
        torch.full((count,), near),
        torch.full((count,), far),
        torch.tensor(prior),
    )


def test_inverse_depth_midpoints_match_hand_computed_values():
    z = sample_inverse_depth(torch.tensor([1.0]), torch.tensor([4.0]), 3)
    # 1 / z from 1 to 0.25 in three intervals: midpoints 0.875, 0.625, 0.375
    torch.testing.assert_close(z, torch.tensor([[1 / 0.875, 1 / 0.625, 1 / 0.375]]))


def test_stratified_samples_stay_in_their_intervals_and_differ_by_seed():
    near, far = torch.full((50,), 0.5), torch.full((50,), 5.0)
    z = sample_inverse_depth(near, far, 8, torch.Generator().manual_seed(0))
    again = sample_inverse_depth(near, far, 8, torch.Generator().manual_seed(0))
    other = sample_inverse_depth(near, far, 8, torch.Generator().manual_seed(1))
    position = (2 - 1 / z) / (2 - 0.2) * 8
    assert (position.floor() == torch.arange(8)).all()
    assert torch.equal(z, again) and not torch.equal(z, other)


def test_guided_samples_surround_the_prior_and_leave_some_in_free_space():
    config = SamplingConfig(guided=8, free_space=2, guided_sigma=0.02, guided_floor_m=0.04)
    z = sample_guided(rays_with_prior([2.0]), config)[0]
    assert (z[1:] > z[:-1]).all()
    torch.testing.assert_close(z[2:], 2.0 + torch.linspace(-0.08, 0.08, 6))
    assert (z[:2] < 1.92).all() and (z[:2] > 0.3).all()


def test_rays_without_prior_search_the_whole_range():
    config = SamplingConfig(guided=8)
    z = sample_guided(rays_with_prior([0.0]), config)
    torch.testing.assert_close(z, sample_inverse_depth(torch.tensor([0.3]), torch.tensor([8.0]), 8))


def test_guided_samples_stay_ascending_and_positive_for_a_prior_nearer_than_near():
    z = sample_guided(rays_with_prior([0.05, 0.2, 0.31]), SamplingConfig(guided=8, free_space=1))
    assert (z > 0).all() and (z[:, 1:] >= z[:, :-1]).all()


def test_fine_samples_gather_where_the_weight_is():
    z = torch.linspace(1, 5, 41)[None]
    weights = torch.zeros(1, 41)
    weights[0, 20] = 1.0  # z = 3
    fine = sample_from_weights(z, weights, 64)
    assert ((fine > 2.9) & (fine < 3.1)).float().mean() > 0.95
    assert (fine[:, 1:] >= fine[:, :-1]).all()


def test_fine_samples_follow_a_two_peaked_distribution_in_proportion():
    z = torch.linspace(1, 5, 41)[None]
    weights = torch.zeros(1, 41)
    weights[0, 10], weights[0, 30] = 3.0, 1.0  # z = 2 and z = 4
    fine = sample_from_weights(z, weights, 400)
    assert abs((fine < 3).float().mean() - 0.75) < 0.02


def test_merged_samples_are_sorted_and_complete():
    merged = merge_samples(torch.tensor([[1.0, 3.0]]), torch.tensor([[2.0, 4.0]]))
    assert merged.tolist() == [[1, 2, 3, 4]]
