"""The floor among points of a scene whose z is up."""

from __future__ import annotations

import numpy as np

from semantic_mapper.types import Float64

_BINS = 60
_STRONG = 0.2  # of the strongest layer below the camera: the lowest layer that is as strong is the floor
_LEAST_POINTS = 20
_MOST_BELOW, _MARGIN = 0.03, 0.1  # fraction of the points further below it than this part of the camera's height


def floor_height(z: Float64, camera_z: float) -> float | None:
    """z of the floor: the lowest strong layer of points below the camera; None if no floor is found.

    Args:
        z: (N,) of points.
        camera_z: Of the cameras that see them, the median.
    """
    below = z[z < camera_z]
    if len(below) < _LEAST_POINTS:
        return None
    low = float(np.percentile(below, 0.5))
    counts, edges = np.histogram(below, bins=_BINS, range=(low - 1e-6, camera_z))
    summed = np.convolve(counts, (1, 1, 1), mode="same")  # a layer lies across bins
    strong = np.flatnonzero(summed >= max(_LEAST_POINTS, _STRONG * summed.max()))
    if not len(strong):
        return None
    at = int(strong[0])
    while at + 1 < len(summed) and summed[at + 1] > summed[at]:  # to the top of this layer
        at += 1
    near = below[(below >= edges[max(at - 1, 0)]) & (below <= edges[min(at + 2, len(edges) - 1)])]
    floor = float(np.median(near))
    deep = floor - _MARGIN * (camera_z - floor)
    return floor if (below < deep).mean() < _MOST_BELOW else None  # a bed or a table
