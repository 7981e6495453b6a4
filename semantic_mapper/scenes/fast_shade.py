"""Colour of every first hit, compiled: procedural texture, ambient light, lamps with soft shadows, mirrors.

``reference.shade_hits`` is the same in plain torch; a test holds the two together. Textures are in ``fast_textures``.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.scenes.fast_cast import first_hit
from semantic_mapper.scenes.fast_textures import texture
from semantic_mapper.types import Float32

SHADOW_BIAS_M = 0.03
LIGHT_RADIUS_SQ = 0.5  # softens the fall-off near a light, square metres
CORNER_DIM = 0.3  # share of the ambient light that a wall, floor or ceiling takes from what touches it
CORNER_REACH_M = 0.18


def shade_pixels(  # type: ignore[no-untyped-def]
    depth, index, prims, materials, lights, origin, camera_axes, fx, fy, cx, cy
) -> Float32:
    """Linear RGB (H, W, 3) float32 of the hits that ``fast_cast.cast_pixels`` found; misses are black.

    ``prims``, ``materials`` and ``lights`` are the named tuples of ``scene.kernel_arrays``; they are unpacked once:
    an array that is taken out of a tuple for every pixel costs more than the shading.
    """
    return _shade_all(depth, index, origin, camera_axes, fx, fy, cx, cy, *prims, *materials, *lights)


@kernel(error_model="numpy")
def _shade_all(  # type: ignore[no-untyped-def]
    depth, index, origin, camera_axes, fx, fy, cx, cy,
    shape, center, half, rotation, material,
    pattern, color_a, color_b, scale, seed, emission, gloss, mirror,
    position, light_color, shadow, softness, ambient, room, low, high,
):  # fmt: skip
    height, width = depth.shape
    out = np.zeros((height, width, 3), np.float32)
    normal, world, view = np.empty(3), np.empty(3), np.empty(3)
    color, local, own, albedo, light = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    ray = np.empty(3)
    for v in range(height):
        for u in range(width):
            p = index[v, u]
            if p < 0:
                continue
            x, y, z = (u - cx) / fx * depth[v, u], (v - cy) / fy * depth[v, u], depth[v, u]
            for i in range(3):
                view[i] = -(camera_axes[i, 0] * x + camera_axes[i, 1] * y + camera_axes[i, 2] * z)
                world[i] = origin[i] - view[i]
            share = 1.0  # of this picture point that the surface at ``world`` makes up
            while share > 0.0:
                axis = _normal(p, world, shape, center, half, rotation, local, own, normal)
                m = material[p]
                texture(pattern[m], m, color_a, color_b, scale[m], seed[m], local, p, half, axis, albedo)
                _lighting(
                    world,
                    normal,
                    view,
                    gloss[m],
                    position,
                    light_color,
                    shadow,
                    softness,
                    ambient,
                    room,
                    low,
                    high,
                    light,
                )
                shows = mirror[m] if share == 1.0 else 0.0  # a mirror in a mirror shows its own colour
                for i in range(3):
                    color[i] = albedo[i] * (light[i] + emission[m])
                    out[v, u, i] += share * (1.0 - shows) * color[i]
                share *= shows
                if share > 0.0:
                    _mirror_ray(view, normal, ray)
                    t, p = first_hit(shape, center, half, rotation, world, ray)
                    if p < 0:
                        break
                    for i in range(3):
                        world[i], view[i] = world[i] + t * ray[i], -t * ray[i]
    return out


@kernel(error_model="numpy", inline=True)
def _mirror_ray(view, normal, ray):  # type: ignore[no-untyped-def]
    """Writes the unit vector into which a mirror sends what is seen along ``view``."""
    length = np.sqrt(view[0] * view[0] + view[1] * view[1] + view[2] * view[2])
    facing = (normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2]) / length
    for i in range(3):
        ray[i] = 2.0 * facing * normal[i] - view[i] / length


@kernel(error_model="numpy", inline=True)
def _normal(p, world, shape, center, half, rotation, local, own, normal):  # type: ignore[no-untyped-def]
    """Writes the point ``world`` in primitive p's own axes and the unit normal there; its dominant own axis."""
    for i in range(3):
        local[i] = 0.0
        for j in range(3):
            local[i] += rotation[p, j, i] * (world[j] - center[p, j])
    axis = _own_normal(shape[p], local, p, half, own)
    for i in range(3):
        normal[i] = rotation[p, i, 0] * own[0] + rotation[p, i, 1] * own[1] + rotation[p, i, 2] * own[2]
    return axis


