"""Pictures with captions and legends in one style, drawn by Matplotlib's Agg, which is imported when something is.

Positions and sizes are pixels from the upper left corner; text is plain text, with control characters as escapes.
"""

from __future__ import annotations

import functools
import logging
import threading
import warnings
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import cv2
import numpy as np

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.plain_text import visible
from semantic_mapper.types import UInt8

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
CHANGE_COLORS = {"moved": (255, 210, 31), "new": (63, 224, 127), "gone": (255, 90, 79)}  # of things
CYCLE = ("#56b4e9", "#e69f00", "#2fbf94", "#e28fc0", "#f0e442", "#e8743b", "#c9cdd3")  # after Okabe and Ito, lighter
TITLE_PT, TEXT_PT, SMALL_PT = 14, 11, 9.5
_DPI = 100
_PIXELS_PER_POINT = _DPI / 72
_LONGEST = 500  # letters of a line
_LOCK = threading.RLock()  # Matplotlib's settings belong to the process


def hex_color(color: Color) -> str:
    """As Matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)


_STYLE: dict[Any, Any] = {
    "figure.dpi": _DPI,
    "figure.facecolor": hex_color(BACKGROUND),
    "figure.titlesize": TITLE_PT,
    "figure.titleweight": "bold",
    "figure.constrained_layout.h_pad": 0.1,
    "figure.constrained_layout.w_pad": 0.1,
    "font.size": TEXT_PT,
    "text.color": hex_color(TEXT),
    "text.parse_math": False,
    "axes.facecolor": hex_color(PANEL),
    "axes.edgecolor": hex_color(GRID),
    "axes.labelcolor": hex_color(TEXT),
    "axes.titlelocation": "left",
    "axes.titlesize": TEXT_PT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": f"cycler(linestyle=['-', '--']) * cycler(color={list(CYCLE)})",
    "grid.color": hex_color(GRID),
    "grid.linewidth": 0.7,
    "xtick.color": hex_color(DIM_TEXT),
    "ytick.color": hex_color(DIM_TEXT),
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
    "lines.linewidth": 2,
    "lines.markersize": 5,
    "legend.fontsize": SMALL_PT,
    "legend.facecolor": hex_color(PANEL),
    "legend.edgecolor": hex_color(GRID),
    "legend.framealpha": 0.8,
}


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


def new_figure(width: int, height: int, **options: Any) -> Figure:
    """A figure of this many pixels."""
    from matplotlib.figure import Figure

    return Figure(((width + 0.01) / _DPI, (height + 0.01) / _DPI), _DPI, **options)


def encode_picture(picture: UInt8, *, jpeg: bool = False) -> bytes:
    """An RGB picture (H, W, 3) as PNG or JPEG."""
    crisp = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)  # thin lines keep their colour
    kind, options = (
        (".jpg", (cv2.IMWRITE_JPEG_QUALITY, 90, *crisp)) if jpeg else (".png", (cv2.IMWRITE_PNG_COMPRESSION, 6))
    )
    encoded, data = cv2.imencode(kind, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    if not encoded:
        raise SemanticMapperError(f"the picture could not be encoded as {kind}")
    return data.tobytes()


def write_picture(path: Path, picture: UInt8) -> None:
    """Write an RGB picture (H, W, 3), as JPEG if its name says so, else as PNG; whole or not at all. The folder is made
    if missing. Raises SemanticMapperError: it cannot be encoded or written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, encode_picture(picture, jpeg=path.suffix.lower() in (".jpg", ".jpeg")))
    except OSError as error:
        raise SemanticMapperError(f"{path}: cannot be written: {error.strerror or error}") from error


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
    options["color"] = hex_color(options.get("color", TEXT))
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
    """Classes that occur in ``labels``, (N,) ids of the map's points that fractions are of, or in ``shown`` images: the
    most frequent first and the unknown last."""
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
        axes.add_patch(Rectangle((x, y - 0.36 * pitch), 18, 0.72 * pitch, color=hex_color(color), linewidth=0))
        put_text(axes, (x + 27, y), cut(name, width - (34 if fraction is None else 90), size_pt), fontsize=size_pt)
        if fraction is not None:
            share = f"{100 * fraction:.1f} %" if fraction else "–"  # noqa: RUF001
            put_text(axes, (x + width, y), share, color=DIM_TEXT, ha="right", fontsize=size_pt)
