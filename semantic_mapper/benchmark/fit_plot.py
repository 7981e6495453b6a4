"""How fast fields are fitted to rooms, as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from semantic_mapper.evaluation.canvas import MARGIN, TEXT, draw_text, new_canvas
from semantic_mapper.evaluation.plot import Curve, draw_panel
from semantic_mapper.types import UInt8

WIDTH, HEIGHT = 720, 400  # of the panel
_TITLE = 40


def draw_fit_curves(figures: Mapping[str, Mapping[str, Any]], title: str) -> UInt8 | None:
    """mIoU in percent against the seconds that fitting a room took; None where nothing was fitted.

    Args:
        figures: ``figures.view_figures`` of each contestant, by name. Labels that depth alone carries over, the same
            for all of them, are a line of their own.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    curves = [
        Curve(name, tuple((p["seconds"], 100 * p["miou"]) for p in of["curve"] if p["miou"] is not None), marked=True)
        for name, of in figures.items()
    ]
    curves = [curve for curve in curves if len(curve.points) > 1]
    if not curves:
        return None
    carried = next((of["carried_miou"] for of in figures.values() if of["carried_miou"] is not None), None)
    if carried is not None:
        last = max(curve.points[-1][0] for curve in curves)
        curves.append(Curve("labels carried by depth", ((0.0, 100 * carried), (last, 100 * carried))))
    picture = new_canvas(2 * MARGIN + WIDTH, 2 * MARGIN + _TITLE + HEIGHT)
    draw_text(picture, title, (MARGIN, MARGIN), 18, TEXT)
    panel = picture[MARGIN + _TITLE : MARGIN + _TITLE + HEIGHT, MARGIN : MARGIN + WIDTH]
    draw_panel(panel, "mIoU in %, against seconds of fitting a room", curves)
    return picture
