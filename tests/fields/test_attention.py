import math

import pytest
import torch

from semantic_mapper.fields.attention import (
    FUSED_FROM,
    MultiHeadAttention,
    cross_view_attention,
    masked_attention,
    positional_encoding,
    published_attention,
    radial_attention,
)


def test_attention_matches_a_hand_computed_case():
    q = torch.tensor([[[[1.0, 0.0]]]])
    k = torch.tensor([[[[1.0, 0.0], [0.0, 1.0]]]])
    v = torch.tensor([[[[10.0, 0.0], [0.0, 10.0]]]])
    out = masked_attention(q, k, v, torch.ones(1, 2, dtype=torch.bool))
    a = math.exp(1 / math.sqrt(2)) / (math.exp(1 / math.sqrt(2)) + 1)
    torch.testing.assert_close(out[0, 0, 0], torch.tensor([10 * a, 10 * (1 - a)]))


def test_masked_attention_equals_torch_on_the_valid_keys():
    q, k, v = torch.randn(3, 5, 4, 6, 8).unbind(0)
    valid = torch.tensor([True, True, False, True, False, True]).expand(5, 6)
    expected = torch.nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=valid[:, None, None, :])
    torch.testing.assert_close(masked_attention(q, k, v, valid), expected, atol=1e-5, rtol=1e-5)


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


def test_published_parity_masks_queries_so_invalid_keys_leak():
    q, k, v = torch.randn(3, 1, 1, 3, 4).unbind(0)
    valid = torch.tensor([[True, True, False]])
    other = v.clone()
    other[..., 2, :] += 5
    changed = published_attention(q, k, other, valid) - published_attention(q, k, v, valid)
    assert changed[0, 0, 0].abs().max() > 1e-3
    uniform = published_attention(q, k, v, valid)[0, 0, 2]
    torch.testing.assert_close(uniform, v[0, 0].mean(0))


def test_a_row_without_any_valid_key_gives_zero_and_finite_gradients():
    layer = MultiHeadAttention(8, 2)
    x = torch.randn(2, 3, 8, requires_grad=True)
    out = layer(x, torch.zeros(2, 3, dtype=torch.bool))
    assert out.abs().max() == 0
    out.sum().backward()
    assert torch.isfinite(x.grad).all()


def test_head_dimension_is_c_over_h_and_four_in_published_parity():
    assert MultiHeadAttention(32, 4).head_dim == 8
    assert MultiHeadAttention(32, 4, published=True).head_dim == 4


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


@pytest.mark.parametrize("published", [False, True])
def test_attention_passes_gradcheck(published: bool):
    torch.manual_seed(0)
    layer = MultiHeadAttention(4, 2, published=published).double()
    x = torch.randn(2, 3, 4, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[True, False, True], [True, True, True]])
    assert torch.autograd.gradcheck(lambda t: layer(t, valid), (x,))


def test_positional_encoding_tells_samples_apart():
    code = positional_encoding(6, 8, torch.zeros(1))
    assert code.shape == (6, 8)
    assert torch.pdist(code).min() > 0.1
