"""S-Ray's renderer as one compiled pass per ray: reproject, gather, attend, blend, composite, without temporaries.

The same arithmetic as ``SRay.render_samples`` (which stays the readable reference; a test holds both together), with
what only costs time left out: samples outside a view are dropped instead of masked, and nothing leaves the cache
between two steps. Shapes: m views, R rays, N samples, C channels; a token is one (view, sample) pair.
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numpy as np

from semantic_mapper.fields.geometry_net import LEAST_VISIBILITY, OWN_DENSITY_OFFSET
from semantic_mapper.fields.kernel_math import (
    ROWS,
    attend,
    fast_exp,
    linear,
    make_attention_scratch,
    relu,
    softplus,
    tanh,
)
from semantic_mapper.fields.sray import DOUBT, HIDDEN
from semantic_mapper.fields.sray_tokens import drop_tokens, fill_tokens, group_tokens
from semantic_mapper.threads import inlined_kernel, parallel_kernel

CUES = 4
SCORE_HIDDEN = 16  # hidden width of ViewWeightNet
_ZERO = np.float32(0.0)


@inlined_kernel
def _attention_layer(x, groups, sizes, count, qkv_weight, out_weight, zero_bias, heads, keep, qkv, mixed, scratch):
    """x <- keep * x + f(x), attention within each group of tokens (Eq. 6 to 8)."""
    inner = out_weight.shape[0]
    channels = out_weight.shape[1]
    linear(x, count, qkv_weight, zero_bias[: 3 * inner], qkv)
    for g in range(groups.shape[0]):
        if sizes[g] > 0:
            attend(qkv, groups[g], sizes[g], heads, inner // heads, scratch, mixed)
    linear(mixed, count, out_weight, zero_bias[:channels], qkv)
    for t in range(count):
        for c in range(channels):
            x[t, c] = keep * x[t, c] + qkv[t, c]


@inlined_kernel
def _score_views(x, cues, count, weights, log_ratio, occlusion, scratch):
    """Of each token its weight in the semantic ray, not yet normalised, and the logit of its weight in the colour."""
    joined, hidden, score = scratch
    w1, b1, w2, b2 = weights
    channels = x.shape[1]
    for t in range(count):
        for c in range(channels):
            joined[t, c] = x[t, c]
        for c in range(CUES):
            joined[t, channels + c] = cues[t, c]
    linear(joined, count, w1, b1, hidden)
    relu(hidden, count, w1.shape[1])
    for t in range(count):
        semantic_score, colour_score = b2[0], b2[1]
        for c in range(w1.shape[1]):
            semantic_score += hidden[t, c] * w2[0, c]
            colour_score += hidden[t, c] * w2[1, c]
        # Of tau^-0.5 times as much as Eq. 12 says, which the sum over the views divides out.
        weight = fast_exp(np.float32(0.5) * log_ratio * (tanh(semantic_score) - np.float32(1.0)))
        if occlusion:
            weight *= cues[t, 1] + np.float32(LEAST_VISIBILITY)
        score[t, 0], score[t, 1] = weight, colour_score


@inlined_kernel
def _blend(x, rgb, by_sample, sizes, score, s, colour):
    """Semantic ray s and colour of each sample (Eq. 11, 12); the logits in ``score`` become weights."""
    channels = s.shape[1]
    for k in range(by_sample.shape[0]):
        for c in range(channels):
            s[k, c] = 0
        for c in range(3):
            colour[k, c] = 0
        total, colour_total, top = _ZERO, _ZERO, np.float32(-1e30)
        for i in range(sizes[k]):
            top = max(top, score[by_sample[k, i], 1])
        for i in range(sizes[k]):
            t = by_sample[k, i]
            score[t, 1] = fast_exp(score[t, 1] - top)
            total += score[t, 0]
            colour_total += score[t, 1]
        for i in range(sizes[k]):
            t = by_sample[k, i]
            w, wc = score[t, 0] / total, score[t, 1] / colour_total
            for c in range(channels):
                s[k, c] += w * x[t, c]
            for c in range(3):
                colour[k, c] += wc * rgb[t, c]


@inlined_kernel
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


@inlined_kernel
def _density(feature, cues, by_sample, sizes, delta, weights, zero, scratch, sigma):
    """Density of each sample of one ray from what all views say about it; see ``DensityNet``."""
    w1, b1, w2, b2, wqkv, v1, c1, v2, c2 = weights
    inputs, hidden, token, qkv, mixed, attention, active = scratch
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
            total += cues[by_sample[k, i], 1] + np.float32(LEAST_VISIBILITY)
        total = max(total, np.float32(1e-6))
        for i in range(n):
            t = by_sample[k, i]
            share = (cues[t, 1] + np.float32(LEAST_VISIBILITY)) / total
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
    linear(token, samples, wqkv, zero, qkv)
    attend(qkv, active, count, 1, w2.shape[1], attention, mixed)
    for k in range(samples):
        for c in range(w2.shape[1]):
            token[k, c] += mixed[k, c]
    linear(token, samples, v1, c1, hidden)
    relu(hidden, samples, v1.shape[1])
    for i in range(count):
        k = active[i]
        gain, own = c2[0], c2[1]
        for c in range(v1.shape[1]):
            gain += hidden[k, c] * v2[0, c]
            own += hidden[k, c] * v2[1, c]
        gain = min(max(gain, np.float32(-4.0)), np.float32(4.0))
        sigma[k] = sigma[k] * math.exp(gain) + softplus(own - np.float32(OWN_DENSITY_OFFSET))


@inlined_kernel
def _weigh(sigma, delta, z, least, weight, share):
    """Compositing weights (N,) of one ray, and those of the samples that are looked at, 0 for the faint ones.

    Returns:
        Opacity and expected depth of the ray.
    """
    optical, opacity, depth = _ZERO, _ZERO, _ZERO
    for k in range(z.shape[0]):
        step = sigma[k] * delta[k]
        weight[k] = np.float32(math.exp(-optical)) * np.float32(-math.expm1(-step))
        optical += step
        opacity += weight[k]
        depth += weight[k] * z[k]
    kept = _ZERO
    for k in range(z.shape[0]):
        share[k] = weight[k] if weight[k] >= least * opacity else _ZERO
        kept += share[k]
    for k in range(z.shape[0]):
        share[k] *= opacity / max(kept, np.float32(1e-12))
    return opacity, (depth / max(opacity, np.float32(1e-6)) if opacity > 1e-3 else _ZERO)


@inlined_kernel
def _composite(s, colour, labels, weight, share, out, rendered_colour, carried):
    """Eq. 13 over one ray: fills out (C,), rendered_colour (3,), carried (L,)."""
    for c in range(out.shape[0]):
        out[c] = 0
    for c in range(3):
        rendered_colour[c] = 0
    for c in range(carried.shape[0]):
        carried[c] = 0
    for k in range(weight.shape[0]):
        for c in range(out.shape[0]):
            out[c] += share[k] * s[k, c]
        for c in range(3):
            rendered_colour[c] += share[k] * colour[k, c]
        for c in range(carried.shape[0]):
            carried[c] += weight[k] * labels[k, c]


@inlined_kernel
def _make_scratch(views, samples, channels, classes):
    """Buffers of one thread: tokens, their groups, attention, samples, density."""
    tokens = -(-views * samples // ROWS) * ROWS
    rows = -(-samples // ROWS) * ROWS
    return (
        (np.empty(tokens, np.int64), np.empty(tokens, np.int64), np.empty(tokens, np.int64)),  # view, sample, label
        (
            np.zeros((tokens, channels), np.float32),  # feature
            np.empty((tokens, 3), np.float32),  # colour
            np.empty((tokens, CUES), np.float32),
            np.zeros(4 * tokens, np.float32),  # arguments of the depth mixture's logistics
            np.empty(tokens, np.float32),  # share of the first of them
        ),
        (
            np.empty((views, samples), np.int64),  # tokens by view
            np.empty(views, np.int64),
            np.empty((samples, views), np.int64),  # tokens by sample
            np.empty(samples, np.int64),
        ),
        (
            np.zeros(max(3 * channels, 48), np.float32),  # the bias of layers without one
            np.empty((tokens, 3 * channels), np.float32),  # q, k, v
            np.zeros((tokens, channels), np.float32),
            make_attention_scratch(channels, max(views, samples)),
        ),
        (
            np.zeros((tokens, channels + CUES), np.float32),
            np.empty((tokens, SCORE_HIDDEN), np.float32),
            np.empty((tokens, 2), np.float32),
        ),
        (
            np.zeros((rows, channels), np.float32),  # s
            np.empty((samples, 3), np.float32),
            np.empty((samples, classes), np.float32),  # carried labels
            np.empty((rows, 2 * channels), np.float32),
            np.empty((rows, channels), np.float32),
            np.empty(samples, np.float32),  # sigma
            np.empty(samples, np.float32),  # delta
            np.empty(samples, np.float32),  # weight
            np.empty(samples, np.float32),  # weight of those looked at
            np.empty(samples, np.float32),  # visibility from the view that sees the sample best
        ),
        (
            np.zeros((rows, 2 * channels + 4), np.float32),
            np.empty((rows, 32), np.float32),
            np.empty((rows, 16), np.float32),
            np.empty((rows, 48), np.float32),
            np.zeros((rows, 16), np.float32),
            make_attention_scratch(16, samples),
            np.empty(samples, np.int64),
        ),
    )


@inlined_kernel
def _render_ray(r, rays, sources, settings, weights, scratch, out):
    """One ray, from reprojection to the composited feature."""
    origin, direction, z = rays
    heads, keep, log_ratio, occlusion, least = settings
    radial, cross, blend, density, semantic = weights
    places, token_data, groups, attention, scoring, blending, density_scratch = scratch
    token_view, token_sample, token_label = places
    feature, rgb, cues = token_data[:3]
    by_view, view_size, by_sample, sample_size = groups
    zero, qkv, mixed, attending = attention
    s, blended, labels, wide, refined, sigma, delta, weight, share, clearest = blending
    rendered, colour, depth, opacity, known, carried = out
    samples, channels = z.shape[1], s.shape[1]
    norm = math.sqrt(direction[r, 0] ** 2 + direction[r, 1] ** 2 + direction[r, 2] ** 2)
    for k in range(samples - 1):
        delta[k] = (z[r, k + 1] - z[r, k]) * norm
    delta[samples - 1] = delta[samples - 2]
    count = fill_tokens(origin[r], direction[r], z[r], delta, sources, places, token_data)
    known[r] = count > 0
    group_tokens(token_view, token_sample, count, by_view, view_size, by_sample, sample_size)
    _carry_labels(token_label, cues, by_sample, sample_size, labels)
    _density(feature, cues, by_sample, sample_size, delta, density, zero, density_scratch, sigma)
    opacity[r], depth[r] = _weigh(sigma, delta, z[r], least, weight, share)
    if occlusion or least > 0:
        hidden_below = np.float32(HIDDEN) if occlusion else _ZERO
        count = drop_tokens(count, hidden_below, share, clearest, token_view, token_sample, feature, rgb, cues)
        group_tokens(token_view, token_sample, count, by_view, view_size, by_sample, sample_size)
    if radial[0].shape[0] > 0:
        _attention_layer(
            feature, by_view, view_size, count, radial[0], radial[1], zero, heads, keep, qkv, mixed, attending
        )
    if cross[0].shape[0] > 0:
        _attention_layer(
            feature, by_sample, sample_size, count, cross[0], cross[1], zero, heads, keep, qkv, mixed, attending
        )
    _score_views(feature, cues, count, blend, log_ratio, occlusion, scoring)
    _blend(feature, rgb, by_sample, sample_size, scoring[2], s, blended)
    linear(s, samples, semantic[0], semantic[1], wide)
    relu(wide, samples, 2 * channels)
    linear(wide, samples, semantic[2], semantic[3], refined)
    for k in range(samples):
        for c in range(channels):
            refined[k, c] += s[k, c]
    _composite(refined, blended, labels, weight, share, rendered[r], colour[r], carried[r])


@parallel_kernel(fastmath=True, chunks_per_thread=4)
def render_rays(start, stop, rays, sources, settings, weights, out):
    """Render all rays; see ``SRay.render_samples``.

    Args:
        start, stop: Range of rays; the caller passes their number instead.
        rays: origin (R, 3), direction (R, 3), z (R, N) ascending.
        sources: maps (m, h, w, C + 3) features and colour, geometry (m, h, w, 6) with the
            logarithm of the first scale at the end, K (m, 4) fx fy cx cy, T (m, 3, 4),
            known labels (m, H, W), or (m, 0, 0) where there are none.
        settings: heads, weight of the residual, ln(1 / tau), whether views count by their visibility, least weight of a
            sample that is looked at.
        weights: See ``sray_streaming.pack_weights``.
        out: rendered (R, C), colour (R, 3), depth (R,), opacity (R,), known (R,), carried labels (R, L).
    """
    views, channels = sources[0].shape[0], sources[0].shape[3] - 3
    scratch = _make_scratch(views, rays[2].shape[1], channels, out[5].shape[1])
    for r in range(start, stop):
        _render_ray(r, rays, sources, settings, weights, scratch, out)
