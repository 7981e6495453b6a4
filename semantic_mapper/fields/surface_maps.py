"""The geocentric encoding of depth (Gupta et al., ECCV 2014): what an encoder sees of a measured surface.

Inverse depth, height above the lowest point in view, and the angle of the surface to gravity, found by each image."""

import math

import numpy as np

from semantic_mapper.fields.numbers import SURFACE_CHANNELS
from semantic_mapper.types import Bool, Float32, Float64

MEASURED_FRACTION = 0.05  # of the pixels: with less measured depth a view counts as one without
NORMAL_REACH = 2  # pixels to either side between which a normal is taken, at 160 pixels of width
REFERENCE_WIDTH = 160
GRAVITY_COLUMNS = 40  # columns of the coarse grid that gravity and the lowest point are found on
LOWEST_FRACTION = 0.02  # of the points lie below the one that counts as the lowest
NEAREST_M = 0.2
GRAVITY_STEPS_DEG = (45.0, 45.0, 45.0, 15.0, 15.0, 15.0, 15.0)  # from level or plumb that a surface may be, by step


def has_depth(depth_m: Float32) -> bool:
    """Whether enough of a view (H, W) is measured to be worth looking at."""
    return bool(np.count_nonzero(depth_m > 0) >= MEASURED_FRACTION * depth_m.size)


def surface_maps(depth_m: Float32, K: Float32) -> Float32:
    """Maps of the surface (5, H, W) at each pixel of a view (H, W): inverse depth (1 / m), 1 where depth is measured,
    height above the lowest point in view (m), cosines of the normal with up and with the viewing axis (0 next to holes,
    where there is no normal). All 0 where depth is not measured. ``K`` is (3, 3)."""
    maps = np.zeros((SURFACE_CHANNELS, *depth_m.shape), np.float32)
    measured = depth_m > 0
    if not measured.any():  # also spares a field without depth the work
        return maps
    v, u = (np.arange(n, dtype=np.float32) for n in depth_m.shape)
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    points = np.stack((x * depth_m, y[:, None] * depth_m, depth_m))  # in the camera's axes
    normal, known = surface_normals(points, measured, max(1, round(NORMAL_REACH * depth_m.shape[1] / REFERENCE_WIDTH)))
    coarse = slice(None, None, max(1, depth_m.shape[1] // GRAVITY_COLUMNS))
    up = up_direction(normal[:, coarse, coarse], known[coarse, coarse]).astype(np.float32)
    height = np.tensordot(up, points, 1)
    maps[0] = measured / np.maximum(depth_m, np.float32(NEAREST_M))
    maps[1] = measured
    maps[2] = (height - _lowest(height[coarse, coarse], measured[coarse, coarse])) * measured
    maps[3] = np.tensordot(up, normal, 1)
    maps[4] = normal[2]
    return maps


def surface_normals(points: Float32, measured: Bool, reach: int) -> tuple[Float32, Bool]:
    """Normals towards the camera (3, H, W), and where there is one (H, W): central differences of points (3, H, W),
    each between pixels ``reach`` away on either side."""
    r = reach
    normal, known = np.zeros_like(points), np.zeros_like(measured)
    if min(measured.shape) <= 2 * r:
        return normal, known
    middle = slice(r, -r)
    ax, ay, az = points[:, 2 * r :, middle] - points[:, : -2 * r, middle]
    bx, by, bz = points[:, middle, 2 * r :] - points[:, middle, : -2 * r]
    # Written out, because numpy's cross product is slow along the first axis.
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    across = measured[middle, 2 * r :] & measured[middle, : -2 * r]
    known[middle, middle] = measured[middle, middle] & across & measured[2 * r :, middle] & measured[: -2 * r, middle]
    scale = known[middle, middle] / np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-9))
    normal[:, middle, middle] = x * scale, y * scale, z * scale
    return normal, known


def up_direction(normal: Float32, known: Bool) -> Float64:
    """Up (3,) in camera axes: what most surfaces are level or plumb to (Gupta et al., CVPR 2013, section 3).

    Starting from the camera's own up, take the normals near to and near to square with it, and turn up to fit them;
    then the same with closer bounds. ``normal`` (3, h, w), ``known`` (h, w).
    """
    n = normal[:, known].astype(np.float64)  # (3, P)
    up = np.array([0.0, -1.0, 0.0])
    # Keeps up where it is in every direction that no surface speaks of.
    hold = 1e-3 * max(1, n.shape[1])
    for bound_deg in GRAVITY_STEPS_DEG:
        cosine = np.abs(up @ n)
        level = cosine > math.cos(math.radians(bound_deg))
        plumb = cosine < math.sin(math.radians(bound_deg))
        spread = (n * (plumb.astype(float) - level)) @ n.T + hold * (np.eye(3) - np.outer(up, up))
        axis = np.linalg.eigh(spread)[1][:, 0]
        up = -axis if axis @ up < 0 else axis
    return up


def _lowest(height: Float32, measured: Bool) -> np.float32:
    """Height that only ``LOWEST_FRACTION`` of the measured points lie below; 0 where nothing is measured."""
    found = np.sort(height[measured])
    return found[int(len(found) * LOWEST_FRACTION)] if len(found) else np.float32(0)
