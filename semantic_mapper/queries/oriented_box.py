"""The smallest upright box round points."""

from __future__ import annotations

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
    edges = np.roll(hull, -1, axis=0) - hull
    edges = edges[np.linalg.norm(edges, axis=1) > 0]
    yaws = np.unique(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2)) if len(edges) else np.zeros(1)
    areas = [float(np.prod(np.ptp(hull @ _turn(yaw), axis=0))) for yaw in yaws]
    yaw = float(yaws[int(np.argmin(areas))])
    if np.diff(np.ptp(plan[:, :2] @ _turn(yaw), axis=0))[0] > 0:
        yaw += np.pi / 2
    R = frame.copy()
    R[:, :2] = frame[:, :2] @ _turn(yaw)
    own = (xyz - middle) @ R
    low, high = own.min(axis=0), own.max(axis=0)
    return OrientedBox(middle + R @ ((low + high) / 2), high - low, R)


def _level_frame(up: Float64) -> Float64:
    """A right-handed rotation (3, 3) whose third column is ``up``; the identity for up = z."""
    x = np.cross((0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (0.0, 0.0, 1.0), up)
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(up, x), up), axis=1)


def _turn(yaw: float) -> Float64:
    """(2, 2) whose columns are the axes turned by ``yaw``."""
    return np.array(((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))))
