"""How far a frame's pose is off from views of the last seconds, by depth alone, and the pose without that.

Gauss-Newton from point to plane on small depth images, with a prior that the given pose is right to within ``SIGMA_M``
and ``SIGMA_RAD``: a pose that jitters or drifts is put right, one that jumps is not, and ``misfit`` tells. Most of what
moves is no part of it: it is farther from what was there than residuals that count. Wider ``CUTS`` put right more, and
people who walk pull at the pose.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.types import Float32, Float64

CUTS = (1.0, 1.0, 0.5)  # margins within which residuals count, by iteration
SIGMA_M, SIGMA_RAD = 0.05, 0.026
_SIGMA_DEPTH_M, _INDEPENDENT = 0.03, 60.0  # of depth, and how many residuals are as good as independent
_EDGE = 0.1  # change of depth from cell to cell, as a fraction of it, from which on it is no surface
LEAST_POINTS, LEAST_FRACTION = 30, 0.2  # on surfaces that views saw: to judge at all; of those compared, to fit
_NEAREST_M = 0.1


class Alignment(NamedTuple):
    """Outcome.

    Args:
        T_world_camera: (4, 4) put right; as given where it does not fit or cannot be compared.
        moved: (6,) by how much: translation, metres, and rotation, radians, in the camera.
        misfit: Median distance of points from the surface that views saw, in margins; points in front of it by more
            than a margin do not count. inf where most is elsewhere, 0 where there is too little to compare with.
    """

    T_world_camera: Float64
    moved: Float64
    misfit: float


class SlopedViews(NamedTuple):
    """V views of one size.

    Args:
        T_camera_world: (V, 4, 4).
        focal, centre: (V, 2) in cells, whose centres have whole numbers.
        slopes: (V, 3, h, w) of ``depth_slopes``.
    """

    T_camera_world: Float64
    focal: Float32
    centre: Float32
    slopes: Float32


def depth_slopes(depth_m: Float32) -> Float32:
    """(3, h, w) depth, metres, and its change from cell to cell along rows and columns; NaN at edges and holes.

    Args:
        depth_m: (h, w) 0 = none.
    """
    z = np.where(depth_m > 0, depth_m, np.float32(np.nan))
    slopes = np.full((3, *z.shape), np.nan, np.float32)
    slopes[0, 1:-1, 1:-1] = z[1:-1, 1:-1]
    slopes[1, :, 1:-1] = (z[:, 2:] - z[:, :-2]) / 2
    slopes[2, 1:-1] = (z[2:] - z[:-2]) / 2
    slopes[0, ~(np.abs(slopes[1]) + np.abs(slopes[2]) < _EDGE * z)] = np.nan  # and where it is NaN
    return slopes


def align_pose(points: Float32, T_world_camera: Float64, views: SlopedViews, margin: tuple[float, float]) -> Alignment:
    """Put a pose right by what views saw.

    Args:
        points: (N, 3) that the frame measured, in its camera, metres.
        T_world_camera: (4, 4) as given.
        views: To align with.
        margin: Metres, and metres a metre of depth: residuals beyond ``CUTS`` of it are something else.
    """
    T, moved, misfit = T_world_camera, np.zeros(6), np.inf
    prior = np.repeat((SIGMA_M**-2, SIGMA_RAD**-2), 3)
    for cut in CUTS:
        jacobian, residual, weight, misfit = _residuals(points, T, views, margin, cut)
        if not len(residual):
            return Alignment(T_world_camera, np.zeros(6), misfit)
        scale = _INDEPENDENT / (weight.sum() * _SIGMA_DEPTH_M**2)
        weighted = (scale * weight)[:, None] * jacobian
        change = np.linalg.solve(weighted.T @ jacobian + np.diag(prior), -weighted.T @ residual - prior * moved)
        moved += change
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = cv2.Rodrigues(change[3:])[0], change[:3]
        T = T @ step
    return Alignment(T, moved, misfit)


def _residuals(
    points: Float32, T_world_camera: Float64, views: SlopedViews, margin: tuple[float, float], cut: float
) -> tuple[Float64, Float64, Float64, float]:
    """Of points that count: d residual / d (translation, rotation) (M, 6) in the camera, residual (M,), weight (M,);
    and the misfit of all."""
    T_view_camera = views.T_camera_world @ T_world_camera
    R = T_view_camera[:, :3, :3].astype(np.float32)
    p = R @ points.T + T_view_camera[:, :3, 3:].astype(np.float32)  # V 3 N
    xy = p[:, :2] / np.maximum(p[:, 2:], _NEAREST_M) * views.focal[..., None] + views.centre[..., None]
    cell = np.rint(xy).astype(np.int32)
    h, w = views.slopes.shape[2:]
    x, y = cell[:, 0], cell[:, 1]
    view, number = np.nonzero((p[:, 2] > _NEAREST_M) & (x >= 0) & (y >= 0) & (x < w) & (y < h))
    depth, along_x, along_y = views.slopes.transpose(1, 0, 2, 3)[:, view, y[view, number], x[view, number]]
    off = xy[view, :, number] - cell[view, :, number]
    q = p[view, :, number]  # M 3
    residual = depth + along_x * off[:, 0] + along_y * off[:, 1] - q[:, 2]  # NaN at edges
    relative = residual / (margin[0] + margin[1] * q[:, 2])
    fits, compared = int((np.abs(relative) < 1).sum()), int(np.isfinite(relative).sum())
    if fits < max(LEAST_POINTS, LEAST_FRACTION * compared):
        return np.empty((0, 6)), np.empty(0), np.empty(0), np.inf if compared >= LEAST_POINTS else 0.0
    misfit = float(np.median(np.abs(relative[relative < 1])))
    use = np.abs(relative) < cut
    q, view, number, residual = q[use], view[use], number[use], residual[use]
    slope = np.stack((along_x[use], along_y[use]), axis=1) * views.focal[view] / q[:, 2:]
    normal = np.concatenate((slope, -1 - (slope * q[:, :2]).sum(axis=1, keepdims=True) / q[:, 2:]), axis=1)
    # A slanted surface, and a distant one, is less sure; what nears the cut counts less.
    weight = (1 - (relative[use] / cut) ** 2) ** 2 / ((normal**2).sum(axis=1) * q[:, 2] ** 2)
    normal = np.einsum("mi,mij->mj", normal, R[view])  # in the camera of the frame
    jacobian = np.concatenate((normal, np.cross(points[number], normal)), axis=1)
    return jacobian.astype(np.float64), residual.astype(np.float64), weight.astype(np.float64), misfit
