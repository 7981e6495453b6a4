"""How far depth may be believed that no sensor measured.

Depth of a sensor weighs ``MEASURED`` in the TSDF. Computed depth (from the pictures, or rendered by a field) weighs at
most ``COMPUTED_LOOK``, and all of it together at most ``COMPUTED_CAP``: so one measurement outweighs it, and the weight
of a voxel says whether its surface was measured (from ``MEASURED`` on) or computed. Computed depth never changes what
was measured.

A field's depth of a view is a mean along each ray. Where its samples disagree, at edges and where it guesses, it leaves
the smooth surface of its neighbours; and where the map has a surface, it has to lie near that. So its trust falls with
both differences, and is nothing where little would be left. Beyond the map a field mostly guesses: what it says there
weighs so little that many looks have to agree.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.types import Float32

MEASURED = 1.0
COMPUTED_LOOK = 1 / 32
COMPUTED_CAP = 31 / 32
SURFACE_WEIGHT = 4 * COMPUTED_LOOK  # from which on a voxel is part of the surface: four sure looks, or more unsure ones
MOST_TRUST = 1.0  # of a rendered depth
GUESS_TRUST = 0.1  # where the map has no surface yet
LEAST_TRUST = 0.05  # below, nothing is fused
ROUGHNESS = 0.003  # fraction of z by which a pixel may leave the line between its neighbours: trust falls to 1 / e


def depth_trust(depth_m: Float32, map_depth_m: Float32, truncation_m: float) -> Float32:
    """Weight of each rendered depth.

    Args:
        depth_m: (h, w) float32 rendered z, 0 = none.
        map_depth_m: (h, w) float32 z of the map's surface in the same view, 0 = none.
        truncation_m: Of the map; half of it away from its surface trust falls to 1 / e.

    Returns:
        (h, w) float32 in 0..1, 0 where nothing is to be fused.
    """
    roughness = np.maximum(_bend(depth_m, 0), _bend(depth_m, 1)) / np.maximum(depth_m, np.float32(1e-3))
    cost = (roughness / ROUGHNESS) ** 2
    off = 2 * (depth_m - map_depth_m) / truncation_m
    cost += np.where(map_depth_m > 0, off * off, 0)
    trust = np.where(map_depth_m > 0, MOST_TRUST, GUESS_TRUST) * np.exp(-cost)
    return np.where((depth_m > 0) & (trust >= LEAST_TRUST), trust, 0).astype(np.float32)


def _bend(depth_m: Float32, axis: int) -> Float32:
    """How far each pixel lies from the line between its two neighbours along an axis; inf beside unknown ones."""
    known = np.where(depth_m > 0, depth_m, np.inf)
    padded = np.pad(known, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect")
    before, after = (padded[:-2], padded[2:]) if axis == 0 else (padded[:, :-2], padded[:, 2:])
    with np.errstate(invalid="ignore"):
        bend = np.abs(0.5 * (before + after) - known)
    return np.where(np.isfinite(bend), bend, np.inf).astype(np.float32)
