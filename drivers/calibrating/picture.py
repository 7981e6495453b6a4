"""A picture of a calibration: where corners were seen, how far off they are, and how the board leaned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.coverage import CELLS
from semantic_mapper.drivers.calibrating.intrinsics import CameraCalibration
from semantic_mapper.plots import BAD, DIM_TEXT, GOOD, PANEL, SMALL_PT, TITLE_PT, WARN, cut, new_figure, rendered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LONGEST = 0.03  # of the image's width, for the 95th percentile of the residuals
_MAX_TILT_DEG = 60
_GOOD, _BAD, _WARN, _DIM, _PANEL = (tuple(v / 255 for v in c) for c in (GOOD, BAD, WARN, DIM_TEXT, PANEL))


@rendered
def draw_calibration(camera_id: str, found: CameraCalibration, config: CalibrationConfig) -> Figure:
    """Residuals of all corners, the error of each view, and the tilts of the board."""
    figure = new_figure(1400, 760, layout="constrained")
    title = f"{cut(camera_id, 700, TITLE_PT)}: {len(found.views)} views, {found.rms_px:.3f} px RMS"
    figure.suptitle(title, x=0.012, ha="left")
    grid = figure.add_gridspec(2, 2, width_ratios=(2.3, 1))
    _draw_residuals(figure.add_subplot(grid[:, 0]), found)
    _draw_errors(figure.add_subplot(grid[0, 1]), found)
    _draw_tilts(figure.add_subplot(grid[1, 1]), found, config)
    return figure


def _draw_residuals(axes: Axes, found: CameraCalibration) -> None:
    """The image with its cells, the corners, and their residuals enlarged."""
    i = found.intrinsics
    values = {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy}
    sigmas = {name: f" ± {found.sigmas[name]:.2f}" if name in found.sigmas else "" for name in values}
    axes.set_title(",  ".join(f"{name} {value:.2f}{sigmas[name]}" for name, value in values.items()))
    right, bottom = i.width - 0.5, i.height - 0.5
    edges = np.linspace(-0.5, right, CELLS + 1), np.linspace(-0.5, bottom, CELLS + 1)
    seen = np.where(found.counts > 0, 0.12, 0.0)
    axes.imshow(np.dstack([np.ones((CELLS, CELLS, 3)), seen]), extent=(-0.5, right, bottom, -0.5), aspect="equal")
    label = {"color": _DIM, "zorder": 5, "bbox": {"facecolor": _PANEL, "linewidth": 0, "pad": 1}}
    for (row, column), count in np.ndenumerate(found.counts):
        place = edges[0][column], edges[1][row]
        axes.annotate(str(count), place, (4, -4), textcoords="offset points", va="top", fontsize=SMALL_PT, **label)
    pixels = np.concatenate([view.pixels for view in found.views])
    residuals = np.concatenate(found.residuals)
    lengths = np.linalg.norm(residuals, axis=1)
    longest = max(float(np.percentile(lengths, 95)), 1e-6)
    enlarged = _LONGEST * i.width / longest
    colors = np.where((lengths <= longest)[:, None], _GOOD, _BAD)
    style = {"angles": "xy", "scale_units": "xy", "width": 0.0015, "headwidth": 1, "headlength": 0, "headaxislength": 0}
    axes.quiver(*pixels.T, *residuals.T, color=colors, scale=1 / enlarged, **style)
    axes.plot(*pixels.T, ".", color="white", markersize=2.5)
    axes.set(xticks=edges[0], yticks=edges[1], xlim=(-0.5, right), ylim=(bottom, -0.5))
    axes.tick_params(length=0, labelbottom=False, labelleft=False)
    axes.set_axisbelow(False)
    axes.grid(color=_PANEL, linewidth=1.5)
    note = f"lines: seen minus predicted, {enlarged:.0f} times enlarged, orange: the longest 5 %\n"
    axes.set_xlabel(f"{note}numbers: corners in a cell; dark cells: none", loc="left")


def _draw_errors(axes: Axes, found: CameraCalibration) -> None:
    from matplotlib.ticker import MaxNLocator

    left_out = f", {len(found.left_out)} left out" if found.left_out else ""
    axes.set(title=f"error of each view{left_out}", xlabel="view", ylabel="px RMS")
    axes.bar(range(1, len(found.errors_px) + 1), found.errors_px, color=_GOOD)
    axes.axhline(found.rms_px, color=_WARN, label=f"all corners: {found.rms_px:.2f}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(0, max(1.25 * max(found.errors_px), 1e-6))
    axes.legend(loc="upper right")


def _draw_tilts(axes: Axes, found: CameraCalibration, config: CalibrationConfig) -> None:
    """How the board leaned in each view, and how far it has to have leaned at least once."""
    up, side = np.clip(found.tilts, -_MAX_TILT_DEG, _MAX_TILT_DEG).T
    least, ticks = config.min_tilt_deg, range(-_MAX_TILT_DEG, _MAX_TILT_DEG + 1, 20)
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * least
    axes.plot(*square.T, "-", color=_WARN, linewidth=1, label=f"needed: beyond {least:g}° each way")
    axes.plot(side, up, "o", color=_GOOD)
    axes.set(title="how the board leaned", xlabel="to a side, degrees", ylabel="up or down, degrees")
    axes.set(xlim=(-65, 65), ylim=(65, -65), xticks=ticks, yticks=ticks, aspect="equal")
    axes.legend(loc="upper center", handlelength=1)
