"""First hit of every pixel, compiled: each primitive is tested only inside its rectangle on the screen.

``reference.first_hits`` is the same in plain torch; a test holds the two together.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel

NEAR_M = 0.02  # nothing nearer than this is seen

_INF = np.inf


@kernel(error_model="numpy")
def cast_pixels(shape, center, half, rotation, origin, camera_axes, fx, fy, cx, cy, width, height):  # type: ignore[no-untyped-def]
    """Depth along the camera's z (H, W) float64 (inf = miss) and number of the primitive (H, W) int32 (-1 = miss).

    ``camera_axes`` (3, 3) has the camera's x, y, z axes in world coordinates as columns (any handedness).
    """
    depth = np.full((height, width), _INF)
    index = np.full((height, width), -1, np.int32)
    for p in range(shape.shape[0]):
        to_own = np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                to_own[i, j] = rotation[p, j, i] / half[p, i]
        start, turn = np.zeros(3), np.zeros((3, 3))  # written out: numba's matrix product would need SciPy's BLAS
        for i in range(3):
            for j in range(3):
                start[i] += to_own[i, j] * (origin[j] - center[p, j])
                for k in range(3):
                    turn[i, k] += to_own[i, j] * camera_axes[j, k]
        u0, u1, v0, v1 = _screen_rectangle(
            center[p], half[p], rotation[p], origin, camera_axes, fx, fy, cx, cy, width, height
        )
        for v in range(v0, v1):
            y = (v - cy) / fy
            bx = turn[0, 1] * y + turn[0, 2]
            by = turn[1, 1] * y + turn[1, 2]
            bz = turn[2, 1] * y + turn[2, 2]
            for u in range(u0, u1):
                x = (u - cx) / fx
                dx = turn[0, 0] * x + bx
                dy = turn[1, 0] * x + by
                dz = turn[2, 0] * x + bz
                t = _hit(shape[p], start[0], start[1], start[2], dx, dy, dz)
                if t < depth[v, u]:
                    depth[v, u] = t
                    index[v, u] = p
    return depth, index


@kernel(error_model="numpy")
def first_hit(shape, center, half, rotation, origin, ray):  # type: ignore[no-untyped-def]
    """Ray parameter (inf = miss) and number of the primitive (-1 = miss) of one ray, for the few that mirrors send."""
    nearest, index = _INF, -1
    square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    own_start, own_ray = np.empty(3), np.empty(3)
    for p in range(shape.shape[0]):
        cx, cy, cz = center[p, 0] - origin[0], center[p, 1] - origin[1], center[p, 2] - origin[2]
        along = cx * ray[0] + cy * ray[1] + cz * ray[2]
        reach = half[p, 0] * half[p, 0] + half[p, 1] * half[p, 1] + half[p, 2] * half[p, 2]
        if cx * cx + cy * cy + cz * cz - along * along / square > reach:
            continue
        for i in range(3):
            own_start[i] = -(rotation[p, 0, i] * cx + rotation[p, 1, i] * cy + rotation[p, 2, i] * cz) / half[p, i]
            own_ray[i] = (rotation[p, 0, i] * ray[0] + rotation[p, 1, i] * ray[1] + rotation[p, 2, i] * ray[2]) / half[
                p, i
            ]
        t = _hit(shape[p], own_start[0], own_start[1], own_start[2], own_ray[0], own_ray[1], own_ray[2])
        if t < nearest:
            nearest, index = t, p
    return nearest, index


@kernel(error_model="numpy", inline=True)
def _hit(shape, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Where a ray enters a unit shape (``primitives.Shape``); inf where it does not, or starts inside."""
    if shape == 0:
        t = _hit_box(ox, oy, oz, dx, dy, dz)
    elif shape == 1:
        t = _hit_cylinder(ox, oy, oz, dx, dy, dz)
    elif shape == 2:
        t = _hit_sphere(ox, oy, oz, dx, dy, dz)
    else:
        t = _hit_frustum(ox, oy, oz, dx, dy, dz)
    return t


@kernel(error_model="numpy", inline=True)
def _entry(near, far):  # type: ignore[no-untyped-def]
    return near if (near <= far and near > NEAR_M) else _INF


