"""The classes of a map with their colours, names and shares of it."""

from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.evaluation.canvas import DIM_TEXT, TEXT, UNKNOWN, draw_text, shorten
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import UInt8

NARROWEST, WIDEST = 14, 27  # pixels from one class to the next
_LETTERS = 15

LegendRow = tuple[str, tuple[int, int, int], float]  # name, colour, share of the map


def legend_rows(labels: UInt8, label_set: LabelSet, shown: tuple[UInt8, ...] = ()) -> list[LegendRow]:
    """Classes that occur, the largest first and the unknown last.

    Args:
        labels: (N,) class ids of the map's points: shares are of these.
        label_set: Names and colours.
        shown: Images of class ids (...) whose classes are listed, too.
    """
    counts = np.bincount(labels.ravel(), minlength=256).astype(np.float64)
    present = counts > 0
    for image in shown:
        present |= np.bincount(image.ravel(), minlength=256) > 0
    shares = counts / max(counts.sum(), 1)
    rows = [
        (name, color, float(shares[class_id]))
        for name, color, class_id in zip(label_set.names, label_set.colors, label_set.ids, strict=True)
        if present[class_id]
    ]
    rows.sort(key=lambda row: -row[2])
    if present[label_set.ignore_id]:
        rows.append(("unknown", UNKNOWN, float(shares[label_set.ignore_id])))
    return rows


def draw_legend(canvas: UInt8, rows: list[LegendRow], at: tuple[int, int], size: tuple[int, int]) -> None:
    """Draw rows from (x, y) on into ``canvas``, as many as ``size`` (width, height) has room for."""
    (x, y), (width, height) = at, size
    pitch = int(np.clip(height // max(len(rows), 1), NARROWEST, WIDEST))
    for row, (name, color, share) in enumerate(rows[: height // pitch]):
        top = y + row * pitch
        cv2.rectangle(canvas, (x, top + 2), (x + 18, top + pitch - 5), color, -1)
        text_top = top + pitch // 2 - 9
        draw_text(canvas, shorten(name, width - 90, _LETTERS), (x + 28, text_top), _LETTERS, TEXT)
        draw_text(canvas, f"{share:.1%}" if share else "-", (x + width - 58, text_top), _LETTERS, DIM_TEXT)
