"""Curves and paths, in the style of the package's pictures."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper.plots import DIM_TEXT, SMALL_PT, TITLE_PT, cut, hex_color, new_figure, rendered
from semantic_mapper.types import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def cannot_draw() -> str:
    """Why nothing can be drawn here; empty where it can."""
    return "" if importlib.util.find_spec("matplotlib") else "Matplotlib is not installed"


@dataclass(frozen=True, slots=True)
class Curve:
    """One line: name and points (x, y), x ascending; ``marked`` shows where each of them is."""

    name: str
    points: Sequence[tuple[float, float]]
    marked: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves that share axes; the labels of the axes hold their units."""

    title: str
    y_label: str
    x_label: str
    curves: Sequence[Curve]


@rendered
def draw_panels(title: str, panels: Sequence[Panel], columns: int = 3, size: tuple[int, int] = (500, 360)) -> Figure:
    """Panels of one size (width, height) next to and below each other.

    Panels whose curves have the same names share one legend.
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(columns * size[0], rows * size[1] + 50 * bool(title), layout="constrained")
    if title:
        figure.suptitle(cut(title, columns * size[0] - 30, TITLE_PT, "bold"), x=0.012, ha="left")
    names = {tuple(curve.name for curve in panel.curves) for panel in panels if panel.curves}
    shared = len(names) == 1 and len(panels) > 1
    for number, panel in enumerate(panels, 1):
        axes = figure.add_subplot(rows, columns, number)
        _draw_curves(axes, panel)
        if not shared and any(curve.name for curve in panel.curves):
            axes.legend(loc="best")
        elif shared and not figure.legends and panel.curves and any(*names):
            figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", ncols=5, frameon=False)
    return figure


def _draw_curves(axes: Axes, panel: Panel) -> None:
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
    if not panel.curves:
        axes.text(
            0.5, 0.5, "nothing yet", color=hex_color(DIM_TEXT), ha="center", va="center", transform=axes.transAxes
        )
        axes.set(xticks=(), yticks=())
        return
    for curve in panel.curves:
        x, y = np.array(curve.points, np.float64).T
        single = len(x) == 1
        axes.plot(x, y, marker="o" if curve.marked or single else "", label=_label(curve.name, 260))
    x, y = np.array([point for curve in panel.curves for point in curve.points], np.float64).T
    axes.set_xlim(min(0.0, float(x.min())), max(float(x.max()), 1e-9) * 1.02)
    low, high = min(0.0, float(np.nanmin(y))), float(np.nanmax(y))
    axes.set_ylim(low, high + 0.08 * ((high - low) or 1.0))
    axes.xaxis.set_major_formatter(_short_number)
    axes.yaxis.set_major_formatter(_short_number)


def _label(name: str, width: float) -> str:
    """A name for a legend, which leaves out names that begin with "_"."""
    name = cut(name, width, SMALL_PT)
    return f" {name}" if name.startswith("_") else name


def _short_number(value: float, _: object = None) -> str:
    return f"{value / 1000:g}k" if abs(value) >= 10_000 else f"{value:.6g}"


@rendered
def draw_paths(title: str, paths: Mapping[str, Float64], up: Float64) -> Figure:
    """Paths from above, at one scale both ways; a dot marks where each begins.

    Args:
        title: Above the picture.
        paths: Positions (N, 3) in metres by name, all in one world; rows of NaN are interruptions.
        up: (3,) in that world.
    """
    figure = new_figure(900, 760, layout="constrained")
    figure.suptitle(cut(title, 870, TITLE_PT, "bold"), x=0.012, ha="left")
    axes = figure.add_subplot(aspect="equal", adjustable="datalim", xlabel="metres", ylabel="metres")
    ground = _ground_axes(np.concatenate(list(paths.values())), up)
    for name, xyz in paths.items():
        x, y = ground @ xyz.T
        (line,) = axes.plot(x, y, label=_label(name, 260))
        known = np.flatnonzero(np.isfinite(x))[:1]
        axes.plot(x[known], y[known], "o", color=line.get_color(), markersize=9)
    if any(paths):
        axes.legend(loc="best")
    return figure


def _ground_axes(xyz: Float64, up: Float64) -> Float64:
    """Two axes (2, 3) square to ``up``: the longest way of the points to the right, the other one up the picture."""
    up = up / np.linalg.norm(up)
    known = xyz[np.isfinite(xyz).all(axis=1)]
    level = known - known.mean(axis=0)
    right = np.linalg.svd(level - np.outer(level @ up, up), full_matrices=False)[2][0]
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return np.stack((right, np.cross(up, right))).astype(np.float64)