@kernel(error_model="numpy", inline=True)
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
    radial = np.sqrt(qx * qx + qy * qy)
    radius = 0.8 - 0.2 * qz
    lid = (shape == 1 and abs(qz) >= radial) or (shape == 3 and 1.0 - abs(qz) < abs(radial - radius))
    if lid:
        own[2] = 1.0 if local[2] > 0 else -1.0
        return 2
    nx, ny, nz = qx / half[p, 0], qy / half[p, 1], 0.0
    if shape == 2:
        nz = qz / half[p, 2]
    elif shape == 3:
        nz = 0.2 * radius / half[p, 2]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    own[0], own[1], own[2] = nx / length, ny / length, nz / length
    if abs(own[0]) >= abs(own[1]) and abs(own[0]) >= abs(own[2]):
        return 0
    return 1 if abs(own[1]) >= abs(own[2]) else 2


@kernel(error_model="numpy", inline=True)
def _lighting(  # type: ignore[no-untyped-def]
    world, normal, view, gloss, position, light_color, shadow, softness, ambient, room, low, high, out
):
    around = (0.75 + 0.25 * normal[2]) * _openness(world, normal, room)
    for i in range(3):
        out[i] = ambient[i] * around
    view_length = np.sqrt(view[0] ** 2 + view[1] ** 2 + view[2] ** 2)
    for k in range(position.shape[0]):
        lx = position[k, 0] - world[0]
        ly = position[k, 1] - world[1]
        lz = position[k, 2] - world[2]
        square = lx * lx + ly * ly + lz * lz
        length = np.sqrt(square)
        cosine = (normal[0] * lx + normal[1] * ly + normal[2] * lz) / length
        if cosine <= 0.0:
            continue
        lit = _visible(shadow, low, high, k, softness[k], -lx, -ly, -lz)
        if lit == 0.0:
            continue
        shine = 0.0
        if gloss > 0.0:
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


@kernel(error_model="numpy", inline=True)
def _openness(world, normal, room):  # type: ignore[no-untyped-def]
    """Share of the ambient light that reaches a point: less near the room's walls, floor and ceiling."""
    share = 1.0
    for i in range(3):
        if abs(normal[i]) < 0.7:
            low, high = world[i] / CORNER_REACH_M, (room[i] - world[i]) / CORNER_REACH_M
            share *= (1.0 - CORNER_DIM / (1.0 + low * low)) * (1.0 - CORNER_DIM / (1.0 + high * high))
    return share


@kernel(error_model="numpy", inline=True)
def _visible(shadow, low, high, k, softness, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Share of the light that reaches a point at (dx, dy, dz) from it: four spots of the shadow map, ``softness``
    pixels off the middle each way, each the weighted mean of four pixels. ``low`` and ``high`` are the map's extremes
    round each pixel: they answer at once wherever no edge of a shadow is near."""
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
    z = major - SHADOW_BIAS_M * (1.0 + 0.5 * major)
    mu, mv = min(max(int(np.floor(u + 0.5)), 0), n - 1), min(max(int(np.floor(v + 0.5)), 0), n - 1)
    if low[k, face, mv, mu] >= z:
        return 1.0
    if high[k, face, mv, mu] < z:
        return 0.0
    lit = 0.0
    for corner in range(4):
        x = u + (softness if corner & 1 else -softness)
        y = v + (softness if corner & 2 else -softness)
        fx, fy = np.floor(x), np.floor(y)
        wx, wy = x - fx, y - fy
        x0, y0 = min(max(int(fx), 0), n - 1), min(max(int(fy), 0), n - 1)
        x1, y1 = min(max(int(fx) + 1, 0), n - 1), min(max(int(fy) + 1, 0), n - 1)
        if shadow[k, face, y0, x0] >= z:
            lit += (1 - wx) * (1 - wy)
        if shadow[k, face, y0, x1] >= z:
            lit += wx * (1 - wy)
        if shadow[k, face, y1, x0] >= z:
            lit += (1 - wx) * wy
        if shadow[k, face, y1, x1] >= z:
            lit += wx * wy
    return 0.25 * lit
