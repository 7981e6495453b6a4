"""A picture of a calibration: where corners were seen, how far off they are, and how the board leaned."""

from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.coverage import CELLS
from semantic_mapper.drivers.calibrating.intrinsics import CameraCalibration
from semantic_mapper.evaluation.canvas import (
    DIM_TEXT,
    GAP,
    MARGIN,
    PANEL,
    TEXT,
    draw_text,
    new_canvas,
    text_width,
)
from semantic_mapper.types import Float64, UInt8

_IMAGE_WIDTH, _SIDE_WIDTH = 900, 420
_HEAD, _FOOT = 70, 40
_SUBPIXEL = 4  # bits
_LONGEST = 26  # pixels of the picture for the 95th percentile of the residuals
_GOOD, _BAD, _WARN = (130, 214, 130), (236, 112, 112), (255, 164, 92)
_GRID, _SEEN = (56, 61, 71), (36, 52, 58)
_MOST_TILT_DEG = 60.0


def draw_calibration(camera_id: str, found: CameraCalibration, config: CalibrationConfig) -> UInt8:
    """(H, W, 3) RGB."""
    intrinsics = found.intrinsics
    scale = _IMAGE_WIDTH / intrinsics.width
    height = max(560, round(intrinsics.height * scale))
    picture = new_canvas(2 * MARGIN + _IMAGE_WIDTH + GAP + _SIDE_WIDTH, _HEAD + height + _FOOT)
    title = f"{camera_id}: {len(found.views)} views, {found.rms_px:.3f} px RMS"
    draw_text(picture, title, (MARGIN, 14), 20, TEXT)
    names = [f"{n} {v:.2f}" for n, v in zip(("fx", "fy", "cx", "cy"), _pinhole(found), strict=True)]
    told = [f"{text} +- {found.sigmas[text[:2]]:.2f}" if found.sigmas else text for text in names]
    draw_text(picture, ",  ".join(told), (MARGIN, 44), 13, DIM_TEXT)
    _draw_residuals(picture[_HEAD : _HEAD + height, MARGIN : MARGIN + _IMAGE_WIDTH], found, scale)
    longest = _longest(found)
    note = f"lines: seen minus predicted, {_LONGEST / longest / scale:.0f} times enlarged; dark cells: no corner"
    draw_text(picture, note, (MARGIN, _HEAD + height + 12), 13, DIM_TEXT)
    x = MARGIN + _IMAGE_WIDTH + GAP
    half = (height - GAP) // 2
    _draw_errors(picture[_HEAD : _HEAD + half, x : x + _SIDE_WIDTH], found, config)
    _draw_tilts(picture[_HEAD + half + GAP : _HEAD + height, x : x + _SIDE_WIDTH], found, config)
    return picture


def _pinhole(found: CameraCalibration) -> tuple[float, float, float, float]:
    i = found.intrinsics
    return i.fx, i.fy, i.cx, i.cy


def _longest(found: CameraCalibration) -> float:
    lengths = np.linalg.norm(np.concatenate(found.residuals), axis=1)
    return max(float(np.percentile(lengths, 95)), 1e-6)


def _draw_residuals(panel: UInt8, found: CameraCalibration, scale: float) -> None:
    """The image with its cells, the corners, and their residuals enlarged."""
    panel[:] = PANEL
    image = panel[: round(found.intrinsics.height * scale)]
    height, width = image.shape[:2]
    for (row, column), count in np.ndenumerate(found.counts):
        top, left = row * height // CELLS, column * width // CELLS
        cell = image[top : (row + 1) * height // CELLS, left : (column + 1) * width // CELLS]
        cell[:] = _SEEN if count else PANEL
        cv2.rectangle(cell, (0, 0), (cell.shape[1] - 1, cell.shape[0] - 1), _GRID, 1)
        draw_text(cell, str(count), (6, 4), 12, DIM_TEXT)
    enlarge = _LONGEST / _longest(found)
    for view, residual in zip(found.views, found.residuals, strict=True):
        starts = (view.pixels + 0.5) * scale - 0.5
        for start, off in zip(starts, residual, strict=True):
            end = start + off * enlarge
            length = float(np.linalg.norm(off))
            color = _GOOD if length <= _longest(found) else _BAD
            cv2.line(image, _fixed(start), _fixed(end), color, 1, cv2.LINE_AA, _SUBPIXEL)
            cv2.circle(image, _fixed(start), 1 << _SUBPIXEL, TEXT, -1, cv2.LINE_AA, _SUBPIXEL)


def _draw_errors(panel: UInt8, found: CameraCalibration, config: CalibrationConfig) -> None:
    """A bar for each view."""
    panel[:] = PANEL
    draw_text(panel, "error of each view, px RMS", (12, 10), 14, TEXT)
    errors = found.errors_px
    top, bottom = 40, panel.shape[0] - 28
    most = max(max(errors), 1e-6) * 1.1
    wide = (panel.shape[1] - 70) / len(errors)
    for number, error in enumerate(errors):
        left, right = 50 + round(number * wide), 50 + round((number + 1) * wide) - 1
        up = bottom - round((bottom - top) * error / most)
        cv2.rectangle(panel, (left, up), (max(left, right - 1), bottom), _GOOD, -1)
    for value in (max(errors), found.rms_px):
        y = bottom - round((bottom - top) * value / most)
        cv2.line(panel, (46, y), (panel.shape[1] - 14, y), _WARN if value == found.rms_px else _GRID, 1)
        text = f"{value:.2f}"
        draw_text(panel, text, (42 - text_width(text, 12), y - 8), 12, DIM_TEXT)
    left_out = f", {len(found.left_out)} left out" if found.left_out else ""
    draw_text(panel, f"{len(errors)} views{left_out}; orange: of all corners", (50, bottom + 8), 12, DIM_TEXT)


def _draw_tilts(panel: UInt8, found: CameraCalibration, config: CalibrationConfig) -> None:
    """How the board leaned in each view, and how far it has to have leaned at least once."""
    panel[:] = PANEL
    draw_text(panel, "how the board leaned, degrees", (12, 10), 14, TEXT)
    middle = np.array((panel.shape[1] / 2, (panel.shape[0] + 20) / 2))
    per_degree = (min(panel.shape[1], panel.shape[0] - 60) / 2 - 6) / _MOST_TILT_DEG
    for degrees in (20, 40, 60):
        cv2.circle(
            panel, _fixed(middle), round(degrees * per_degree * (1 << _SUBPIXEL)), _GRID, 1, cv2.LINE_AA, _SUBPIXEL
        )
        draw_text(
            panel, str(degrees), (round(middle[0] + degrees * per_degree) - 18, round(middle[1]) + 3), 11, DIM_TEXT
        )
    needed = config.min_tilt_deg * per_degree
    corner = np.array((needed, needed))
    cv2.rectangle(panel, _whole(middle - corner), _whole(middle + corner), _WARN, 1)
    for up, side in np.clip(found.tilts, -_MOST_TILT_DEG, _MOST_TILT_DEG):
        at = middle + np.array((side, up)) * per_degree
        cv2.circle(panel, _fixed(at), 3 << _SUBPIXEL, _GOOD, -1, cv2.LINE_AA, _SUBPIXEL)


def _fixed(at: Float64) -> tuple[int, int]:
    x, y = (at * (1 << _SUBPIXEL)).tolist()
    return round(x), round(y)


def _whole(at: Float64) -> tuple[int, int]:
    x, y = at.tolist()
    return round(x), round(y)
