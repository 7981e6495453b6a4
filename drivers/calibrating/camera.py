"""Focal length, principal point and lens distortion of one camera, and how well they are known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semantic_mapper.drivers.calibrating.views import (
    BoardView,
    CalibrationConfig,
    area_counts,
    shortfalls,
    tilt_radians,
)
from semantic_mapper.drivers.lens import undistort
from semantic_mapper.drivers.poses.board import board_poses
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.geometry import camera_matrix, make_pose, rotation_vector
from semantic_mapper.types import CameraIntrinsics, Float64

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OUTLIER = 3.0  # times the median error of a view: it was blurred, or the board was bent
OUTLIER_FLOOR_PX = 0.3
MAX_LEFT_OUT = 0.2  # fraction of the views
MAX_FOCAL_SIGMA = 0.005  # one sigma of the focal length, as a fraction of it
_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera and how it came about."""

    intrinsics: CameraIntrinsics  # with distortion
    # One-sigma uncertainty by name (fx, fy, cx, cy, k1, ...); empty where the intrinsics were given, and only compared
    sigmas: dict[str, float]
    rms_px: float  # root mean square of the distances of corners, seen and predicted
    views: tuple[BoardView, ...]  # those used
    errors_px: tuple[float, ...]  # RMS of each view
    tilts: Float64  # (V, 2) degrees: how the board leaned up or down and to a side
    counts: Float64  # corners a cell; see ``views``
    left_out: tuple[str, ...] = ()  # names of views that did not fit the others


def calibrate_camera(
    camera_id: str, views: Sequence[BoardView], size: tuple[int, int], config: CalibrationConfig
) -> CameraCalibration:
    """Calibrate from views that are unlike each other.

    Raises CameraError: the views cover too little, do not fit each other, or leave the focal length open; says which.
    """
    _refuse(camera_id, shortfalls(config, len(views), area_counts(views, size), None))
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
    lacks = shortfalls(config, len(found.views), found.counts, found.tilts)
    _refuse(camera_id, [*lacks, *_inexact(found, config)])
    return replace(found, left_out=tuple(left_out))


def compare_camera(
    camera_id: str, views: Sequence[BoardView], intrinsics: CameraIntrinsics, config: CalibrationConfig
) -> CameraCalibration:
    """How well a camera that is calibrated already fits its views. Raises CameraError: no view, or they do not fit."""
    ideal = replace(intrinsics, distortion=())
    used = [(v, p[0][1]) for v in views if (p := board_poses(v.points, ideal_pixels(v.pixels, intrinsics), ideal))]
    if not used:
        _refuse(camera_id, ["the board was seen in none of its images"])
    result = _gather(intrinsics, {}, [view for view, _ in used], [pose for _, pose in used])
    _refuse(camera_id, _inexact(result, config))
    return result


def ideal_pixels(pixels: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """(N, 2) -> where a camera without distortion, otherwise the same, would see them. FrameError: one has no ray."""
    K, slopes = camera_matrix(intrinsics), undistort(pixels, intrinsics)
    if (lost := ~np.isfinite(slopes[:, 0])).any():
        u, v = pixels[lost][0]
        raise FrameError(
            f"the lens distortion {list(intrinsics.distortion)} gives pixel {u:.0f}, {v:.0f} to no ray; calibrate "
            "again, with a board in all corners of the image"
        )
    return slopes * K.diagonal()[:2] + K[:2, 2]


def _calibrate(views: Sequence[BoardView], size: tuple[int, int], config: CalibrationConfig) -> CameraCalibration:
    points = [v.points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32)[:, None] for v in views]
    start: Float64 = np.eye(3)
    try:
        _, K, lens, turns, shifts, sigmas, _, _ = cv2.calibrateCameraExtended(
            points, pixels, size, start, np.zeros(5), flags=_FLAGS[config.coefficients]
        )
        distortion = tuple(float(v) for v in np.ravel(lens)[: config.coefficients])
        fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        if not (0 < cx < size[0] and 0 < cy < size[1]):
            raise FrameError(f"its centre is {cx:.0f}, {cy:.0f}")
        intrinsics = CameraIntrinsics(fx, fy, cx, cy, *size, distortion)
    except (cv2.error, FrameError) as error:
        raise CameraError(
            f"the views lead to no possible camera: {error}; are board and its sizes the right ones, and is it flat?"
        ) from error
    names = ("fx", "fy", "cx", "cy", *COEFFICIENT_NAMES[: config.coefficients])
    sigma_by_name = {name: float(sigma) for name, sigma in zip(names, np.ravel(sigmas), strict=False)}
    poses = [make_pose(np.ravel(turn), np.ravel(shift)) for turn, shift in zip(turns, shifts, strict=True)]
    return _gather(intrinsics, sigma_by_name, views, poses)


def _gather(
    intrinsics: CameraIntrinsics, sigmas: dict[str, float], views: Sequence[BoardView], poses: Sequence[Float64]
) -> CameraCalibration:
    """Of views with T_camera_board (4, 4) of each; without ``sigmas`` the intrinsics are given ones."""
    K, lens = camera_matrix(intrinsics), np.array(intrinsics.distortion or (0.0,) * 4, np.float64)
    seen = [
        cv2.projectPoints(v.points, rotation_vector(T), T[:3, 3], K, lens)[0] for v, T in zip(views, poses, strict=True)
    ]
    residuals = tuple(v.pixels - np.reshape(pixels, (-1, 2)) for v, pixels in zip(views, seen, strict=True))
    return CameraCalibration(
        intrinsics,
        sigmas,
        _rms(np.concatenate(residuals)),
        tuple(views),
        tuple(_rms(r) for r in residuals),
        np.degrees([tilt_radians(pose) for pose in poses]),
        area_counts(views, (intrinsics.width, intrinsics.height)),
    )


def _rms(residuals: Float64) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _inexact(found: CameraCalibration, config: CalibrationConfig) -> list[str]:
    """Why a result is too inexact to be used, and what to do."""
    lacks: list[str] = []
    if found.rms_px > config.max_error_px:
        lacks.append(
            f"corners are off by {found.rms_px:.2f} px (RMS; {config.max_error_px:g} are allowed): check the sizes of "
            "the board, glue it to something flat, hold it still, and use sharp images"
        )
    fraction = max(found.sigmas.get(name, 0.0) / getattr(found.intrinsics, name) for name in ("fx", "fy"))
    if fraction > MAX_FOCAL_SIGMA:
        lacks.append(
            f"the focal length is known to {100 * fraction:.2f} % only (one sigma; {100 * MAX_FOCAL_SIGMA:g} % is "
            "needed): show the board nearer, and lean it further, in more images"
        )
    return lacks


def _refuse(camera_id: str, lacks: Sequence[str]) -> None:
    if lacks:
        raise CameraError(f"camera '{camera_id}' cannot be calibrated from these images: {'; '.join(lacks)}")
