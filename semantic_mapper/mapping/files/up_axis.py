"""Which way is up in a finished map, for formats and grids that need to know."""

from __future__ import annotations

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.upright import find_upright
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float64

FLOOR = "floor"  # the class whose points say where down is
LEAST_SHARE = 0.01  # of a map's points that have to be floor
FLAT_M = 0.1  # the middle half of the floor's points lies within so much of height
LEVEL_SHARE = 0.8  # of the floor's points on several storeys, each within so much of height
STOREY_M = 1.8  # storeys are at least so far apart


def find_up(points: MapPoints, label_set: LabelSet) -> Float64:
    """Up (3,) in the world: square to what is labelled floor, away from it, made exact as the overview picture does.

    The picture starts from the camera's poses, which a saved map does not hold; here the floor takes their place.

    Raises:
        MapError: too little of the map is labelled floor, or what is lies in no plane.
    """
    named = [i for i, name in zip(label_set.ids, label_set.names, strict=True) if name == FLOOR]
    floor = points.xyz[np.isin(points.label, named)].astype(np.float64)
    if len(floor) < max(LEAST_SHARE * len(points.xyz), 10):
        raise MapError("which way is up cannot be found: too little of the map is labelled floor; say it with --up")
    rise = points.xyz.mean(axis=0, dtype=np.float64) - floor.mean(axis=0)
    guess = _normal(floor)
    up = find_upright(points.xyz, guess if rise @ guess > 0 else -guess)
    low, high = np.percentile(floor @ up, (25, 75))
    if high - low <= FLAT_M:
        return up
    axis = max(np.eye(3), key=lambda axis: _level_share(floor @ axis))  # floors of storeys lie in no one plane
    up = find_upright(points.xyz, axis if rise @ axis > 0 else -axis)
    if _level_share(floor @ up) < LEVEL_SHARE:
        raise MapError(
            f"which way is up cannot be found: what is labelled floor lies in no plane ({high - low:.2f} m of height); "
            "say it with --up"
        )
    return up


def _level_share(height: Float64) -> float:
    """Fraction of heights (N,), metres, that lie in layers of ``FLAT_M`` which are as far apart as storeys."""
    layer = np.floor((height - height.min()) / (FLAT_M / 2)).astype(np.int64)
    counts = np.convolve(np.bincount(layer), (1, 1))
    apart, found = round(2 * STOREY_M / FLAT_M), 0
    while counts.any():
        best = int(counts.argmax())
        found += int(counts[best])
        counts[max(0, best - apart) : best + apart] = 0
    return found / len(height)


def _normal(xyz: Float64) -> Float64:
    """Normal (3,) of the plane that most points (N, 3) lie near: fitted, and fitted again without the farthest."""
    near = xyz
    normal = np.zeros(3)
    for _ in range(4):
        center = near.mean(axis=0)
        normal = np.linalg.eigh((near - center).T @ (near - center))[1][:, 0]
        distance = np.abs((xyz - np.median(near, axis=0)) @ normal)
        near = xyz[distance <= np.percentile(distance, 70)]
    return normal
