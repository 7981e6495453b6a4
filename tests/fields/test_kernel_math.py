"""Building blocks of the compiled renderer against torch."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from numba.core.errors import TypingError

from semantic_mapper.fields import simd
from semantic_mapper.fields.kernel_math import attend, linear, make_attention_scratch


def numbers(*shape: int, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(sum(shape)).normal(0, scale, shape).astype(np.float32)


@pytest.mark.parametrize("outputs", [2, 8, 16, 30, 96])
@pytest.mark.parametrize("rows", [1, 3, 4, 29])
def test_linear_is_a_matrix_product(rows: int, outputs: int) -> None:
    x, weight, bias = numbers(32, 36), numbers(36, outputs), numbers(outputs)
    out = np.zeros((32, outputs + 5), np.float32)
    linear(x, rows, weight, bias, out)
    np.testing.assert_allclose(out[:rows, :outputs], x[:rows] @ weight + bias, atol=2e-5)
    assert not out[:, outputs:].any()


@pytest.mark.parametrize(("heads", "head_dim"), [(4, 8), (2, 8), (1, 16), (3, 4), (2, 12)])
@pytest.mark.parametrize("count", [1, 2, 5, 8, 13])
def test_attention_is_torch_s(heads: int, head_dim: int, count: int) -> None:
    inner = heads * head_dim
    qkv = numbers(20, 3 * inner, scale=3.0)
    index = np.random.default_rng(count).permutation(20).astype(np.int64)
    out = np.full((20, inner), 7.0, np.float32)
    attend(qkv, index, count, heads, head_dim, make_attention_scratch(inner, 13), out)
    q, k, v = torch.from_numpy(qkv[index[:count]]).reshape(count, 3, heads, head_dim).permute(1, 2, 0, 3)
    truth = torch.nn.functional.scaled_dot_product_attention(q, k, v).transpose(0, 1).reshape(count, inner)
    np.testing.assert_allclose(out[index[:count]], truth.numpy(), atol=1e-5)
    assert (out[index[count:]] == 7.0).all()


def test_attention_keeps_large_scores_and_not_a_number() -> None:
    qkv = numbers(4, 96, scale=300.0)  # scores in the ten thousands
    out, index = np.zeros((4, 32), np.float32), np.arange(4)
    attend(qkv, index, 4, 4, 8, make_attention_scratch(32, 4), out)
    assert np.isfinite(out).all()
    qkv[2, 64 + 9] = np.nan  # a value of the second head
    attend(qkv, index, 4, 4, 8, make_attention_scratch(32, 4), out)
    assert np.isnan(out[:, 9]).all() and np.isfinite(np.delete(out, 9, axis=1)).all()


@numba.njit
def exp_of(values: np.ndarray, out: np.ndarray) -> None:
    for i in range(0, values.size, 8):
        simd.store(out, i, simd.exp_below(simd.load(values, i)))


def test_exp_is_exact_to_a_millionth_and_ends_at_its_least() -> None:
    values = -np.logspace(-6, np.log10(87), 800, dtype=np.float32)
    out = np.zeros_like(values)
    exp_of(values, out)
    np.testing.assert_allclose(out, np.exp(values.astype(np.float64)), rtol=1e-6)
    extremes = np.array([0, -0.0, -1e30, -np.inf, np.nan, -88, -200, -1], np.float32)
    exp_of(extremes, out[:8])
    assert out[0] == out[1] == 1 and np.isnan(out[4]) and (out[[2, 3, 5, 6]] < 2e-38).all()


def test_lanes_are_of_contiguous_float32_alone() -> None:
    for wrong in (np.zeros(16), np.zeros((8, 2), np.float32)[:, 0]):
        with pytest.raises(TypingError, match="contiguous float32"):
            exp_of(wrong, np.zeros(16, np.float32))
