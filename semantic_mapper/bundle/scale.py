"""How long a unit of a map without scale is: from coarse poses in metres over a long way, or by the floor."""

from __future__ import annotations

from collections import deque

import numpy as np

from semantic_mapper.types import Float64

_STEP_M = 0.2  # ways are compared over at least so much, so that a reference's jitter does not add to them
_FIRST_M = 0.6  # of way, for a first scale
_WINDOW_M = 4.0  # of way that the scale is taken over
_MAX_RATIO = 3.0  # a way that differs so much from the others means a slip or a jump

_BINS = 60
_STRONG = 0.2  # of the strongest layer below the camera: the lowest layer that is as strong is the floor
_LEAST_POINTS = 20
_MOST_BELOW, _MARGIN = 0.03, 0.1  # fraction of the points further below it than this part of the camera's height


class ScaleEstimator:
    """Compares lengths of ways between the same moments in the map and in a reference (robot odometry, a board): how
    the reference's world is turned does not matter, and its drift hardly."""

    def __init__(self) -> None:
        self._ways: deque[tuple[float, float]] = deque()  # the same way in metres and in units of the map
        self._start: tuple[Float64, Float64] | None = None  # positions in metres, and in the map

    def add(self, reference: Float64, position: Float64) -> None:
        """Where the camera is by the reference (3,) in metres, and in the map (3,) in its units."""
        if self._start is None:
            self._start = reference, position
            return
        metres = float(np.linalg.norm(reference - self._start[0]))
        if metres < _STEP_M:
            return
        self._ways.append((metres, float(np.linalg.norm(position - self._start[1]))))
        self._start = reference, position
        while sum(metres for metres, _ in self._ways) > _WINDOW_M + _STEP_M:
            self._ways.popleft()

    def interrupt(self) -> None:
        """The next positions are not connected with the last ones: the camera was lost, or the reference was."""
        self._start = None

    def rescaled(self, factor: float, T_before: Float64, T_after: Float64) -> None:
        """The map's unit has changed, as ``VisualOdometry.rescale`` does it."""
        self._ways = deque((metres, factor * units) for metres, units in self._ways)
        if self._start is not None:
            offset = T_before[:3, :3].T @ (self._start[1] - T_before[:3, 3])
            self._start = self._start[0], T_after[:3, 3] + T_after[:3, :3] @ (factor * offset)

    def scale(self) -> float | None:
        """Metres a unit; None before ``_FIRST_M`` of way."""
        ways = np.array([way for way in self._ways if way[1] > 0]).reshape(-1, 2)
        metres, units = ways.T
        if metres.sum() < _FIRST_M:
            return None
        ratio = metres / units
        kept = np.abs(np.log(ratio / np.median(ratio))) < np.log(_MAX_RATIO)
        return float(metres[kept].sum() / units[kept].sum())


def floor_height(z: Float64, camera_z: float) -> float | None:
    """z of the floor: the lowest strong layer of points with z (N,) below the camera; None if no floor is found."""
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
