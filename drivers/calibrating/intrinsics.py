"""Focal length, principal point and lens distortion of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.coverage import area_counts, shortfalls, tilt_degrees
from semantic_mapper.drivers.calibrating.views import BoardView
from semantic_mapper.drivers.poses.board import board_poses, pose_of_vector
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import CameraIntrinsics, Float64

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OUTLIER = 3.0  # times the median error of a view: it was blurred, or the board was bent
OUTLIER_FLOOR_PX = 0.3
MAX_LEFT_OUT = 0.2  # fraction of the views
_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera and how it came about.

    Args:
        intrinsics: With distortion.
        estimated: False where they were given, and only compared with the views.
        rms_px: Root mean square of the distances of corners, seen and predicted.
        sigmas: One-sigma uncertainty by name (fx, fy, cx, cy, k1, ...); empty where they were given.
        views: Those used.
        residuals: (N, 2) a view, seen minus predicted, pixels.
        errors_px: RMS of each view.
        tilts: (V, 2) degrees; counts: corners a cell; see ``coverage``.
        left_out: Names of views that did not fit the others.
    """

    intrinsics: CameraIntrinsics
    estimated: bool
    rms_px: float
    sigmas: dict[str, float]
    views: tuple[BoardView, ...]
    residuals: tuple[Float64, ...]
    errors_px: tuple[float, ...]
    tilts: Float64
    counts: NDArray[np.int64]
    left_out: tuple[str, ...] = ()


def calibrate_camera(
    camera_id: str, views: Sequence[BoardView], size: tuple[int, int], config: CalibrationConfig
) -> CameraCalibration:
    """Calibrate from views that are unlike each other.

    Raises:
        CameraError: the views cover too little, do not fit each other, or leave the focal length open; says which.
    """
    counts = area_counts([v.pixels for v in views], size)
    early = shortfalls(config, len(views), counts, None)
    if early:
        raise _refusal(camera_id, early)
    left_out: list[str] = []
    used = list(views)
    found = _calibrate(used, size, config)
    for _ in range(2):
        errors = np.array(found.errors_px)
        limit = max(OUTLIER * float(np.median(errors)), OUTLIER_FLOOR_PX)
        worst = [i for i in np.argsort(-errors) if errors[i] > limit]
        worst = worst[: int(MAX_LEFT_OUT * len(views)) - len(left_out)]
        if not worst:
            break
        left_out += [used[i].name for i in worst]
        used = [view for i, view in enumerate(used) if i not in worst]
        found = _calibrate(used, size, config)
    _check(camera_id, found, config)
    return CameraCalibration(
        found.intrinsics,
        True,
        found.rms_px,
        found.sigmas,
        found.views,
        found.residuals,
        found.errors_px,
        found.tilts,
        found.counts,
        tuple(left_out),
    )


def compare_camera(
    camera_id: str, views: Sequence[BoardView], intrinsics: CameraIntrinsics, config: CalibrationConfig
) -> CameraCalibration:
    """How well a camera that is calibrated already fits its views.

    Raises:
        CameraError: no view, or they do not fit.
    """
    ideal = CameraIntrinsics(
        intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.width, intrinsics.height
    )
    poses: list[Float64] = []
    residuals: list[Float64] = []
    used: list[BoardView] = []
    for view in views:
        found = board_poses(view.points, ideal_pixels(view.pixels, intrinsics), ideal)
        if found:
            poses.append(pose_of_vector(found[0][1]))
            residuals.append(view.pixels - _project(view.points, found[0][1], intrinsics))
            used.append(view)
    if not used:
        raise _refusal(camera_id, ("the board was seen in none of its images",))
    result = _gather(intrinsics, False, {}, used, residuals, poses)
    _check_error(camera_id, result, config)
    return result


