"""How long a unit of a map without scale is: from coarse poses in metres over a long way, or by the floor."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from semantic_mapper.types import Float64

_STEP_M = 0.2  # ways are compared over at least so much, so that a reference's jitter does not add to them
_FIRST_M = 0.6  # of way, for a first scale
_WINDOW_M = 4.0  # of way that the scale is taken over
_MAX_RATIO = 3.0  # a way that differs so much from the others means a slip or a jump

# Of a floor, in parts of the camera's height over it: half its thickness, and how far below it points contradict it.
_LAYER, _MARGIN = 0.03, 0.1
_STRAYS, _STRAY_FRACTION = 3, 0.008  # such points, of all: in nine films 0.1 to 0.6 %; below a table over 1.7 %
_LEAST_POINTS, _LEAST_FRACTION = 20, 0.015  # on it; 3.0 to 17 %
_DENSER = 2.0  # than a layer of the same thickness four such halves higher; 2.1 to 21
_MANY, _WIDE = 100, 0.2  # points of one that is sure, and its standard deviation across
_CANDIDATES = 16  # heights along each direction


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


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """The lowest large plane under a camera."""

    up: Float64  # (3,) unit normal
    below: float  # how far the camera is over it, in units of the map
    points: int  # that lie on it
    unsure: bool  # it is small, narrow, or hardly denser than what lies above it: the height may be a tenth off


def find_floor(xyz: Float64, camera: Float64, up: Float64, cone_deg: float = 0.0) -> Floor | None:
    """The floor under a camera at (3,), by points (N, 3) that are well known; None where it is not seen for sure.

    Hardly a point lies below a floor, and right above it are fewer points than on it: a table has points below, and
    furniture whose feet are hidden ends in no layer. ``up`` (3,) is a unit direction, which may be ``cone_deg`` off.
    """
    strays = max(_STRAYS, round(_STRAY_FRACTION * len(xyz)))
    least = max(_LEAST_POINTS, round(_LEAST_FRACTION * len(xyz)))
    best: tuple[int, Float64, float] | None = None
    for direction in cone(up, cone_deg, 1.0):
        below = np.sort((camera - xyz) @ direction)
        below = below[np.searchsorted(below, 0.0) :]
        if len(below) < strays + least:
            continue
        lowest = float(below[-1 - strays])
        at = np.geomspace(lowest / (1 + _MARGIN), lowest * (1 + _MARGIN), _CANDIDATES)
        low, high, far, near, deep = (
            np.searchsorted(below, factor * at)
            for factor in (1 - _LAYER, 1 + _LAYER, 1 - 5 * _LAYER, 1 - 3 * _LAYER, 1 + _MARGIN)
        )
        on = high - low
        good = (on >= least) & (on >= _DENSER * (near - far)) & (len(below) - deep <= strays)
        row = int(np.argmax(on * good))
        if good[row] and (best is None or on[row] > best[0]):
            best = int(on[row]), direction, float(at[row])
    if best is None:
        return None
    _, up, height = best
    spread = np.zeros(3)
    for _ in range(4):
        on = xyz[np.abs((camera - xyz) @ up - height) < _LAYER * height]
        center = on.mean(axis=0)
        spread, axes = np.linalg.eigh((on - center).T @ (on - center) / len(on))
        if cone_deg:
            up = axes[:, 0] * np.sign(axes[:, 0] @ up)
        height = float(np.median((camera - on) @ up))
    depth = (camera - xyz) @ up / height
    count, above = (int((np.abs(depth - at) < _LAYER).sum()) for at in (1.0, 1.0 - 4 * _LAYER))
    narrow = bool(np.sqrt(spread[1]) < _WIDE * height)
    return Floor(up, height, count, narrow or count < max(_MANY, 1.5 * _DENSER * above))


def cone(axis: Float64, half_deg: float, step_deg: float) -> Float64:
    """Unit directions (N, 3) within an angle of an axis, about a step apart; the axis comes first."""
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    rows = [axis]
    for tilt in np.radians(np.arange(step_deg, half_deg + 1e-9, step_deg)):
        count = max(6, int(np.ceil(2 * np.pi * np.sin(tilt) / np.radians(step_deg))))
        turn = np.arange(count)[:, None] * 2 * np.pi / count
        ring = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
        rows += list(np.cos(tilt) * axis + np.sin(tilt) * ring)
    return np.stack(rows)
