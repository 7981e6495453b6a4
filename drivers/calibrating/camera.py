"""Focal length, principal point and lens distortion of one camera, and a picture of how well they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from semantic_mapper.drivers.calibrating.views import (
    CELLS,
    MIN_TILT_DEG,
    BoardView,
    CalibrationConfig,
    area_counts,
    shortfalls,
    tilt_radians,
)
from semantic_mapper.drivers.poses.board import board_poses
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.geometry import camera_matrix, make_pose, rotation_vector
from semantic_mapper.plots import (
    BAD,
    DIM_TEXT,
    GOOD,
    PANEL,
    SMALL_PT,
    TITLE_PT,
    WARN,
    cut,
    hex_color,
    new_figure,
    rendered,
)
from semantic_mapper.types import CameraIntrinsics, Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OUTLIER = 3.0  # times the median error of a view: it was blurred, or the board was bent
OUTLIER_FLOOR_PX = 0.3
MAX_LEFT_OUT = 0.2  # fraction of the views
MAX_FOCAL_SIGMA = 0.005  # one sigma of the focal length, as a fraction of it
_LONGEST = 0.03  # of the image's width, for the 95th percentile of the residuals in the picture
_MAX_TILT_DEG = 60
_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera and how it came about."""

    intrinsics: CameraIntrinsics  # with distortion
    # One-sigma uncertainty by name (fx, fy, cx, cy, k1, ...); empty where the intrinsics were given, and only compared
    sigmas: dict[str, float]
    rms_px: float  # root mean square of the distances of corners, seen and predicted
    views: tuple[BoardView, ...]  # those used
    residuals: tuple[Float64, ...]  # (N, 2) a view, seen minus predicted, pixels
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
        residuals,
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


@rendered
def draw_calibration(camera_id: str, found: CameraCalibration) -> Figure:
    """Residuals of all corners, the error of each view, and the tilts of the board."""
    figure = new_figure(1400, 760, layout="constrained")
    title = f"{cut(camera_id, 700, TITLE_PT)}: {len(found.views)} views, {found.rms_px:.3f} px RMS"
    figure.suptitle(title, x=0.012, ha="left")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.3, 1))
    _draw_residuals(figure.add_subplot(grid[:, 0]), found)
    errors, tilts = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    left_out = f", {len(found.left_out)} left out" if found.left_out else ""
    errors.set(title=f"error of each view{left_out}", xlabel="view", ylabel="px RMS")
    errors.bar(range(1, len(found.errors_px) + 1), found.errors_px, color=hex_color(GOOD))
    errors.axhline(found.rms_px, color=hex_color(WARN), label=f"all corners: {found.rms_px:.2f}")
    errors.locator_params(axis="x", integer=True)
    errors.set_ylim(0, max(1.25 * max(found.errors_px), 1e-6))
    errors.legend(loc="upper right")
    up, side = np.clip(found.tilts, -_MAX_TILT_DEG, _MAX_TILT_DEG).T
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * MIN_TILT_DEG
    tilts.plot(*square.T, color=hex_color(WARN), linewidth=1, label=f"needed: beyond {MIN_TILT_DEG:g}° each way")
    tilts.plot(side, up, "o", color=hex_color(GOOD))
    ticks = range(-_MAX_TILT_DEG, _MAX_TILT_DEG + 1, 20)
    tilts.set(title="how the board leaned", xlabel="to a side, degrees", ylabel="up or down, degrees")
    tilts.set(xlim=(-65, 65), ylim=(65, -65), xticks=ticks, yticks=ticks, aspect="equal")
    tilts.legend(loc="upper center", handlelength=1)
    return figure


def _draw_residuals(axes: Axes, found: CameraCalibration) -> None:
    """The image with its cells, the corners, and their residuals enlarged."""
    i, dim, panel = found.intrinsics, hex_color(DIM_TEXT), hex_color(PANEL)
    values = {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy}
    sigmas = {name: f" ± {found.sigmas[name]:.2f}" if name in found.sigmas else "" for name in values}
    axes.set_title(",  ".join(f"{name} {value:.2f}{sigmas[name]}" for name, value in values.items()))
    x, y = (np.linspace(-0.5, side - 0.5, CELLS + 1) for side in (i.width, i.height))
    axes.pcolormesh(x, y, found.counts > 0, cmap="gray", vmin=-1, vmax=6, edgecolors=panel, linewidth=1.5)
    for (row, column), count in np.ndenumerate(found.counts):
        style = {
            "fontsize": SMALL_PT,
            "color": dim,
            "bbox": {"facecolor": panel, "linewidth": 0, "pad": 1},
            "zorder": 5,
        }
        axes.annotate(f"{count:.0f}", (x[column], y[row]), (4, -4), textcoords="offset points", va="top", **style)
    pixels = np.concatenate([view.pixels for view in found.views])
    residuals = np.concatenate(found.residuals)
    lengths = np.linalg.norm(residuals, axis=1)
    longest = max(float(np.percentile(lengths, 95)), 1e-6)
    enlarged = _LONGEST * i.width / longest
    colors = np.where(lengths <= longest, hex_color(GOOD), hex_color(BAD))
    style = {"angles": "xy", "scale_units": "xy", "width": 0.0015, "headwidth": 1, "headlength": 0, "headaxislength": 0}
    axes.quiver(*pixels.T, *residuals.T, color=colors, scale=1 / enlarged, **style)
    axes.plot(*pixels.T, ".", color="white", markersize=2.5)
    axes.set(xticks=(), yticks=(), xlim=x[[0, -1]], ylim=y[[-1, 0]], aspect="equal")
    note = f"lines: seen minus predicted, {enlarged:.0f} times enlarged, orange: the longest 5 %\n"
    axes.set_xlabel(f"{note}numbers: corners in a cell; dark cells: none", loc="left")
