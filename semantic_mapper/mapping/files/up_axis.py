"""Which way is up in a finished map, for formats and grids that need to know."""

from __future__ import annotations

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.upright import upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float64

FLOOR = "floor"  # the class whose points say where down is
LEAST_SHARE = 0.01  # of a map's points that have to be floor
FLAT_M = 0.1  # the middle half of the floor's points lies within so much of height, or it is none
SNAP_DEG = 0.5  # nearer to an axis of the world than the search can tell apart: it is that axis


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
    guess = _normal(floor)
    rises = (points.xyz.mean(axis=0, dtype=np.float64) - np.median(floor, axis=0)) @ guess
    up = upright_rotation(points.xyz, guess if rises > 0 else -guess)[2]
    low, high = np.percentile(floor @ up, (25, 75))
    if high - low > FLAT_M:
        raise MapError(
            f"which way is up cannot be found: what is labelled floor lies in no plane ({high - low:.2f} m of height); "
            "say it with --up"
        )
    axis = np.eye(3)[int(np.abs(up).argmax())] * np.sign(up[np.abs(up).argmax()])
    return axis if up @ axis > np.cos(np.deg2rad(SNAP_DEG)) else up


def turn_onto(a: Float64, b: Float64) -> Float64:
    """The least rotation (3, 3) that takes unit vector ``a`` to ``b``; half a turn about x or y for opposite ones."""
    c = float(a @ b)
    if c < -1 + 1e-9:
        side = np.cross(b, (0.0, 0.0, 1.0) if abs(b[2]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        return 2 * np.outer(side, side) - np.eye(3)
    x, y, z = v = np.cross(a, b)
    return np.array(((c, -z, y), (z, c, -x), (-y, x, c))) + np.outer(v, v) / (1 + c)


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
