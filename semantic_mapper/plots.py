"""Plots and grids of pictures in one style, drawn by Matplotlib.

Matplotlib is imported when something is drawn: the command line starts without it, and a machine that only trains may
lack it (``cannot_draw`` says so). Figures are drawn by Agg, without a display, and never through ``pyplot``. Positions
and sizes are pixels from the upper left corner, text is plain text: no mathematics, control characters as escapes.
"""

from __future__ import annotations

import functools
import importlib.util
import logging
import threading
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import cv2
import numpy as np

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.plain_text import visible
from semantic_mapper.types import Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")
Color = tuple[int, int, int]
Box = tuple[float, float, float, float]  # left, top, width, height; pixels
LegendRow = tuple[str, Color, float | None]  # class, colour, fraction of the map (None: not said)

BACKGROUND, PANEL, GRID = (22, 25, 31), (31, 35, 43), (62, 68, 79)
TEXT, DIM_TEXT = (234, 237, 242), (172, 180, 192)
UNKNOWN = (112, 116, 122)
GOOD, WARN, BAD = (86, 180, 233), (240, 228, 66), (230, 110, 40)  # distinguished without red and green
CYCLE = ("#56b4e9", "#e69f00", "#2fbf94", "#e28fc0", "#f0e442", "#e8743b", "#c9cdd3")  # after Okabe and Ito, lighter
TITLE_PT, TEXT_PT, SMALL_PT = 14, 11, 9.5
_DPI = 100
_PIXELS_PER_POINT = _DPI / 72
_LONGEST = 500  # letters of a line
_LOCK = threading.RLock()  # Matplotlib's settings belong to the process


def _hex(color: Color) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


_STYLE: dict[Any, Any] = {
    "figure.dpi": _DPI,
    "figure.facecolor": _hex(BACKGROUND),
    "figure.titlesize": TITLE_PT,
    "figure.titleweight": "bold",
    "figure.constrained_layout.h_pad": 0.1,
    "figure.constrained_layout.w_pad": 0.1,
    "font.size": TEXT_PT,
    "text.color": _hex(TEXT),
    "text.parse_math": False,
    "axes.facecolor": _hex(PANEL),
    "axes.edgecolor": _hex(GRID),
    "axes.labelcolor": _hex(TEXT),
    "axes.titlelocation": "left",
    "axes.titlesize": TEXT_PT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": f"cycler(linestyle=['-', '--']) * cycler(color={list(CYCLE)})",
    "grid.color": _hex(GRID),
    "grid.linewidth": 0.7,
    "xtick.color": _hex(DIM_TEXT),
    "ytick.color": _hex(DIM_TEXT),
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
    "lines.linewidth": 2,
    "lines.markersize": 5,
    "legend.fontsize": SMALL_PT,
    "legend.facecolor": _hex(PANEL),
    "legend.edgecolor": _hex(GRID),
    "legend.framealpha": 0.8,
}


def cannot_draw() -> str:
    """Why nothing can be drawn here; empty where it can."""
    return "" if importlib.util.find_spec("matplotlib") else "Matplotlib is not installed"


@contextmanager
def _common_style() -> Iterator[None]:
    """Matplotlib's settings while something is drawn; what it says of fonts and of its cache is kept back."""
    logger = logging.getLogger("matplotlib")
    with _LOCK, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)  # a name in letters that the font lacks
        level = logger.level
        logger.setLevel(logging.ERROR)
        try:
            import matplotlib

            with matplotlib.rc_context(_STYLE):
                yield
        finally:
            logger.setLevel(level)


def rendered(draw: Callable[P, Figure]) -> Callable[P, UInt8]:
    """Make a function that returns a figure one that returns its picture, (H, W, 3) uint8 RGB, in the common style."""

    @functools.wraps(draw)
    def picture(*args: P.args, **kwargs: P.kwargs) -> UInt8:
        with _common_style():
            from matplotlib.backends.backend_agg import FigureCanvasAgg

            canvas = FigureCanvasAgg(draw(*args, **kwargs))
            canvas.draw()
            return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()

    return picture


def new_figure(width: int, height: int, scale: float = 1.0, **options: Any) -> Figure:
    """A figure of this many pixels, times ``scale``, which keeps the proportions of text to lines."""
    from matplotlib.figure import Figure

    return Figure(((width + 0.01) / _DPI, (height + 0.01) / _DPI), _DPI * scale, **options)


