"""The figures of a long walk, minute by minute, as one picture."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2

from semantic_mapper.evaluation.canvas import GAP, MARGIN, TEXT, draw_text, new_canvas
from semantic_mapper.evaluation.plot import Curve, draw_panel

PANEL_WIDTH, PANEL_HEIGHT = 460, 320
_TITLE = 40
_PANELS = (
    ("milliseconds a step", {"minute_step_p95_ms": "p95", "minute_step_p50_ms": "p50", "minute_fuse_p50_ms": "fusion"}),
    ("resident memory, MB", {"minute_rss_mb": ""}),
    ("blocks", {"minute_blocks_on_disk": "on disk", "minute_blocks_in_memory": "in memory"}),
)


def write_walk_plot(found: Mapping[str, Any], path: Path) -> None:
    """Draw what ``bench_walk`` found against the minute of the walk into a PNG, whole or not at all."""
    picture = new_canvas(2 * MARGIN + 3 * PANEL_WIDTH + 2 * GAP, 2 * MARGIN + _TITLE + PANEL_HEIGHT)
    title = f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz, {found['size']}"
    draw_text(picture, title, (MARGIN, MARGIN), 18, TEXT)
    top = MARGIN + _TITLE
    for number, (name, lines) in enumerate(_PANELS):
        x = MARGIN + number * (PANEL_WIDTH + GAP)
        curves = [
            Curve(line, tuple((float(m), float(v)) for m, v in enumerate(found[key]))) for key, line in lines.items()
        ]
        draw_panel(picture[top : top + PANEL_HEIGHT, x : x + PANEL_WIDTH], f"{name}, by minute of the walk", curves)
    part = path.with_name("part." + path.name)
    cv2.imwrite(os.fspath(part), picture[..., ::-1])
    os.replace(part, path)