def ideal_pixels(pixels: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """(N, 2) -> where a camera without distortion, otherwise the same, would see them."""
    if not any(intrinsics.distortion):
        return pixels
    K = camera_matrix(intrinsics)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    ideal = cv2.undistortImagePoints(pixels[:, None], K, np.array(intrinsics.distortion), None, criteria)
    return np.asarray(ideal, np.float64).reshape(-1, 2)


def _calibrate(views: Sequence[BoardView], size: tuple[int, int], config: CalibrationConfig) -> CameraCalibration:
    points = [v.points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32)[:, None] for v in views]
    start: Float64 = np.eye(3)
    try:
        _, K, lens, turns, shifts, sigmas, _, _ = cv2.calibrateCameraExtended(
            points, pixels, size, start, np.zeros(5), flags=_FLAGS[config.coefficients]
        )
    except cv2.error as error:
        raise CameraError(
            f"the views allow no calibration: {error.err}; are board and its sizes the right ones?"
        ) from error
    distortion = tuple(float(v) for v in np.ravel(lens)[: config.coefficients])
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    if not np.isfinite((fx, fy, cx, cy, *distortion)).all() or not (0 < cx < size[0] and 0 < cy < size[1]):
        raise CameraError(
            f"the views lead to an impossible camera (fx {fx:.0f}, centre {cx:.0f}, {cy:.0f}); are board and its sizes "
            "the right ones, and is it flat?"
        )
    try:
        intrinsics = CameraIntrinsics(fx, fy, cx, cy, *size, distortion)
    except FrameError as error:
        raise CameraError(f"the views lead to an impossible camera: {error}; are board and its sizes right?") from error
    names = ("fx", "fy", "cx", "cy", *COEFFICIENT_NAMES[: config.coefficients])
    sigma_by_name: dict[str, float] = dict(zip(names, (float(v) for v in np.ravel(sigmas)), strict=False))
    vectors = [
        np.concatenate((np.ravel(r), np.ravel(t))).astype(np.float64) for r, t in zip(turns, shifts, strict=True)
    ]
    residuals = [v.pixels - _project(v.points, pose, intrinsics) for v, pose in zip(views, vectors, strict=True)]
    return _gather(intrinsics, True, sigma_by_name, views, residuals, [pose_of_vector(v) for v in vectors])


def _gather(
    intrinsics: CameraIntrinsics,
    estimated: bool,
    sigmas: dict[str, float],
    views: Sequence[BoardView],
    residuals: Sequence[Float64],
    poses: Sequence[Float64],
) -> CameraCalibration:
    errors = tuple(float(np.sqrt((r**2).sum(axis=1).mean())) for r in residuals)
    return CameraCalibration(
        intrinsics,
        estimated,
        float(np.sqrt((np.concatenate(list(residuals)) ** 2).sum(axis=1).mean())),
        sigmas,
        tuple(views),
        tuple(residuals),
        errors,
        np.array([tilt_degrees(T) for T in poses]),
        area_counts([v.pixels for v in views], (intrinsics.width, intrinsics.height)),
    )


def _project(points: Float64, pose: Float64, intrinsics: CameraIntrinsics) -> Float64:
    lens = np.array(intrinsics.distortion or (0.0,) * 4, np.float64)
    seen, _ = cv2.projectPoints(points, pose[:3], pose[3:], camera_matrix(intrinsics), lens)
    return np.asarray(seen, np.float64).reshape(-1, 2)


def _check(camera_id: str, found: CameraCalibration, config: CalibrationConfig) -> None:
    lacks = shortfalls(config, len(found.views), found.counts, found.tilts)
    if lacks:
        raise _refusal(camera_id, lacks)
    _check_error(camera_id, found, config)
    fraction = max(found.sigmas["fx"] / found.intrinsics.fx, found.sigmas["fy"] / found.intrinsics.fy)
    if fraction > config.max_focal_sigma:
        raise _refusal(
            camera_id,
            (
                f"the focal length is known to {100 * fraction:.2f} % only (one sigma; "
                f"{100 * config.max_focal_sigma:g} % "
                "is needed): show the board nearer, and lean it further, in more images",
            ),
        )


def _check_error(camera_id: str, found: CameraCalibration, config: CalibrationConfig) -> None:
    if found.rms_px > config.max_error_px:
        raise _refusal(
            camera_id,
            (
                f"corners are off by {found.rms_px:.2f} px (RMS; {config.max_error_px:g} are allowed): check the sizes "
                "of the board, glue it to something flat, hold it still, and use sharp images",
            ),
        )


def _refusal(camera_id: str, lacks: Sequence[str]) -> CameraError:
    return CameraError(f"camera '{camera_id}' cannot be calibrated from these images: {'; '.join(lacks)}")
