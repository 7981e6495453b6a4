"""The smallest upright box round points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.types import Float64


@dataclass(frozen=True, slots=True, eq=False)
class OrientedBox:
    """A box that stands upright.

    Args:
        center: (3,) float64 world metres.
        size: (3,) float64 metres along its own axes: x the longer level side, y the shorter, z along up.
        R_world_box: (3, 3) float64, columns are its axes in the world.
    """

    center: Float64
    size: Float64
    R_world_box: Float64


def upright_box(xyz: Float64, up: Float64) -> OrientedBox:
    """The box round points that is level and has the least floor area; one of its sides lies on their hull.

    Args:
        xyz: (N, 3) points, N > 0.
        up: (3,) unit vector.
    """
    frame = _level_frame(up)
    middle = xyz.mean(axis=0)
    plan = (xyz - middle) @ frame
    hull = cv2.convexHull(plan[:, :2].astype(np.float32)).reshape(-1, 2).astype(np.float64)
    yaw = _best_yaw(hull)
    if np.diff(np.ptp(plan[:, :2] @ _turn(yaw), axis=0))[0] > 0:
        yaw += np.pi / 2
    R = frame.copy()
    R[:, :2] = frame[:, :2] @ _turn(yaw)
    own = (xyz - middle) @ R
    low, high = own.min(axis=0), own.max(axis=0)
    return OrientedBox(middle + R @ ((low + high) / 2), high - low, R)


def _level_frame(up: Float64) -> Float64:
    """A right-handed rotation (3, 3) whose third column is ``up``; the identity for up = z."""
    ux, uy, uz = up
    x = np.array((uz, 0.0, -ux) if abs(uy) < 0.9 else (-uy, ux, 0.0))
    x /= np.linalg.norm(x)
    y = np.array((uy * x[2] - uz * x[1], uz * x[0] - ux * x[2], ux * x[1] - uy * x[0]))
    return np.stack((x, y, up), axis=1)


def _turn(yaw: float) -> Float64:
    """(2, 2) whose columns are the axes turned by ``yaw``."""
    return np.array(((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))))


def _best_yaw(hull: Float64) -> float:
    """Of the directions of a hull's (N, 2) sides, below 90 degrees, the one with the least area; the smaller of two."""
    sides = np.roll(hull, -1, axis=0) - hull
    yaws = [math.atan2(y, x) % (math.pi / 2) for x, y in sides if x or y]
    if not yaws:  # one point
        return 0.0
    c, s = np.array([[math.cos(yaw)] for yaw in yaws]), np.array([[math.sin(yaw)] for yaw in yaws])
    along, across = hull[:, 0] * c + hull[:, 1] * s, hull[:, 1] * c - hull[:, 0] * s  # (sides, N)
    return min(zip(np.ptp(along, axis=1) * np.ptp(across, axis=1), yaws, strict=True))[1]
