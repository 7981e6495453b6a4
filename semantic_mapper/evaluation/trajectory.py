"""The motion that takes a path nearest to another one (Umeyama)."""

from __future__ import annotations

import numpy as np

from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import Float64


def align_rigid(a: Float64, b: Float64) -> Float64:
    """The rigid motion T_b_a (4, 4) that takes points a (N, 3) nearest to points b (N, 3) in least squares.

    Umeyama's closed form with the scale held at 1. Where the points lie on a line, one of the equally good rotations.
    Raises ShapeError: other shapes, or fewer than 3 points.
    """
    sizes = expect_shape(a, "N 3", "points to align")
    if expect_shape(b, "N 3", "points to align to") != sizes or sizes["N"] < 3:
        raise ShapeError(f"alignment needs as many points on both sides, 3 or more; got {len(a)} and {len(b)}")
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((b - center_b).T @ (a - center_a))
    keep = np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u) * np.linalg.det(vt)))))  # a rotation, no mirror
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = u @ keep @ vt
    T_b_a[:3, 3] = center_b - T_b_a[:3, :3] @ center_a
    return T_b_a


def align_similar(a: Float64, b: Float64) -> tuple[Float64, float]:
    """The similarity that takes points a (N, 3) nearest to points b (N, 3) in least squares: ``T_b_a @ (scale * a)``.

    Umeyama's closed form; for paths whose scale is unknown. Raises ShapeError: other shapes, fewer than 3 points, or
    points a that are all one.
    """
    rigid = align_rigid(a, b)
    level_a, level_b = a - a.mean(axis=0), b - b.mean(axis=0)
    size = float((level_a**2).sum())
    if not size > 0:
        raise ShapeError("alignment with scale needs points that are not all one")
    scale = float(((level_a @ rigid[:3, :3].T) * level_b).sum()) / size
    T_b_a = rigid.copy()
    T_b_a[:3, 3] = b.mean(axis=0) - scale * rigid[:3, :3] @ a.mean(axis=0)
    return T_b_a, scale
