"""Attention (Eq. 6 to 10) and the weights of the views (Eq. 12)."""

import math

import pytest
import torch

from semantic_mapper.fields.sray_layers import (
    FUSED_FROM,
    MultiHeadAttention,
    constrained_weights,
    cross_view_attention,
    masked_attention,
    radial_attention,
    softmax_weights,
)


def test_one_fused_kernel_for_many_tokens_gives_what_eq_7_says():
    tokens = FUSED_FROM + 3
    q, k, v = (t.requires_grad_() for t in torch.randn(3, 5, 2, tokens, 4, dtype=torch.float64).unbind(0))
    valid = torch.rand(5, tokens) < 0.6
    valid[2] = False
    score = (q @ k.transpose(-1, -2)) / math.sqrt(4)
    weight = torch.softmax(score.masked_fill(~valid[:, None, None, :], -1e9), -1) * valid[:, None, None, :]
    expected, out = weight @ v, masked_attention(q, k, v, valid)
    torch.testing.assert_close(out, expected)
    assert out[2].abs().max() == 0
    toward = torch.randn_like(out)
    for a, b in zip(*(torch.autograd.grad(y, (q, k, v), toward) for y in (out, expected)), strict=True):
        torch.testing.assert_close(a, b)


def test_invalid_keys_have_no_influence():
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(1, 4, 8)
    valid = torch.tensor([[True, True, False, True]])
    changed = x.clone()
    changed[0, 2] = 1e3
    rows = [0, 1, 3]
    torch.testing.assert_close(layer(x, valid)[:, rows], layer(changed, valid)[:, rows])


def test_a_row_without_any_valid_key_gives_zero_and_finite_gradients():
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(2, 3, 8, requires_grad=True)
    out = layer(x, torch.zeros(2, 3, dtype=torch.bool))
    assert out.abs().max() == 0
    out.sum().backward()
    assert torch.isfinite(x.grad).all()


def test_radial_attention_mixes_samples_of_a_view_but_not_views():
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(2, 3, 5, 8)  # rays, views, samples
    valid = torch.ones(2, 3, 5, dtype=torch.bool)
    changed = x.clone()
    changed[0, 1, 4] += 1
    moved = (radial_attention(changed, valid, layer) - radial_attention(x, valid, layer)).abs().amax(-1) > 1e-6
    expected = torch.zeros(2, 3, 5, dtype=torch.bool)
    expected[0, 1] = True
    assert torch.equal(moved, expected)


def test_cross_view_attention_mixes_views_at_one_sample_only():
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(2, 3, 5, 8)
    valid = torch.ones(2, 3, 5, dtype=torch.bool)
    changed = x.clone()
    changed[0, 1, 4] += 1
    moved = (cross_view_attention(changed, valid, layer) - cross_view_attention(x, valid, layer)).abs().amax(-1) > 1e-6
    expected = torch.zeros(2, 3, 5, dtype=torch.bool)
    expected[0, :, 4] = True
    assert torch.equal(moved, expected)


@pytest.mark.parametrize("views", [1, 2, 5, 8, 16])
@pytest.mark.parametrize("tau", [0.02, 0.3, 0.9])
def test_weights_lie_strictly_within_the_bounds_of_eq_12(views: int, tau: float):
    score = torch.randn(views, 1000, dtype=torch.float64) * 10
    w = constrained_weights(score, torch.ones_like(score, dtype=torch.bool), tau)
    torch.testing.assert_close(w.sum(0), torch.ones(1000, dtype=torch.float64))
    assert (w > tau / views).all()
    assert (w < 1 / (tau * views)).all()


def test_bounds_count_only_valid_views():
    score = torch.randn(6, 200, dtype=torch.float64) * 10
    valid = torch.rand(6, 200) < 0.5
    w = constrained_weights(score, valid, 0.1)
    seen = valid.sum(0)
    assert (w[~valid] == 0).all()
    assert (w[:, seen == 0] == 0).all()
    lower = (0.1 / seen).expand(6, 200)[valid]
    upper = (1 / (0.1 * seen)).expand(6, 200)[valid]
    assert (w[valid] > lower).all() and (w[valid] < upper).all()


def test_equal_scores_give_equal_weights_and_a_higher_score_a_higher_weight():
    valid = torch.ones(2, 1, dtype=torch.bool)
    torch.testing.assert_close(constrained_weights(torch.zeros(2, 1), valid, 0.02), torch.full((2, 1), 0.5))
    w = constrained_weights(torch.tensor([[1.0], [-1.0]]), valid, 0.02)
    assert w[0] > 0.9


def test_attention_and_view_weights_pass_gradcheck():
    torch.manual_seed(0)
    layer = MultiHeadAttention(4, 2).double()
    x = torch.randn(2, 3, 4, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[True, False, True], [True, True, True]])
    assert torch.autograd.gradcheck(lambda t: layer(t, valid), (x,))
    score = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    seen = torch.tensor([[True] * 4, [True, False, True, True], [True, True, False, False]])
    assert torch.autograd.gradcheck(lambda s: constrained_weights(s, seen, 0.1), (score,))
    assert torch.autograd.gradcheck(lambda s: softmax_weights(s, seen), (score,))
