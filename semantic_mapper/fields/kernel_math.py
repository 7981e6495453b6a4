"""Small compiled building blocks of the streaming renderer: matrix products and softmax on a few dozen rows.

Matrices of one ray (64 x 32 floats) stay in the first-level cache; that, not arithmetic, is what the eager renderer
spends its time on. Inner loops run over contiguous output channels, four inputs at a time, so that LLVM vectorises.
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numba
import numpy as np

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


@numba.njit(fastmath=True, nogil=True, cache=True)
def linear(x, rows, weight, bias, out):
    """out[:rows] = x[:rows] @ weight + bias, with weight (I, O), I a multiple of 4.

    Two rows at a time share each load of the weights.

    Args:
        x: (>= rows, >= I) float32. out: (>= rows, O) float32, overwritten. bias: (O,).
    """
    inputs, outputs = weight.shape
    for t in range(0, rows - 1, 2):
        x0, x1, y0, y1 = x[t], x[t + 1], out[t], out[t + 1]
        for o in range(outputs):
            y0[o] = bias[o]
            y1[o] = bias[o]
        for i in range(0, inputs, 4):
            w0, w1, w2, w3 = weight[i], weight[i + 1], weight[i + 2], weight[i + 3]
            a0, a1, a2, a3 = x0[i], x0[i + 1], x0[i + 2], x0[i + 3]
            b0, b1, b2, b3 = x1[i], x1[i + 1], x1[i + 2], x1[i + 3]
            for o in range(outputs):
                p, q, r, s = w0[o], w1[o], w2[o], w3[o]
                y0[o] += a0 * p + a1 * q + a2 * r + a3 * s
                y1[o] += b0 * p + b1 * q + b2 * r + b3 * s
    if rows % 2:
        t = rows - 1
        for o in range(outputs):
            out[t, o] = bias[o]
        for i in range(0, inputs, 4):
            a, b, c, d = x[t, i], x[t, i + 1], x[t, i + 2], x[t, i + 3]
            for o in range(outputs):
                out[t, o] += a * weight[i, o] + b * weight[i + 1, o] + c * weight[i + 2, o] + d * weight[i + 3, o]


@numba.njit(fastmath=True, nogil=True, cache=True)
def relu(x, rows, columns):
    """In place."""
    for t in range(rows):
        for o in range(columns):
            x[t, o] = max(x[t, o], np.float32(0.0))


@numba.njit(fastmath=True, nogil=True, cache=True)
def attend(qkv, index, count, heads, head_dim, score, out):
    """Attention among the ``count`` tokens qkv[index[:count]]; the result goes to out[index[:count]].

    Args:
        qkv: (T, 3 * heads * head_dim) float32, queries first, then keys, then values.
        index: (>= count,) int64 token numbers.
        score: (>= count * count,) float32 scratch.
        out: (T, heads * head_dim) float32.
    """
    inner = heads * head_dim
    rate = np.float32(1.0 / math.sqrt(head_dim))
    for base in range(0, inner, head_dim):
        if head_dim == 8:
            _scores_of_8(qkv, index, count, base, inner + base, rate, score)
        else:
            _scores(qkv, index, count, base, inner + base, head_dim, rate, score)
        for i in range(count * count):
            score[i] = fast_exp(score[i])
        for qi in range(count):
            total = np.float32(0.0)
            for i in range(qi * count, (qi + 1) * count):
                total += score[i]
            share = np.float32(1.0) / total
            if head_dim == 8:
                _mix_8(qkv, index, count, score[qi * count :], share, 2 * inner + base, out[index[qi]], base)
            else:
                _mix(qkv, index, count, score[qi * count :], share, 2 * inner + base, head_dim, out[index[qi]], base)


@numba.njit(fastmath=True, nogil=True, cache=True)
def _scores(qkv, index, count, q_at, k_at, head_dim, rate, score):
    """score[qi * count + ki] = rate * q . k, less the largest of the row."""
    for qi in range(count):
        q, at = qkv[index[qi]], qi * count
        top = np.float32(-1e30)
        for ki in range(count):
            k = qkv[index[ki]]
            s = np.float32(0.0)
            for d in range(head_dim):
                s += q[q_at + d] * k[k_at + d]
            score[at + ki] = s * rate
            top = max(top, score[at + ki])
        for i in range(at, at + count):
            score[i] -= top


@numba.njit(fastmath=True, nogil=True, cache=True)
def _mix(qkv, index, count, weight, share, v_at, head_dim, out, out_at):
    """out = share * sum of values weighted by ``weight``."""
    for d in range(head_dim):
        out[out_at + d] = 0.0
    for ki in range(count):
        v, w = qkv[index[ki]], weight[ki] * share
        for d in range(head_dim):
            out[out_at + d] += w * v[v_at + d]


@numba.njit(fastmath=True, nogil=True, cache=True)
def _scores_of_8(qkv, index, count, q_at, k_at, rate, score):
    """``_scores`` for 8 dimensions held in registers: half the time of the loop."""
    for qi in range(count):
        q, at = qkv[index[qi]], qi * count
        q0, q1, q2, q3 = q[q_at], q[q_at + 1], q[q_at + 2], q[q_at + 3]
        q4, q5, q6, q7 = q[q_at + 4], q[q_at + 5], q[q_at + 6], q[q_at + 7]
        top = np.float32(-1e30)
        for ki in range(count):
            k = qkv[index[ki]]
            near = q0 * k[k_at] + q1 * k[k_at + 1] + q2 * k[k_at + 2] + q3 * k[k_at + 3]
            far = q4 * k[k_at + 4] + q5 * k[k_at + 5] + q6 * k[k_at + 6] + q7 * k[k_at + 7]
            score[at + ki] = rate * (near + far)
            top = max(top, score[at + ki])
        for i in range(at, at + count):
            score[i] -= top


@numba.njit(fastmath=True, nogil=True, cache=True)
def _mix_8(qkv, index, count, weight, share, v_at, out, out_at):
    """``_mix`` for 8 dimensions held in registers."""
    a = b = c = d = e = f = g = h = np.float32(0.0)
    for ki in range(count):
        v, w = qkv[index[ki]], weight[ki] * share
        a += w * v[v_at]
        b += w * v[v_at + 1]
        c += w * v[v_at + 2]
        d += w * v[v_at + 3]
        e += w * v[v_at + 4]
        f += w * v[v_at + 5]
        g += w * v[v_at + 6]
        h += w * v[v_at + 7]
    out[out_at], out[out_at + 1], out[out_at + 2], out[out_at + 3] = a, b, c, d
    out[out_at + 4], out[out_at + 5], out[out_at + 6], out[out_at + 7] = e, f, g, h