def png_bytes(picture: UInt8) -> bytes:
    """An RGB picture (H, W, 3) as PNG.

    Raises:
        SemanticMapperError: OpenCV cannot encode it.
    """
    small = (cv2.IMWRITE_PNG_COMPRESSION, 6)  # half the size that it has by default
    encoded, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), small)
    if not encoded:
        raise SemanticMapperError("the picture could not be encoded as PNG")
    return data.tobytes()


def jpeg_bytes(picture: UInt8) -> bytes:
    """An RGB picture (H, W, 3) as JPEG.

    Raises:
        SemanticMapperError: OpenCV cannot encode it.
    """
    crisp = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)  # thin lines keep their colour
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), crisp)
    if not encoded:
        raise SemanticMapperError("the picture could not be encoded as JPEG")
    return data.tobytes()


def write_picture(path: Path, picture: UInt8) -> None:
    """Write an RGB picture (H, W, 3), as JPEG if its name says so, else as PNG; whole or not at all.

    The folder is made if missing.

    Raises:
        SemanticMapperError: it cannot be encoded or written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        is_jpeg = path.suffix.lower() in (".jpg", ".jpeg")
        write_bytes(path, jpeg_bytes(picture) if is_jpeg else png_bytes(picture))
    except OSError as error:
        raise SemanticMapperError(f"{path}: cannot be written: {error.strerror or error}") from error


# Curves and bars


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


@dataclass(frozen=True, slots=True)
class Bar:
    """A whole and its parts, from the left to the right; none below 0."""

    name: str
    parts: Mapping[str, float]


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
        axes.text(0.5, 0.5, "nothing yet", color=_hex(DIM_TEXT), ha="center", va="center", transform=axes.transAxes)
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
def draw_bars(title: str, bars: Sequence[Bar], x_label: str) -> Figure:
    """Bars below each other; equal names of parts have one colour, and wide ones their value in them."""
    height = 34 * len(bars)
    names = list(dict.fromkeys(name for bar in bars for name in bar.parts))
    legend_rows = -(-len(names) // 6) if len(names) > 1 else 0
    figure = new_figure(1000, height + 24 * legend_rows + (130 if title else 84), 1.5, layout="constrained")
    if title:
        figure.suptitle(cut(title, 970, TITLE_PT, "bold"), x=0.012, ha="left")
    axes = figure.add_subplot()
    totals = np.zeros(len(bars))
    longest = max(sum(bar.parts.values()) for bar in bars) or 1.0
    stacked = any(len(bar.parts) > 1 for bar in bars)
    for name in names:
        values = np.array([bar.parts.get(name, 0.0) for bar in bars])
        drawn = axes.barh(range(len(bars)), values, 0.66, totals, label=_label(name, 140))
        texts = [_value(v) if stacked and v / longest * 780 > 9 * len(_value(v)) else "" for v in values]
        axes.bar_label(drawn, texts, label_type="center", color=_hex(BACKGROUND), fontsize=SMALL_PT)
        totals += values
    if len(names) > 1:
        figure.legend(loc="outside upper left" if not title else "outside lower left", ncols=6, frameon=False)
    for row, total in enumerate(totals):
        axes.text(total, row, f" {_value(total)}", va="center", fontsize=SMALL_PT)
    axes.set_yticks(range(len(bars)), [cut(bar.name, 260, TEXT_PT) for bar in bars], fontsize=TEXT_PT, color=_hex(TEXT))
    axes.set(xlabel=x_label, xlim=(0, longest * 1.07), ylim=(len(bars) - 0.4, -0.6))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    return figure


def _value(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _figure(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 10_000 else f"{value:.0f}"


@dataclass(frozen=True, slots=True)
class Histogram:
    """How often which values occur.

    Args:
        title: Above it.
        x_label: Of the axis, with the unit.
        values: (N,), N > 0.
    """

    title: str
    x_label: str
    values: Float64


@rendered
def draw_histograms(histograms: Sequence[Histogram], columns: int = 3, size: tuple[int, int] = (400, 280)) -> Figure:
    """Histograms next to and below each other, each with its median as a line."""
    from matplotlib.ticker import MaxNLocator

    columns = min(columns, len(histograms))
    rows = -(-len(histograms) // columns)
    figure = new_figure(columns * size[0], rows * size[1], 1.25, layout="constrained")
    for number, histogram in enumerate(histograms, 1):
        axes = figure.add_subplot(rows, columns, number)
        values = histogram.values[np.isfinite(histogram.values)]
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if high - low < 1e-9 * max(abs(high), 1e-300):  # all the same: one bar
            low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
        bins = min(max(round(2 * np.sqrt(len(values))), 5), 40)
        axes.hist(values, bins=bins, range=(low, high), color=_hex(GOOD))
        if len(values):
            middle = float(np.median(values))
            axes.axvline(middle, color=_hex(WARN), linewidth=1.5)
            axes.set_title(f"median {_figure(middle)}", loc="right", color=_hex(WARN), fontsize=SMALL_PT)
        axes.set(xlabel=histogram.x_label, ylabel="logs")
        axes.set_title(cut(histogram.title, size[0] - 170, TEXT_PT), loc="left")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


@dataclass(frozen=True, slots=True)
class PercentileBox:
    """Five percentiles of some values: 5, 25, 50, 75 and 95; ``count`` says how many values there were."""

    name: str
    percentiles: tuple[float, float, float, float, float]
    count: int


@rendered
def draw_boxes(title: str, boxes: Sequence[PercentileBox], x_label: str) -> Figure:
    """Boxes below each other: quartiles and median, whiskers from the 5th to the 95th percentile."""
    figure = new_figure(1000, 30 * len(boxes) + (130 if title else 84), 1.25, layout="constrained")
    if title:
        figure.suptitle(cut(title, 970, TITLE_PT, "bold"), x=0.012, ha="left")
    axes = figure.add_subplot()
    places = np.arange(len(boxes))
    low, first, middle, third, high = np.array([box.percentiles for box in boxes], np.float64).T
    axes.hlines(places, low, high, color=_hex(DIM_TEXT), linewidth=1.5, zorder=1.5)
    axes.barh(places, third - first, 0.6, first, color=_hex(GOOD), zorder=2)
    reach = max(float(high.max() - low.min()), 1e-9)
    # A median is dark on its box; without a box wide enough to see, it is as light as the box would be.
    medians = [_hex(GOOD) if width < 0.01 * reach else _hex(BACKGROUND) for width in third - first]
    axes.vlines(middle, places - 0.3, places + 0.3, color=medians, linewidth=2.5, zorder=3)
    for place, box in enumerate(boxes):
        text = f"{_figure(box.percentiles[2])}  n = {box.count}"
        right_of_axes = axes.get_yaxis_transform()  # to the right of the axes, where no grid line crosses it
        axes.text(1.01, place, text, va="center", fontsize=SMALL_PT, color=_hex(DIM_TEXT), transform=right_of_axes)
    axes.set_yticks(places, [cut(box.name, 260, TEXT_PT) for box in boxes], fontsize=TEXT_PT, color=_hex(TEXT))
    axes.set(xlabel=x_label, ylim=(len(boxes) - 0.4, -0.6))
    axes.set_xlim(float(low.min()) - 0.03 * reach, float(high.max()) + 0.03 * reach)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    return figure


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


# Pictures with captions, and class legends


def place(figure: Figure, box: Box) -> Axes:
    """Axes without marks that fill a box of the figure; their units are its pixels, y downwards."""
    width, height = figure.get_figwidth() * _DPI, figure.get_figheight() * _DPI
    x, y, w, h = box
    axes = figure.add_axes((x / width, 1 - (y + h) / height, w / width, h / height))
    axes.set_axis_off()
    axes.set(xlim=(0, w), ylim=(max(h, 1), 0))
    return axes


def put_text(axes: Axes, at: tuple[float, float], text: str, **options: Any) -> None:
    """Text in axes of ``place``, its left end, at half its height, at (x, y), in the colour ``color``."""
    options["color"] = _hex(options.get("color", TEXT))
    axes.text(*at, visible(text), **{"va": "center", "fontsize": TEXT_PT, **options})


def put_picture(figure: Figure, box: Box, picture: UInt8, caption: str, *, smooth: bool = False) -> Axes:
    """A picture (h, w, 3) scaled to a box, and a caption above it; ``smooth`` blends pixels, as suits photos alone."""
    axes = place(figure, box)
    extent = (0, box[2], box[3], 0)
    axes.imshow(picture, extent=extent, aspect="auto", interpolation="antialiased" if smooth else "nearest")
    put_text(axes, (0, -11), cut(caption, box[2], TEXT_PT), color=DIM_TEXT)
    return axes


def put_title(figure: Figure, title: str, subtitle: str = "") -> None:
    """The head of a figure whose parts have their places."""
    width = figure.get_figwidth() * _DPI - 48
    axes = place(figure, (24, 12, width, 50))
    put_text(axes, (0, 16), cut(title, width, TITLE_PT + 2, "bold"), fontsize=TITLE_PT + 2, weight="bold")
    put_text(axes, (0, 42), cut(subtitle, width, TEXT_PT), color=DIM_TEXT)


def cut(text: str, width: float, size_pt: float, weight: str = "normal") -> str:
    """``text`` with control characters as escapes, ended by an ellipsis where it is wider than ``width`` pixels."""
    text = visible(text[:_LONGEST])
    if text_width(text, size_pt, weight) <= width:
        return text
    letters = range(len(text))
    return text[: bisect_right(letters, width, 1, key=lambda n: text_width(f"{text[:n]}…", size_pt, weight)) - 1] + "…"


def text_width(text: str, size_pt: float, weight: str = "normal") -> float:
    """Width of a line of text, pixels."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    width, _, _ = text_to_path.get_text_width_height_descent(
        text, FontProperties(size=size_pt, weight=weight), ismath=False
    )
    return width * _PIXELS_PER_POINT


