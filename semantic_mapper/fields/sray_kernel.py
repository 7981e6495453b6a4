"""S-Ray's renderer as one compiled pass per ray: reproject, gather, attend, blend, composite, without temporaries.

The same arithmetic as ``SRay.render_samples`` (which stays the readable reference; a test holds both together), with
what only costs time left out: samples outside a view are dropped instead of masked, and nothing leaves the cache
between two steps. Shapes: m views, R rays, N samples, C channels; a token is one (view, sample) pair.
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numba
import numpy as np

from semantic_mapper.fields.geometry_net import OWN_DENSITY_OFFSET
from semantic_mapper.fields.kernel_math import attend, fast_exp, linear, relu, sigmoid, softplus, tanh
from semantic_mapper.fields.projection import MIN_DEPTH_M
from semantic_mapper.fields.sray import DOUBT
from semantic_mapper.threads import parallel_kernel

CUES = 4
SCORE_HIDDEN = 16  # hidden width of ViewWeightNet
_ZERO = np.float32(0.0)


@numba.njit(fastmath=True, nogil=True, cache=True)
def _gather_sample(maps, geometry, j, u, v, feature, rgb, mixture):
    """Bilinear features and colour, nearest geometry of view j at pixel (u, v), with the border repeated."""
    height, width, channels = maps.shape[1], maps.shape[2], feature.shape[0]
    x = min(max(u, _ZERO), np.float32(width - 1))
    y = min(max(v, _ZERO), np.float32(height - 1))
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    fx, fy = x - np.float32(x0), y - np.float32(y0)
    w00, w01 = (1 - fx) * (1 - fy), fx * (1 - fy)
    w10, w11 = (1 - fx) * fy, fx * fy
    for c in range(channels):
        feature[c] = (
            w00 * maps[j, y0, x0, c] + w01 * maps[j, y0, x1, c] + w10 * maps[j, y1, x0, c] + w11 * maps[j, y1, x1, c]
        )
    for c in range(3):
        d = channels + c
        rgb[c] = (
            w00 * maps[j, y0, x0, d] + w01 * maps[j, y0, x1, d] + w10 * maps[j, y1, x0, d] + w11 * maps[j, y1, x1, d]
        )
    row = min(max(int(np.rint(v)), 0), height - 1)
    column = min(max(int(np.rint(u)), 0), width - 1)
    for g in range(geometry.shape[3]):
        mixture[g] = geometry[j, row, column, g]


@numba.njit(inline="always", fastmath=True)
def _cdf(mixture, z):
    near = sigmoid((z - mixture[0]) / mixture[1])
    far = sigmoid((z - mixture[2]) / mixture[3])
    return mixture[4] * near + (1 - mixture[4]) * far


@numba.njit(fastmath=True, nogil=True, cache=True)
def _fill_tokens(
    origin, direction, z, delta, sources, token_view, token_sample, token_label, feature, rgb, cues, mixture
):
    """Reproject the samples of one ray into all views (Eq. 4, 5); return the number of tokens that some view sees."""
    maps, geometry, K, T, labels = sources
    count = 0
    height, width = maps.shape[1], maps.shape[2]
    rows, columns = labels.shape[1], labels.shape[2]
    for j in range(maps.shape[0]):
        dx = T[j, 0, 0] * direction[0] + T[j, 0, 1] * direction[1] + T[j, 0, 2] * direction[2]
        dy = T[j, 1, 0] * direction[0] + T[j, 1, 1] * direction[1] + T[j, 1, 2] * direction[2]
        dz = T[j, 2, 0] * direction[0] + T[j, 2, 1] * direction[1] + T[j, 2, 2] * direction[2]
        ox = T[j, 0, 0] * origin[0] + T[j, 0, 1] * origin[1] + T[j, 0, 2] * origin[2] + T[j, 0, 3]
        oy = T[j, 1, 0] * origin[0] + T[j, 1, 1] * origin[1] + T[j, 1, 2] * origin[2] + T[j, 1, 3]
        oz = T[j, 2, 0] * origin[0] + T[j, 2, 1] * origin[1] + T[j, 2, 2] * origin[2] + T[j, 2, 3]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        for k in range(z.shape[0]):
            px, py, pz = ox + z[k] * dx, oy + z[k] * dy, oz + z[k] * dz
            if not pz > np.float32(MIN_DEPTH_M):
                continue
            u = K[j, 0] * px / pz + K[j, 2]
            v = K[j, 1] * py / pz + K[j, 3]
            if not (u > -0.5 and u < width - 0.5 and v > -0.5 and v < height - 0.5):
                continue
            _gather_sample(maps, geometry, j, u, v, feature[count], rgb[count], mixture)
            half = np.float32(0.5) * delta[k]
            cdf_near = _cdf(mixture, pz - half)
            norm = math.sqrt(px * px + py * py + pz * pz)
            cues[count, 0] = _cdf(mixture, pz + half) - cdf_near
            cues[count, 1] = 1 - cdf_near
            cues[count, 2] = (px * dx + py * dy + pz * dz) / (norm * length)
            cues[count, 3] = math.log(mixture[1])
            row = int(np.rint((v + np.float32(0.5)) * np.float32(rows / height) - np.float32(0.5)))
            column = int(np.rint((u + np.float32(0.5)) * np.float32(columns / width) - np.float32(0.5)))
            token_label[count] = labels[j, min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)]
            token_view[count] = j
            token_sample[count] = k
            count += 1
    return count


@numba.njit(fastmath=True, nogil=True, cache=True)
def _attention_layer(x, groups, sizes, count, qkv_weight, out_weight, zero_bias, heads, keep, qkv, mixed, score):
    """x <- keep * x + f(x), attention within each group of tokens (Eq. 6 to 8)."""
    inner = out_weight.shape[0]
    channels = out_weight.shape[1]
    linear(x, count, qkv_weight, zero_bias[: 3 * inner], qkv)
    for g in range(groups.shape[0]):
        if sizes[g] > 0:
            attend(qkv, groups[g], sizes[g], heads, inner // heads, score, mixed)
    linear(mixed, count, out_weight, zero_bias[:channels], qkv)
    for t in range(count):
        for c in range(channels):
            x[t, c] = keep * x[t, c] + qkv[t, c]


@numba.njit(fastmath=True, nogil=True, cache=True)
def _blend(x, cues, rgb, by_sample, sizes, weights, log_ratio, scratch, s, colour):
    """Semantic ray s and colour of each sample (Eq. 11, 12)."""
    samples, channels = by_sample.shape[0], s.shape[1]
    w1, b1, w2, b2 = weights
    for k in range(samples):
        for c in range(channels):
            s[k, c] = 0
        for c in range(3):
            colour[k, c] = 0
        n = sizes[k]
        if n == 0:
            continue
        total, colour_total, top = _ZERO, _ZERO, np.float32(-1e30)
        for i in range(n):
            t = by_sample[k, i]
            for c in range(channels):
                scratch[0, c] = x[t, c]
            for c in range(CUES):
                scratch[0, channels + c] = cues[t, c]
            linear(scratch[:1], 1, w1, b1, scratch[1:2])
            relu(scratch[1:2], 1, w1.shape[1])
            semantic_score, colour_score = b2[0], b2[1]
            for c in range(w1.shape[1]):
                semantic_score += scratch[1, c] * w2[c, 0]
                colour_score += scratch[1, c] * w2[c, 1]
            scratch[2, i] = math.exp(np.float32(0.5) * log_ratio * tanh(semantic_score))
            scratch[3, i] = colour_score
            total += scratch[2, i]
            top = max(top, colour_score)
        for i in range(n):
            scratch[3, i] = fast_exp(scratch[3, i] - top)
            colour_total += scratch[3, i]
        for i in range(n):
            t = by_sample[k, i]
            w, wc = scratch[2, i] / total, scratch[3, i] / colour_total
            for c in range(channels):
                s[k, c] += w * x[t, c]
            for c in range(3):
                colour[k, c] += wc * rgb[t, c]


@numba.njit(fastmath=True, nogil=True, cache=True)
def _carry_labels(token_label, cues, by_sample, sizes, out):
    """Known labels that the views carry over to each sample, (N, L); see ``SRay.carried_labels``."""
    for k in range(by_sample.shape[0]):
        for c in range(out.shape[1]):
            out[k, c] = 0
        total = np.float32(DOUBT)
        for i in range(sizes[k]):
            t = by_sample[k, i]
            if token_label[t] >= 0:
                total += cues[t, 0]
                out[k, token_label[t]] += cues[t, 0]
        for c in range(out.shape[1]):
            out[k, c] /= total


@numba.njit(fastmath=True, nogil=True, cache=True)
def _density(feature, cues, by_sample, sizes, delta, weights, scratch, sigma):
    """Density of each sample of one ray from what all views say about it; see ``DensityNet``."""
    w1, b1, w2, b2, wqkv, v1, c1, v2, c2 = weights
    inputs, hidden, token, qkv, mixed, score, active = scratch
    samples, channels = by_sample.shape[0], feature.shape[1]
    count = 0
    for k in range(samples):
        sigma[k] = 0
        n = sizes[k]
        if n == 0:
            continue
        total, seen, hits = _ZERO, _ZERO, _ZERO
        for c in range(2 * channels):
            inputs[k, c] = 0
        for i in range(n):
            seen += cues[by_sample[k, i], 1]
            hits += cues[by_sample[k, i], 0]
            total += cues[by_sample[k, i], 1] + np.float32(1e-4)
        total = max(total, np.float32(1e-6))
        for i in range(n):
            t = by_sample[k, i]
            share = (cues[t, 1] + np.float32(1e-4)) / total
            for c in range(channels):
                inputs[k, c] += share * feature[t, c]
                inputs[k, channels + c] += share * feature[t, c] * feature[t, c]
        for c in range(channels):
            inputs[k, channels + c] -= inputs[k, c] * inputs[k, c]
        opacity = min(max(hits / max(seen, np.float32(1e-3)), _ZERO), np.float32(0.999))
        inputs[k, 2 * channels] = opacity
        inputs[k, 2 * channels + 1] = seen / n
        inputs[k, 2 * channels + 2] = hits / n
        inputs[k, 2 * channels + 3] = min(delta[k], np.float32(1.0))
        sigma[k] = -math.log1p(-opacity) / max(delta[k], np.float32(1e-4))
        active[count] = k
        count += 1
    linear(inputs, samples, w1, b1, hidden)
    relu(hidden, samples, w1.shape[1])
    linear(hidden, samples, w2, b2, token)
    linear(token, samples, wqkv, np.zeros(wqkv.shape[1], np.float32), qkv)
    attend(qkv, active, count, 1, w2.shape[1], score, mixed)
    for k in range(samples):
        for c in range(w2.shape[1]):
            token[k, c] += mixed[k, c]
    linear(token, samples, v1, c1, hidden)
    relu(hidden, samples, v1.shape[1])
    for i in range(count):
        k = active[i]
        gain, own = c2[0], c2[1]
        for c in range(v1.shape[1]):
            gain += hidden[k, c] * v2[c, 0]
            own += hidden[k, c] * v2[c, 1]
        gain = min(max(gain, np.float32(-4.0)), np.float32(4.0))
        sigma[k] = sigma[k] * math.exp(gain) + softplus(own - np.float32(OWN_DENSITY_OFFSET))


@numba.njit(fastmath=True, nogil=True, cache=True)
def _composite(s, colour, labels, sigma, delta, z, out, rendered_colour, carried):
    """Eq. 13 over one ray: fills out (C,), rendered_colour (3,), carried (L,); returns opacity and expected depth."""
    optical, opacity, depth = _ZERO, _ZERO, _ZERO
    for c in range(out.shape[0]):
        out[c] = 0
    for c in range(3):
        rendered_colour[c] = 0
    for c in range(carried.shape[0]):
        carried[c] = 0
    for k in range(z.shape[0]):
        step = sigma[k] * delta[k]
        w = np.float32(math.exp(-optical)) * np.float32(-math.expm1(-step))
        optical += step
        opacity += w
        depth += w * z[k]
        for c in range(out.shape[0]):
            out[c] += w * s[k, c]
        for c in range(3):
            rendered_colour[c] += w * colour[k, c]
        for c in range(carried.shape[0]):
            carried[c] += w * labels[k, c]
    return opacity, (depth / max(opacity, np.float32(1e-6)) if opacity > 1e-3 else _ZERO)


@numba.njit(fastmath=True, nogil=True, cache=True)
def _group_tokens(token_view, token_sample, count, by_view, view_size, by_sample, sample_size):
    """List the tokens of each view and of each sample."""
    view_size[:] = 0
    sample_size[:] = 0
    for t in range(count):
        j, k = token_view[t], token_sample[t]
        by_view[j, view_size[j]] = t
        view_size[j] += 1
        by_sample[k, sample_size[k]] = t
        sample_size[k] += 1


@numba.njit(fastmath=True, nogil=True, cache=True)
def _make_scratch(views, samples, channels, classes):
    """Buffers of one thread: tokens, their groups, attention, samples, density."""
    tokens = views * samples
    score = np.empty(max(views, samples) ** 2, np.float32)
    return (
        (np.empty(tokens, np.int64), np.empty(tokens, np.int64), np.empty(tokens, np.int64)),  # view, sample, label
        (
            np.empty((tokens, channels), np.float32),  # feature
            np.empty((tokens, 3), np.float32),  # colour
            np.empty((tokens, CUES), np.float32),
            np.empty(5, np.float32),  # depth mixture of one pixel
        ),
        (
            np.empty((views, samples), np.int64),  # tokens by view
            np.empty(views, np.int64),
            np.empty((samples, views), np.int64),  # tokens by sample
            np.empty(samples, np.int64),
        ),
        (
            np.empty((tokens, channels), np.float32),  # x
            np.zeros(3 * channels, np.float32),
            np.empty((tokens, 3 * channels), np.float32),  # q, k, v
            np.empty((tokens, channels), np.float32),
            score,
        ),
        (
            np.empty(
                (4, max(channels + CUES, 2 * channels, views, SCORE_HIDDEN)), np.float32
            ),  # one token's way through the weights
            np.empty((samples, channels), np.float32),  # s
            np.empty((samples, 3), np.float32),
            np.empty((samples, classes), np.float32),  # carried labels
            np.empty((samples, 2 * channels), np.float32),
            np.empty((samples, channels), np.float32),
            np.empty(samples, np.float32),  # sigma
            np.empty(samples, np.float32),  # delta
        ),
        (
            np.zeros((samples, 2 * channels + 4), np.float32),
            np.empty((samples, 32), np.float32),
            np.empty((samples, 16), np.float32),
            np.empty((samples, 48), np.float32),
            np.zeros((samples, 16), np.float32),
            score,
            np.empty(samples, np.int64),
        ),
    )


@numba.njit(fastmath=True, nogil=True, cache=True)
def _render_ray(r, rays, sources, settings, weights, scratch, out):
    """One ray, from reprojection to the composited feature."""
    origin, direction, z = rays
    heads, keep, log_ratio = settings
    cue_w, cue_b, radial, cross, blend, density, semantic = weights
    (token_view, token_sample, token_label), token_data, groups, attention, blending, density_scratch = scratch
    feature, rgb, cues, mixture = token_data
    by_view, view_size, by_sample, sample_size = groups
    x, zero, qkv, mixed, score = attention
    one, s, blended, labels, wide, refined, sigma, delta = blending
    rendered, colour, depth, opacity, known, carried = out
    samples, channels = s.shape
    norm = math.sqrt(direction[r, 0] ** 2 + direction[r, 1] ** 2 + direction[r, 2] ** 2)
    for k in range(samples - 1):
        delta[k] = (z[r, k + 1] - z[r, k]) * norm
    delta[samples - 1] = delta[samples - 2]
    count = _fill_tokens(
        origin[r],
        direction[r],
        z[r],
        delta,
        sources,
        token_view,
        token_sample,
        token_label,
        feature,
        rgb,
        cues,
        mixture,
    )
    known[r] = count > 0
    _group_tokens(token_view, token_sample, count, by_view, view_size, by_sample, sample_size)
    linear(cues, count, cue_w, cue_b, x)
    for t in range(count):
        for c in range(channels):
            x[t, c] += feature[t, c]
    if radial[0].shape[0] > 0:
        _attention_layer(x, by_view, view_size, count, radial[0], radial[1], zero, heads, keep, qkv, mixed, score)
    if cross[0].shape[0] > 0:
        _attention_layer(x, by_sample, sample_size, count, cross[0], cross[1], zero, heads, keep, qkv, mixed, score)
    _blend(x, cues, rgb, by_sample, sample_size, blend, log_ratio, one, s, blended)
    _carry_labels(token_label, cues, by_sample, sample_size, labels)
    _density(feature, cues, by_sample, sample_size, delta, density, density_scratch, sigma)
    linear(s, samples, semantic[0], semantic[1], wide)
    relu(wide, samples, 2 * channels)
    linear(wide, samples, semantic[2], semantic[3], refined)
    for k in range(samples):
        for c in range(channels):
            refined[k, c] += s[k, c]
    opacity[r], depth[r] = _composite(refined, blended, labels, sigma, delta, z[r], rendered[r], colour[r], carried[r])


@parallel_kernel(fastmath=True)
def render_rays(rays, sources, settings, weights, tasks, out):
    """Render all rays; see ``SRay.render_samples``.

    Args:
        rays: origin (R, 3), direction (R, 3), z (R, N) ascending.
        sources: maps (m, h, w, C + 3) features and colour, geometry (m, h, w, 5), K (m, 4) fx fy cx cy, T (m, 3, 4),
            known labels (m, H, W).
        settings: heads, weight of the residual, ln(1 / tau).
        weights: See ``sray_streaming.pack_weights``.
        tasks: Number of blocks the rays are split into; each has its own scratch.
        out: rendered (R, C), colour (R, 3), depth (R,), opacity (R,), known (R,), carried labels (R, L).
    """
    count, samples = rays[2].shape
    views, channels = sources[0].shape[0], sources[0].shape[3] - 3
    block = (count + tasks - 1) // tasks
    cue_w, cue_b, radial, cross, blend, density, semantic = weights  # a parallel loop takes no nested tuple
    for task in numba.prange(tasks):
        packed = (cue_w, cue_b, radial, cross, blend, density, semantic)
        scratch = _make_scratch(views, samples, channels, out[5].shape[1])
        for r in range(task * block, min((task + 1) * block, count)):
            _render_ray(r, rays, sources, settings, packed, scratch, out)
