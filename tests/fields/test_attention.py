"""Attention (Eq. 6 to 10) and the weights of the views (Eq. 12)."""

import pytest
import torch

from semantic_mapper.fields.sray import (
    MultiHeadAttention,
    constrained_weights,
    cross_view_attention,
    radial_attention,
    softmax_weights,
)


@pytest.mark.parametrize(
    ("attention", "reached"), [(radial_attention, (0, 1)), (cross_view_attention, (0, slice(None), 4))]
)
def test_radial_attention_mixes_samples_of_a_view_and_cross_view_attention_views_of_a_sample(attention, reached):
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(2, 3, 5, 8)  # rays, views, samples
    valid = torch.ones(2, 3, 5, dtype=torch.bool)
    changed = x.clone()
    changed[0, 1, 4] += 1
    moved = (attention(changed, valid, layer) - attention(x, valid, layer)).abs().amax(-1) > 1e-6
    expected = torch.zeros(2, 3, 5, dtype=torch.bool)
    expected[reached] = True
    assert torch.equal(moved, expected)


@pytest.mark.parametrize("views", [1, 2, 5, 8, 16])
@pytest.mark.parametrize("tau", [0.02, 0.3, 0.9])
def test_weights_lie_strictly_within_the_bounds_of_eq_12(views: int, tau: float):
    score = torch.randn(views, 1000, dtype=torch.float64) * 10
    w = constrained_weights(score, torch.ones_like(score, dtype=torch.bool), tau)
    torch.testing.assert_close(w.sum(0), torch.ones(1000, dtype=torch.float64))
    assert (w > tau / views).all()
    assert (w < 1 / (tau * views)).all()


def test_attention_and_view_weights_pass_gradcheck():
    torch.manual_seed(0)
    layer = MultiHeadAttention(4, 2).double()
    x = torch.randn(2, 3, 4, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[True, False, True], [False] * 3])  # a row without any valid key gives zeros
    assert torch.autograd.gradcheck(lambda t: layer(t, valid), (x,)) and not layer(x, valid)[1].any()
    score = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    seen = torch.tensor([[True] * 4, [True, False, True, True], [True, True, False, False]])
    assert torch.autograd.gradcheck(lambda s: constrained_weights(s, seen, 0.1), (score,))
    assert torch.autograd.gradcheck(lambda s: softmax_weights(s, seen), (score,))
