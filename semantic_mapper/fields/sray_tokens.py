"""The tokens of S-Ray's compiled renderer: which views see which samples of a ray, and what they say of them.

A token is one (view, sample) pair. Shapes: m views, N samples, C channels.
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numba
import numpy as np

from semantic_mapper.fields.projection import MIN_DEPTH_M
from semantic_mapper.fields.simd import LANES, load, logistic, multiply, multiply_add, splat, store
from semantic_mapper.threads import inlined_kernel

_ZERO = np.float32(0.0)


@numba.njit(inline="always", fastmath=True)
def _gather_sample(maps, j, u, v, token, feature, rgb):
    """Bilinear features and colour of view j at pixel (u, v), with the border repeated, as those of a token."""
    height, width, stride, channels = maps.shape[1], maps.shape[2], maps.shape[3], feature.shape[1]
    x = min(max(u, _ZERO), np.float32(width - 1))
    y = min(max(v, _ZERO), np.float32(height - 1))
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    fx, fy = x - np.float32(x0), y - np.float32(y0)
    w00, w01 = (1 - fx) * (1 - fy), fx * (1 - fy)
    w10, w11 = (1 - fx) * fy, fx * fy
    even = channels // LANES * LANES
    upper, lower = (j * height + y0) * width, (j * height + y1) * width
    p00, p01, p10, p11 = (upper + x0) * stride, (upper + x1) * stride, (lower + x0) * stride, (lower + x1) * stride
    for c in range(0, even, LANES):
        value = multiply(splat(w00), load(maps, p00 + c))
        value = multiply_add(splat(w01), load(maps, p01 + c), value)
        value = multiply_add(splat(w10), load(maps, p10 + c), value)
        value = multiply_add(splat(w11), load(maps, p11 + c), value)
        store(feature, token * channels + c, value)
    for c in range(even, channels + 3):
        one = w00 * maps[j, y0, x0, c] + w01 * maps[j, y0, x1, c] + w10 * maps[j, y1, x0, c] + w11 * maps[j, y1, x1, c]
        if c < channels:
            feature[token, c] = one
        else:
            rgb[token, c - channels] = one


@numba.njit(inline="always", fastmath=True)
def _nearest(place, size):
    """Row or column of the nearest pixel, the border repeated."""
    return min(max(int(np.rint(place)), 0), size - 1)


@numba.njit(inline="always", fastmath=True)
def _hits(count, ends, shares, cues):
    """Probability that a view's ray ends in the sample, and that it gets there at all: the first two cues.

    Args:
        ends: Flat; of each token the arguments of the mixture's two logistics at the sample's near and its far end.
        shares: (T,) of the first logistic.
    """
    for i in range(0, 4 * count, LANES):
        store(ends, i, logistic(load(ends, i)))
    for t in range(count):
        share = shares[t]
        near = share * ends[4 * t] + (1 - share) * ends[4 * t + 1]
        far = share * ends[4 * t + 2] + (1 - share) * ends[4 * t + 3]
        cues[t, 0] = far - near
        cues[t, 1] = 1 - near


@inlined_kernel
def fill_tokens(origin, direction, z, delta, sources, places, data):
    """Reproject the samples of one ray into all views (Eq. 4, 5); return the number of tokens that some view sees.

    Args:
        sources: maps, geometry, K, T and labels as ``sray_kernel.render_rays`` takes them.
        places: View, sample and known label of each token; filled.
        data: Features, colours and cues of each token, and two buffers of ``_hits``; filled.
    """
    maps, geometry, K, T, labels = sources
    token_view, token_sample, token_label = places
    feature, rgb, cues, ends, shares = data
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
            _gather_sample(maps, j, u, v, count, feature, rgb)
            pixel = geometry[j, _nearest(v, height), _nearest(u, width)]
            half = np.float32(0.5) * delta[k]
            first, second = np.float32(1.0) / pixel[1], np.float32(1.0) / pixel[3]
            ends[4 * count], ends[4 * count + 1] = (pz - half - pixel[0]) * first, (pz - half - pixel[2]) * second
            ends[4 * count + 2], ends[4 * count + 3] = (pz + half - pixel[0]) * first, (pz + half - pixel[2]) * second
            shares[count] = pixel[4]
            cues[count, 2] = (px * dx + py * dy + pz * dz) / (math.sqrt(px * px + py * py + pz * pz) * length)
            cues[count, 3] = pixel[5]
            token_label[count] = -1
            if rows > 0:
                row = _nearest((v + np.float32(0.5)) * np.float32(rows / height) - np.float32(0.5), rows)
                column = _nearest((u + np.float32(0.5)) * np.float32(columns / width) - np.float32(0.5), columns)
                token_label[count] = labels[j, row, column]
            token_view[count], token_sample[count] = j, k
            count += 1
    _hits(count, ends, shares, cues)
    return count


@inlined_kernel
def group_tokens(token_view, token_sample, count, by_view, view_size, by_sample, sample_size):
    """List the tokens of each view and of each sample."""
    view_size[:] = 0
    sample_size[:] = 0
    for t in range(count):
        j, k = token_view[t], token_sample[t]
        by_view[j, view_size[j]] = t
        view_size[j] += 1
        by_sample[k, sample_size[k]] = t
        sample_size[k] += 1


@inlined_kernel
def drop_tokens(count, hidden_below, share, clearest, token_view, token_sample, feature, rgb, cues):
    """Move the tokens that ``SRay.without_hidden`` and ``without_faint`` keep to the front; return how many they are.

    Args:
        share: (N,) weight of each sample, 0 = faint.
        clearest: (N,) buffer; becomes the best visibility of each sample.
    """
    clearest[:] = _ZERO
    for t in range(count):
        k = token_sample[t]
        clearest[k] = max(clearest[k], cues[t, 1])
    kept = 0
    for t in range(count):
        k = token_sample[t]
        if cues[t, 1] < hidden_below <= clearest[k] or share[k] == 0:
            continue
        if kept < t:
            token_view[kept], token_sample[kept] = token_view[t], k
            feature[kept], rgb[kept], cues[kept] = feature[t], rgb[t], cues[t]
        kept += 1
    return kept
