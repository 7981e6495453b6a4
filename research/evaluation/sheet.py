"""The contact sheet of a benchmark run: a row a view, a column a method, truth beside them, legend below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper.labels import LabelSet
from semantic_mapper.plots import (
    PANEL,
    TEXT_PT,
    class_colors,
    class_rows,
    cut,
    new_figure,
    place,
    put_legend,
    put_picture,
    put_text,
    put_title,
    rendered,
)
from semantic_mapper.types import UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARGIN, GAP, HEADER, CAPTION = 24, 14, 98, 26
TILE_WIDTH = 320
LEGEND_PITCH, LEGEND_COLUMN = 26, 180


@dataclass(frozen=True, slots=True, eq=False)
class SheetRow:
    """One query view.

    Args:
        name: Says which view.
        rgb: (H, W, 3) uint8.
        truth: (H, W) uint8 class ids.
        labels: (H, W) uint8 class ids by method; a method that is missing leaves its place empty.
        notes: What is said above a method's tile, by method.
    """

    name: str
    rgb: UInt8
    truth: UInt8
    labels: Mapping[str, UInt8]
    notes: Mapping[str, str]


@rendered
def draw_sheet(
    rows: Sequence[SheetRow], methods: Sequence[str], label_set: LabelSet, *, title: str, subtitle: str = ""
) -> Figure:
    """Draw the sheet: camera, truth and one column a method.

    Args:
        rows: At least one.
        methods: Names of the columns, in their order.
        label_set: Of all label images.
        title: Head of the picture.
        subtitle: A smaller line below it.
    """
    height = round(TILE_WIDTH * rows[0].rgb.shape[0] / rows[0].rgb.shape[1])
    columns = ("camera", "truth", *methods)
    width = len(columns) * (TILE_WIDTH + GAP) - GAP
    shown = [label for row in rows for label in (row.truth, *row.labels.values())]
    legend = [(name, color, None) for name, color, _ in class_rows(np.zeros(0, np.uint8), label_set, shown)]
    across = max(1, width // LEGEND_COLUMN)
    legend_height = -(-len(legend) // across) * LEGEND_PITCH
    bottom = HEADER + len(rows) * (CAPTION + height + GAP)
    figure = new_figure(width + 2 * MARGIN, bottom + legend_height + MARGIN)
    put_title(figure, title, subtitle)
    heads = place(figure, (MARGIN, HEADER - 18, width, 18))
    empty = np.full((1, 1, 3), PANEL, np.uint8)
    for column, name in enumerate(columns):
        x = column * (TILE_WIDTH + GAP)
        put_text(heads, (x, 6), cut(name, TILE_WIDTH, TEXT_PT, "bold"), weight="bold")
        for number, row in enumerate(rows):
            if column < 2:
                picture = row.rgb if column == 0 else class_colors(row.truth, label_set)
            else:
                picture = class_colors(row.labels[name], label_set) if name in row.labels else empty
            caption = row.name if column == 0 else row.notes.get(name, "")
            top = HEADER + CAPTION + number * (CAPTION + height + GAP)
            put_picture(figure, (MARGIN + x, top, TILE_WIDTH, height), picture, caption, smooth=column == 0)
    put_legend(figure, (MARGIN, bottom, across * LEGEND_COLUMN, legend_height), legend, across)
    return figure