@kernel(error_model="numpy", inline=True)
def _hit_box(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    ax, bx = (-1.0 - ox) * ix, (1.0 - ox) * ix
    ay, by = (-1.0 - oy) * iy, (1.0 - oy) * iy
    az, bz = (-1.0 - oz) * iz, (1.0 - oz) * iz
    near = max(min(ax, bx), min(ay, by), min(az, bz))
    far = min(max(ax, bx), max(ay, by), max(az, bz))
    return _entry(near, far)


@kernel(error_model="numpy", inline=True)
def _hit_cylinder(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    a = dx * dx + dy * dy
    b = ox * dx + oy * dy
    c = ox * ox + oy * oy - 1.0
    under = b * b - a * c
    if under < 0.0:
        return _INF
    root = np.sqrt(under)
    iz = 1.0 / dz
    az, bz = (-1.0 - oz) * iz, (1.0 - oz) * iz
    near = max((-b - root) / a, min(az, bz))
    far = min((-b + root) / a, max(az, bz))
    return _entry(near, far)


@kernel(error_model="numpy", inline=True)
def _hit_sphere(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    c = ox * ox + oy * oy + oz * oz - 1.0
    under = b * b - a * c
    if under < 0.0:
        return _INF
    root = np.sqrt(under)
    return _entry((-b - root) / a, (-b + root) / a)


@kernel(error_model="numpy")
def _hit_frustum(ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Radius 0.8 - 0.2 z between z = -1 and 1: a slice of the lower half of a double cone with its tip at z = 4."""
    radius, slope = 0.8 - 0.2 * oz, -0.2 * dz
    a = dx * dx + dy * dy - slope * slope
    b = ox * dx + oy * dy - radius * slope
    c = ox * ox + oy * oy - radius * radius
    under = b * b - a * c
    near, far = -_INF, _INF
    if under >= 0.0:
        root = np.sqrt(under)
        first, last = (-b - root) / a, (-b + root) / a
        if a > 0.0:
            near, far = first, last
        elif slope < 0.0:  # going up: inside the lower half up to the earlier of the two crossings
            far = last
        else:
            near = first
    elif a > 0.0:
        return _INF
    iz = 1.0 / dz
    az, bz = (-1.0 - oz) * iz, (1.0 - oz) * iz
    return _entry(max(near, min(az, bz)), min(far, max(az, bz)))


@kernel(error_model="numpy")
def _screen_rectangle(center, half, rotation, origin, camera_axes, fx, fy, cx, cy, width, height):  # type: ignore[no-untyped-def]
    """Pixels [u0, u1) x [v0, v1) that the box round a primitive can cover; its edges are clipped at the near plane."""
    corner = np.empty((8, 3))
    offset = center - origin
    for k in range(8):
        sx = half[0] if k & 1 else -half[0]
        sy = half[1] if k & 2 else -half[1]
        sz = half[2] if k & 4 else -half[2]
        wx = offset[0] + rotation[0, 0] * sx + rotation[0, 1] * sy + rotation[0, 2] * sz
        wy = offset[1] + rotation[1, 0] * sx + rotation[1, 1] * sy + rotation[1, 2] * sz
        wz = offset[2] + rotation[2, 0] * sx + rotation[2, 1] * sy + rotation[2, 2] * sz
        for i in range(3):
            corner[k, i] = camera_axes[0, i] * wx + camera_axes[1, i] * wy + camera_axes[2, i] * wz
    x0, x1, y0, y1 = _INF, -_INF, _INF, -_INF
    for k in range(8):
        if corner[k, 2] >= NEAR_M:
            x, y = corner[k, 0] / corner[k, 2], corner[k, 1] / corner[k, 2]
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        for bit in (1, 2, 4):
            other = k ^ bit
            if corner[k, 2] >= NEAR_M and corner[other, 2] < NEAR_M:
                w = (corner[k, 2] - NEAR_M) / (corner[k, 2] - corner[other, 2])
                x = (corner[k, 0] + w * (corner[other, 0] - corner[k, 0])) / NEAR_M
                y = (corner[k, 1] + w * (corner[other, 1] - corner[k, 1])) / NEAR_M
                x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    if x0 > x1:
        return 0, 0, 0, 0
    u0 = int(np.floor(min(max(x0 * fx + cx, 0.0), float(width))))
    u1 = int(np.ceil(min(max(x1 * fx + cx, -1.0), float(width - 1)))) + 1
    v0 = int(np.floor(min(max(y0 * fy + cy, 0.0), float(height))))
    v1 = int(np.ceil(min(max(y1 * fy + cy, -1.0), float(height - 1)))) + 1
    return u0, u1, v0, v1
