"""Colour of every first hit, compiled: procedural texture, ambient light, point lights with shadow cubes.

``reference.shade_hits`` is the same in plain torch; a test holds the two together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

SHADOW_BIAS_M = 0.03
LIGHT_RADIUS_SQ = 0.5  # softens the fall-off near a light, square metres


@njit(cache=True, nogil=True, error_model="numpy")
def shade_pixels(  # type: ignore[no-untyped-def]
    depth, index, shape, center, half, rotation, material,
    pattern, color_a, color_b, scale, seed, emission, gloss,
    light_position, light_color, shadow, ambient, origin, camera_axes, fx, fy, cx, cy,
):  # fmt: skip
    """Linear RGB (H, W, 3) float32 of the hits that ``fast_cast.cast_pixels`` found; misses are black."""
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.float32)
    local, own, normal, world, view = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    albedo, light = np.empty(3), np.empty(3)
    for v in range(height):
        for u in range(width):
            p = index[v, u]
            if p < 0:
                continue
            x, y, z = (u - cx) / fx * depth[v, u], (v - cy) / fy * depth[v, u], depth[v, u]
            for i in range(3):
                view[i] = -(camera_axes[i, 0] * x + camera_axes[i, 1] * y + camera_axes[i, 2] * z)
                world[i] = origin[i] - view[i]
            for i in range(3):
                local[i] = 0.0
                for j in range(3):
                    local[i] += rotation[p, j, i] * (world[j] - center[p, j])
            axis = _own_normal(shape[p], local, p, half, own)
            for i in range(3):
                normal[i] = rotation[p, i, 0] * own[0] + rotation[p, i, 1] * own[1] + rotation[p, i, 2] * own[2]
            m = material[p]
            _texture(pattern[m], m, color_a, color_b, scale[m], seed[m], local, p, half, axis, albedo)
            _lighting(world, normal, view, gloss[m], light_position, light_color, shadow, ambient, light)
            for i in range(3):
                out[v, u, i] = albedo[i] * (light[i] + emission[m])
    return out


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _own_normal(shape, local, p, half, own):  # type: ignore[no-untyped-def]
    """Writes the unit normal in the primitive's own axes; returns its dominant axis."""
    own[0], own[1], own[2] = 0.0, 0.0, 0.0
    qx, qy, qz = local[0] / half[p, 0], local[1] / half[p, 1], local[2] / half[p, 2]
    if shape == 0:
        axis = 2
        if abs(qx) >= abs(qy) and abs(qx) >= abs(qz):
            axis = 0
        elif abs(qy) >= abs(qz):
            axis = 1
        own[axis] = 1.0 if local[axis] > 0 else -1.0
        return axis
    if shape == 1 and abs(qz) >= np.sqrt(qx * qx + qy * qy):
        own[2] = 1.0 if local[2] > 0 else -1.0
        return 2
    nx, ny = qx / half[p, 0], qy / half[p, 1]
    nz = qz / half[p, 2] if shape == 2 else 0.0
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    own[0], own[1], own[2] = nx / length, ny / length, nz / length
    if abs(own[0]) >= abs(own[1]) and abs(own[0]) >= abs(own[2]):
        return 0
    return 1 if abs(own[1]) >= abs(own[2]) else 2


@njit(cache=True, nogil=True, inline="always")
def _hash(i, j, seed):  # type: ignore[no-untyped-def]
    """Two integers and a seed -> [0, 1), the same on every machine."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 1911520717) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@njit(cache=True, nogil=True, error_model="numpy")
def _noise(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth value noise in [0, 1]."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = int(fx), int(fy)
    a, b = x - fx, y - fy
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    top = _hash(i, j, seed) * (1 - a) + _hash(i + 1, j, seed) * a
    low = _hash(i, j + 1, seed) * (1 - a) + _hash(i + 1, j + 1, seed) * a
    return top * (1 - b) + low * b


@njit(cache=True, nogil=True, error_model="numpy")
def _texture(pattern, m, color_a, color_b, scale, seed, local, p, half, axis, out):  # type: ignore[no-untyped-def]
    """Writes the albedo. (s, t) are the two own axes across the normal; for wood and spines t is the longer side."""
    first, second = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
    if pattern == 1 and half[p, first] > half[p, second]:
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
    else:
        cell = int(np.floor(s + 0.35 * _hash(int(np.floor(s)), 7, seed)))
        f = _hash(cell, 1, seed)
        third = _hash(cell, 2, seed) * 0.6
    for i in range(3):
        base = color_a[m, i] * (1 - f) + color_b[m, i] * f
        out[i] = base * (1 - third) + third * (0.5 * color_a[m, 2 - i] + 0.3 * color_b[m, i])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lighting(world, normal, view, gloss, light_position, light_color, shadow, ambient, out):  # type: ignore[no-untyped-def]
    sky = 0.75 + 0.25 * normal[2]
    for i in range(3):
        out[i] = ambient[i] * sky
    view_length = np.sqrt(view[0] ** 2 + view[1] ** 2 + view[2] ** 2)
    for k in range(light_position.shape[0]):
        lx = light_position[k, 0] - world[0]
        ly = light_position[k, 1] - world[1]
        lz = light_position[k, 2] - world[2]
        square = lx * lx + ly * ly + lz * lz
        length = np.sqrt(square)
        cosine = (normal[0] * lx + normal[1] * ly + normal[2] * lz) / length
        if cosine <= 0.0:
            continue
        lit = _visible(shadow, k, -lx, -ly, -lz)
        hx = lx / length + view[0] / view_length
        hy = ly / length + view[1] / view_length
        hz = lz / length + view[2] / view_length
        shine = (normal[0] * hx + normal[1] * hy + normal[2] * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
        shine = shine * shine
        shine = shine * shine
        shine = shine * shine
        shine = shine * shine
        strength = lit * (cosine + gloss * shine) / (square + LIGHT_RADIUS_SQ)
        for i in range(3):
            out[i] += strength * light_color[k, i]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _visible(shadow, k, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Share of the light that reaches a point at (dx, dy, dz) from it: four shadow-map pixels, weighted."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax >= ay and ax >= az:
        face, major, a, b = (0 if dx > 0 else 1), ax, dy, dz
    elif ay >= az:
        face, major, a, b = (2 if dy > 0 else 3), ay, dz, dx
    else:
        face, major, a, b = (4 if dz > 0 else 5), az, dx, dy
    n = shadow.shape[2]
    u = (a / major + 1.0) * 0.5 * n - 0.5
    v = (b / major + 1.0) * 0.5 * n - 0.5
    fu, fv = np.floor(u), np.floor(v)
    wu, wv = u - fu, v - fv
    u0, v0 = min(max(int(fu), 0), n - 1), min(max(int(fv), 0), n - 1)
    u1, v1 = min(max(int(fu) + 1, 0), n - 1), min(max(int(fv) + 1, 0), n - 1)
    z = major - SHADOW_BIAS_M * (1.0 + 0.5 * major)
    lit = 0.0
    if shadow[k, face, v0, u0] >= z:
        lit += (1 - wu) * (1 - wv)
    if shadow[k, face, v0, u1] >= z:
        lit += wu * (1 - wv)
    if shadow[k, face, v1, u0] >= z:
        lit += (1 - wu) * wv
    if shadow[k, face, v1, u1] >= z:
        lit += wu * wv
    return lit
