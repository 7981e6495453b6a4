"""Which way is up in a finished map, for formats and grids that need to know."""

from __future__ import annotations

import numpy as np

from semantic_mapper.evaluation.upright import upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float64

SNAP_DEG = 0.5  # nearer to an axis of the world than the search can tell apart: it is that axis


def find_up(points: MapPoints, label_set: LabelSet) -> Float64:
    """Up (3,) in the world: the direction along which floors and tables make the sharpest layers.

    Looks near the axes of the world (about ten degrees), as the overview picture does where it has no poses. Which end
    is up, points labelled "floor" and "ceiling" say; where there are none, the fuller layer is taken for the floor.
    """
    up = upright_rotation(points.xyz)[2]
    axis = np.eye(3)[int(np.abs(up).argmax())] * np.sign(up[np.abs(up).argmax()])
    if up @ axis > np.cos(np.deg2rad(SNAP_DEG)):
        up = axis
    height = points.xyz @ up
    rise = 0.0
    for name, sign in (("floor", -1.0), ("ceiling", 1.0)):
        named = [i for i, n in zip(label_set.ids, label_set.names, strict=True) if n == name]
        of_name = height[np.isin(points.label, named)]
        if len(of_name):
            rise += sign * float(np.median(of_name) - np.median(height))
    return -up if rise < 0 else up


def turn_onto(a: Float64, b: Float64) -> Float64:
    """The least rotation (3, 3) that takes unit vector ``a`` to ``b``; half a turn about x or y for opposite ones."""
    c = float(a @ b)
    if c < -1 + 1e-9:
        side = np.cross(b, (0.0, 0.0, 1.0) if abs(b[2]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        return 2 * np.outer(side, side) - np.eye(3)
    x, y, z = v = np.cross(a, b)
    return np.array(((c, -z, y), (z, c, -x), (-y, x, c))) + np.outer(v, v) / (1 + c)
