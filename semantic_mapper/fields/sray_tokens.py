"""The tokens of S-Ray's compiled renderer: which views see which samples of a ray, and what they say of them.

A token is one (view, sample) pair. Shapes: m views, N samples, C channels.
"""

from __future__ import annotations

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
import math

import numba
import numpy as np

from semantic_mapper.fields.kernel_math import sigmoid
from semantic_mapper.fields.projection import MIN_DEPTH_M

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
def fill_tokens(
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


@numba.njit(fastmath=True, nogil=True, cache=True)
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