def class_colors(label: UInt8, label_set: LabelSet) -> UInt8:
    """Colours (..., 3) of class ids (...), grey for the ignore id."""
    colors = label_set.colorize(label)
    colors[label == label_set.ignore_id] = UNKNOWN
    return colors


def class_rows(labels: UInt8, label_set: LabelSet, shown: Sequence[UInt8] = ()) -> list[LegendRow]:
    """Classes that occur, the most frequent first and the unknown last.

    Args:
        labels: (N,) class ids of the map's points: fractions are of these.
        label_set: Names and colours.
        shown: Images of class ids (...) whose classes are listed, too.
    """
    counts = np.bincount(labels.ravel(), minlength=256)
    present = counts + sum(np.bincount(image.ravel(), minlength=256) for image in shown) > 0
    fractions = counts / max(counts.sum(), 1)
    named = zip(label_set.names, label_set.colors, label_set.ids, strict=True)
    rows: list[LegendRow] = [(name, color, float(fractions[i])) for name, color, i in named if present[i]]
    rows.sort(key=lambda row: -(row[2] or 0.0))
    if present[label_set.ignore_id]:
        rows.append(("unknown", UNKNOWN, float(fractions[label_set.ignore_id])))
    return rows


def put_legend(figure: Figure, box: Box, rows: Sequence[LegendRow], columns: int = 1) -> None:
    """Classes in a box, as many as it has room for."""
    from matplotlib.patches import Rectangle

    axes, width = place(figure, box), box[2] / columns
    pitch = float(np.clip(box[3] / max(-(-len(rows) // columns), 1), 15, 27))
    size_pt = min(TEXT_PT, 0.6 * pitch)
    for number, (name, color, fraction) in enumerate(rows[: int(box[3] / pitch) * columns]):
        x, y = number % columns * width, (number // columns + 0.5) * pitch
        axes.add_patch(Rectangle((x, y - 0.36 * pitch), 18, 0.72 * pitch, color=_hex(color), linewidth=0))
        put_text(axes, (x + 27, y), cut(name, width - (34 if fraction is None else 90), size_pt), fontsize=size_pt)
        if fraction is not None:
            share = f"{100 * fraction:.1f} %" if fraction else "–"  # noqa: RUF001
            put_text(axes, (x + width, y), share, color=DIM_TEXT, ha="right", fontsize=size_pt)


@rendered
def draw_picture_rows(rows: Mapping[str, Sequence[UInt8]], label_set: LabelSet, width: int = 180) -> Figure:
    """Rows of pictures (h, w, 3) of one size by caption, each ``width`` pixels wide, and all classes below them."""
    gap, caption, class_width = 6, 150, 150
    columns = max(map(len, rows.values()))
    h, w = next(iter(rows.values()))[0].shape[:2]
    height = round(width * h / w)
    classes: list[LegendRow] = [(n, color, None) for n, color in zip(label_set.names, label_set.colors, strict=True)]
    across = max(columns * width // class_width, 1)
    legend = 27 * -(-len(classes) // across) + 2 * gap
    whole = (caption + columns * (width + gap), gap + len(rows) * (height + gap) + legend)
    figure = new_figure(*whole)
    for r, (name, pictures) in enumerate(rows.items()):
        top = gap + r * (height + gap)
        put_text(place(figure, (12, top, caption - 18, height)), (0, height / 2), cut(name, caption - 18, TEXT_PT))
        for c, picture in enumerate(pictures):
            put_picture(figure, (caption + c * (width + gap), top, width, height), picture, "")
    put_legend(figure, (caption, whole[1] - legend, columns * width, legend - gap), classes, across)
    return figure
