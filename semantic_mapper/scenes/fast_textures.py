"""The procedural patterns, compiled; ``textures`` holds their twins in plain torch."""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel


@kernel(inline=True)
def _hash(i, j, seed):  # type: ignore[no-untyped-def]
    """Two integers and a seed -> [0, 1), the same on every machine."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 1911520717) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@kernel(error_model="numpy")
def _noise(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth value noise in [0, 1]."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = int(fx), int(fy)
    a, b = x - fx, y - fy
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    top = _hash(i, j, seed) * (1 - a) + _hash(i + 1, j, seed) * a
    low = _hash(i, j + 1, seed) * (1 - a) + _hash(i + 1, j + 1, seed) * a
    return top * (1 - b) + low * b


@kernel(error_model="numpy")
def texture(pattern, m, color_a, color_b, scale, seed, local, p, half, axis, out):  # type: ignore[no-untyped-def]
    """Writes the albedo. (s, t) are the two own axes across the normal; for wood and planks t is the longer side."""
    first, second = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
    if (pattern == 1 or pattern == 8) and half[p, first] > half[p, second]:
        first, second = second, first
    s, t = local[first] / scale, local[second] / scale
    f, third = 0.0, 0.0
    if pattern == 0:
        f = _noise(s, t, seed)
    elif pattern == 1:
        f = 0.7 * _noise(s, t * 0.06, seed) + 0.3 * _noise(s * 3.0, t * 0.2, seed + 1)
    elif pattern == 2:
        f = 1.0 if s - np.floor(s) < 0.5 else 0.0
    elif pattern == 3:
        f = float((int(np.floor(s)) + int(np.floor(t))) & 1)
    elif pattern == 4:
        ds, dt = s - np.floor(s), t - np.floor(t)
        joint = ds < 0.04 or dt < 0.04
        f = 1.0 if joint else 0.3 * _hash(int(np.floor(s)), int(np.floor(t)), seed)
    elif pattern == 5:
        f = 0.5 * _noise(s, t * 0.25, seed) + 0.5 * _noise(s * 0.25, t, seed + 1)
    elif pattern == 6:
        n = 0.65 * _noise(s, t, seed) + 0.35 * _noise(s * 2.7, t * 2.7, seed + 1)
        f = 1.0 if n > 0.5 else 0.0
        third = 1.0 if 0.44 < n < 0.5 else 0.0
    elif pattern == 7:
        cell = int(np.floor(s + 0.35 * _hash(int(np.floor(s)), 7, seed)))
        f = _hash(cell, 1, seed)
        third = _hash(cell, 2, seed) * 0.6
    else:
        f = _planks(s, t, seed)
    for i in range(3):
        base = color_a[m, i] * (1 - f) + color_b[m, i] * f
        out[i] = base * (1 - third) + third * (0.5 * color_a[m, 2 - i] + 0.3 * color_b[m, i])


@kernel(error_model="numpy", inline=True)
def _planks(s, t, seed):  # type: ignore[no-untyped-def]
    """Boards one unit wide and eight long, each of its own shade, with grain and dark joints."""
    row = int(np.floor(s))
    along = t * 0.125 + _hash(row, 3, seed)
    ds, dt = s - np.floor(s), along - np.floor(along)
    if ds < 0.03 or dt < 0.004:
        return 1.0
    return 0.55 * _hash(row, int(np.floor(along)), seed) + 0.3 * _noise(s * 8.0, t * 0.5, seed + 1)
