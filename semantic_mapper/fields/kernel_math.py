"""Small compiled building blocks of the streaming renderer: matrix products and softmax on a few dozen rows.

Matrices of one ray (64 x 32 floats) stay in the first-level cache; that, not arithmetic, is what the eager renderer
spends its time on, and sums that stay in registers are what the loops below are written for (``simd``).
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numba
import numpy as np

from semantic_mapper.fields.simd import (
    LANES,
    add,
    exp_below,
    larger,
    largest,
    load,
    multiply,
    multiply_add,
    splat,
    store,
    swap_halves,
    total,
    totals,
)
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.threads import inlined_kernel

ROWS = 4  # that ``linear`` works on at a time
_LOG2E = np.float32(1.4426950408889634)
_LN2 = np.float32(0.6931471805599453)
_POWERS = np.float32(2.0) ** np.arange(-126, 1).astype(np.float32)


@numba.njit(inline="always", fastmath=True)
def fast_exp(x):
    """exp(x) for x <= 0 in float32, relative error below 1e-6; values under e^-87 become 0."""
    if x < np.float32(-87.0):
        return np.float32(0.0)
    k = np.int32(x * _LOG2E - np.float32(0.5))
    r = x - np.float32(k) * _LN2
    p = np.float32(1.0 / 720.0)
    p = p * r + np.float32(1.0 / 120.0)
    p = p * r + np.float32(1.0 / 24.0)
    p = p * r + np.float32(1.0 / 6.0)
    p = p * r + np.float32(0.5)
    p = p * r + np.float32(1.0)
    p = p * r + np.float32(1.0)
    return p * _POWERS[min(max(k + 126, 0), 126)]  # bounded, so that not even NaN can read elsewhere


@numba.njit(inline="always", fastmath=True)
def sigmoid(x):
    """Logistic function in float32."""
    if x >= 0:
        return np.float32(1.0) / (np.float32(1.0) + fast_exp(-x))
    e = fast_exp(x)
    return e / (np.float32(1.0) + e)


@numba.njit(inline="always", fastmath=True)
def tanh(x):
    """Hyperbolic tangent in float32."""
    return np.float32(2.0) * sigmoid(np.float32(2.0) * x) - np.float32(1.0)


@numba.njit(inline="always", fastmath=True)
def softplus(x):
    """ln(1 + e^x) in float32."""
    return max(x, np.float32(0.0)) + np.float32(math.log1p(fast_exp(-abs(x))))


@inlined_kernel
def linear(x, rows, weight, bias, out):
    """out[:rows] = x[:rows] @ weight + bias.

    Sixteen outputs of four rows at a time are summed in registers; outputs beyond a multiple of 8 one by one.

    Args:
        x: (>= rows up to the next multiple of 4, >= I) float32, contiguous. weight: (I, O). bias: (>= O,).
        out: (as x, >= O) float32, contiguous, overwritten; rows beyond, up to a multiple of 4, mean nothing.
    """
    inputs, outputs = weight.shape
    even = outputs // LANES * LANES
    for o in range(0, even - LANES, 2 * LANES):
        for t in range(0, rows, ROWS):
            _four_rows(x, t, weight, o, bias, out)
    if even % (2 * LANES):
        for t in range(rows):
            _eight_outputs(x, t, weight, even - LANES, bias, out)
    for o in range(even, outputs):
        for t in range(rows):
            value = bias[o]
            for i in range(inputs):
                value += x[t, i] * weight[i, o]
            out[t, o] = value


@numba.njit(inline="always", fastmath=True)
def _eight_outputs(x, t, weight, o, bias, out):
    """Of one row."""
    inputs, outputs = weight.shape
    value = load(bias, o)
    for i in range(inputs):
        value = multiply_add(splat(x[t, i]), load(weight, i * outputs + o), value)
    store(out, t * out.shape[1] + o, value)


@numba.njit(inline="always", fastmath=True)
def _four_rows(x, t, weight, o, bias, out):
    """Sixteen outputs of four rows, which share each load of the weights."""
    inputs, outputs = weight.shape
    stride = out.shape[1]
    a = c = e = g = load(bias, o)
    b = d = f = h = load(bias, o + LANES)
    for i in range(inputs):
        near, far = load(weight, i * outputs + o), load(weight, i * outputs + o + LANES)
        x0, x1, x2, x3 = splat(x[t, i]), splat(x[t + 1, i]), splat(x[t + 2, i]), splat(x[t + 3, i])
        a, b = multiply_add(x0, near, a), multiply_add(x0, far, b)
        c, d = multiply_add(x1, near, c), multiply_add(x1, far, d)
        e, f = multiply_add(x2, near, e), multiply_add(x2, far, f)
        g, h = multiply_add(x3, near, g), multiply_add(x3, far, h)
    store(out, t * stride + o, a)
    store(out, t * stride + o + LANES, b)
    store(out, (t + 1) * stride + o, c)
    store(out, (t + 1) * stride + o + LANES, d)
    store(out, (t + 2) * stride + o, e)
    store(out, (t + 2) * stride + o + LANES, f)
    store(out, (t + 3) * stride + o, g)
    store(out, (t + 3) * stride + o + LANES, h)


@inlined_kernel
def relu(x, rows, columns):
    """In place."""
    for t in range(rows):
        for o in range(columns):
            x[t, o] = max(x[t, o], np.float32(0.0))


@inlined_kernel
def attend(qkv, index, count, heads, head_dim, scratch, out):
    """Attention among the ``count`` tokens qkv[index[:count]]; the result goes to out[index[:count]].

    Args:
        qkv: (T, 3 * heads * head_dim) float32, contiguous, queries first, then keys, then values.
        index: (>= count,) int64 token numbers.
        scratch: See ``make_attention_scratch``.
        out: (T, heads * head_dim) float32, contiguous.
    """
    if heads == 4 and head_dim == LANES:
        _attend_four_heads(qkv, index, count, scratch[1], out)
    else:
        _attend_any(qkv, index, count, heads, head_dim, scratch, out)


@inlined_kernel
def _attend_any(qkv, index, count, heads, head_dim, scratch, out):
    """A lane is a key."""
    keys, score, beyond = scratch
    inner, stride = heads * head_dim, keys.shape[1]
    padded = (count + LANES - 1) // LANES * LANES
    rate = np.float32(1.0 / math.sqrt(head_dim))
    for k in range(padded):
        beyond[k] = np.float32(0.0) if k < count else np.float32(-1e30)
    for c in range(inner):
        for k in range(count):
            keys[c, k] = qkv[index[k], inner + c] * rate
        for k in range(count, padded):
            keys[c, k] = np.float32(0.0)
    for base in range(0, inner, head_dim):
        for i in range(count):
            query = index[i]
            top = splat(np.float32(-1e30))
            for k in range(0, padded, LANES):
                value = load(beyond, k)
                for c in range(base, base + head_dim):
                    value = multiply_add(splat(qkv[query, c]), load(keys, c * stride + k), value)
                top = larger(top, value)
                store(score, k, value)
            shift = splat(-largest(top))
            summed = splat(np.float32(0.0))
            for k in range(0, padded, LANES):
                value = exp_below(add(load(score, k), shift))
                summed = add(summed, value)
                store(score, k, value)
            share = np.float32(1.0) / total(summed)
            _mix(qkv, index, count, score, share, 2 * inner + base, head_dim, out, query, base)


@numba.njit(inline="always", fastmath=True)
def _mix(qkv, index, count, weight, share, v_at, head_dim, out, row, out_at):
    """out[row, out_at:] = share * sum of values weighted by ``weight``."""
    even = head_dim // LANES * LANES
    for d in range(0, even, LANES):
        value = splat(np.float32(0.0))
        for k in range(count):
            value = multiply_add(splat(weight[k]), load(qkv, index[k] * qkv.shape[1] + v_at + d), value)
        store(out, row * out.shape[1] + out_at + d, multiply(value, splat(share)))
    for d in range(even, head_dim):
        one = np.float32(0.0)
        for k in range(count):
            one += weight[k] * qkv[index[k], v_at + d]
        out[row, out_at + d] = one * share


@numba.njit(inline="always", fastmath=True)
def _two_keys(q0, q1, q2, q3, qkv, near, far):
    """Scores of one query with two keys at flat places: four heads with the first, then with the second."""
    return totals(
        multiply(q0, load(qkv, near)),
        multiply(q1, load(qkv, near + 8)),
        multiply(q2, load(qkv, near + 16)),
        multiply(q3, load(qkv, near + 24)),
        multiply(q0, load(qkv, far)),
        multiply(q1, load(qkv, far + 8)),
        multiply(q2, load(qkv, far + 16)),
        multiply(q3, load(qkv, far + 24)),
    )


@inlined_kernel
def _attend_four_heads(qkv, index, count, score, out):
    """A lane is a head, of two keys at a time: groups of a few tokens leave no lane empty, and no sum goes across."""
    width, rate = qkv.shape[1], splat(np.float32(1.0 / math.sqrt(8)))
    for i in range(count):
        at = index[i] * width
        q0, q1 = multiply(load(qkv, at), rate), multiply(load(qkv, at + 8), rate)
        q2, q3 = multiply(load(qkv, at + 16), rate), multiply(load(qkv, at + 24), rate)
        top = splat(np.float32(-1e30))
        for k in range(0, count - 1, 2):
            value = _two_keys(q0, q1, q2, q3, qkv, index[k] * width + 32, index[k + 1] * width + 32)
            top = larger(top, value)
            store(score, 4 * k, value)
        if count % 2:
            last = index[count - 1] * width + 32
            value = _two_keys(q0, q1, q2, q3, qkv, last, last)
            top = larger(top, value)
            store(score, 4 * (count - 1), value)
            score[4 * count : 4 * count + 4] = np.float32(-1e30)  # no key to make the pair whole
        shift = multiply(larger(top, swap_halves(top)), splat(np.float32(-1.0)))
        summed = splat(np.float32(0.0))
        for k in range(0, count, 2):
            value = exp_below(add(load(score, 4 * k), shift))
            summed = add(summed, value)
            store(score, 4 * k, value)
        sums = 4 * count + 4
        store(score, sums, add(summed, swap_halves(summed)))
        a = b = c = d = splat(np.float32(0.0))
        for k in range(count):
            v = index[k] * width + 64
            a = multiply_add(splat(score[4 * k]), load(qkv, v), a)
            b = multiply_add(splat(score[4 * k + 1]), load(qkv, v + 8), b)
            c = multiply_add(splat(score[4 * k + 2]), load(qkv, v + 16), c)
            d = multiply_add(splat(score[4 * k + 3]), load(qkv, v + 24), d)
        one, at = np.float32(1.0), index[i] * out.shape[1]
        store(out, at, multiply(a, splat(one / score[sums])))
        store(out, at + 8, multiply(b, splat(one / score[sums + 1])))
        store(out, at + 16, multiply(c, splat(one / score[sums + 2])))
        store(out, at + 24, multiply(d, splat(one / score[sums + 3])))


@kernel()
def make_attention_scratch(inner, count):
    """Buffers of ``attend`` for ``inner`` = heads * head_dim, groups of at most ``count``: keys, scores, mask."""
    padded = (count + LANES - 1) // LANES * LANES
    scores = np.empty(4 * padded + 2 * LANES, np.float32)
    return np.empty((inner, padded), np.float32), scores, np.empty(padded, np.float32)
