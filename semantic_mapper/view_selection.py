"""What views see of a surface, and which few of many show most of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

SAME_SURFACE = 0.05  # fraction of z by which a measured depth may differ from a point's and still be of its surface
GUESSED_DEPTHS_M = (0.7, 1.5, 3.0)  # where points are put on rays without a measurement
LABELLED_VALUE = 2.0  # of a view whose labels are known, against one without
REPEAT_VALUE = 0.5  # a second view of the same point is worth half of the first, a third a quarter


def visible_points(
    points: Float64, T_world_camera: Float64, intrinsics: CameraIntrinsics, depth_m: Float32, *, measured: bool
) -> NDArray[np.bool_]:
    """Which points a view sees: (P,), those in its image that nothing hides. A hole in its depth hides nothing.

    Args:
        points: (P, 3) world.
        T_world_camera: (4, 4) of the view.
        intrinsics: Of ``depth_m``.
        depth_m: (H, W) float32, 0 = none.
        measured: The points lie on measured surfaces, so a depth beyond them speaks of another surface. Else they are
            guesses, and only what stands before them tells that they are not seen.
    """
    p = transform(invert_pose(T_world_camera), points)
    inside, row, column = nearest_pixels(p, intrinsics)
    depth, z = depth_m[row, column], p[:, 2]
    free = np.abs(depth - z) < SAME_SURFACE * z if measured else z < depth * (1 + SAME_SURFACE)
    return inside & (free | (depth <= 0))


def select_views(seen: NDArray[np.bool_], value: Float64, bonus: Float64, count: int) -> list[int]:
    """Choose views greedily: each adds most of what is not yet covered.

    Args:
        seen: (K, P) whether view k sees point p.
        value: (K,) what a point that view k sees counts.
        bonus: (K,) added to the gain of views that see anything; breaks ties.
        count: Views wanted.

    Returns:
        At most ``count`` view numbers, the most useful first; none that sees nothing.
    """
    worth = np.ones(seen.shape[1])
    chosen: list[int] = []
    extra = bonus * seen.any(axis=1)
    while len(chosen) < min(count, len(seen)):
        gain = value * (seen @ worth) / max(seen.shape[1], 1) + extra
        gain[chosen] = 0
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        chosen.append(best)
        worth = np.where(seen[best], worth * REPEAT_VALUE, worth)
    return chosen
