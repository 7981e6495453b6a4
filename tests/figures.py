"""Figures before they become pictures, for tests of what is drawn where."""

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from semantic_mapper import plots


def figure_of(draw: Callable[..., Any], *args: Any, **kwargs: Any) -> Figure:
    """What a function decorated with ``rendered`` makes, drawn."""
    with plots._common_style():
        figure = draw.__wrapped__(*args, **kwargs)  # type: ignore[attr-defined]
        FigureCanvasAgg(figure).draw()
    return figure


def misplaced_texts(figure: Figure) -> list[str]:
    """Texts that overlap others, or that leave the figure."""
    beyond: set[Text] = set()  # labels of ticks out of view, which are not drawn
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        beyond |= {tick.label1 for tick in axis.get_major_ticks() if not low <= tick.get_loc() <= high}
    texts = [text for text in figure.findobj(Text) if text not in beyond]
    shown = [text for text in texts if text.get_visible() and text.get_text().strip()]
    boxes = [(text.get_text(), text.get_window_extent().padded(-1.0)) for text in shown]
    bounds = figure.bbox.padded(1.0)
    found = [f"{name!r} leaves the figure" for name, box in boxes if not np.allclose(_inside(box, bounds), box.extents)]
    return found + [f"{a!r} and {b!r}" for (a, one), (b, other) in combinations(boxes, 2) if one.overlaps(other)]


def _inside(box: Any, bounds: Any) -> np.ndarray:
    return np.concatenate((np.maximum(box.extents[:2], bounds.min), np.minimum(box.extents[2:], bounds.max)))
