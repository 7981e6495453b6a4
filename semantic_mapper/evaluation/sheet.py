"""The contact sheet of a benchmark run: a row a view, a column a method, truth beside them, legend below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.evaluation.canvas import (
    DIM_TEXT,
    GAP,
    MARGIN,
    TEXT,
    UNKNOWN,
    draw_text,
    new_canvas,
    paste,
    shorten,
)
from semantic_mapper.evaluation.report import class_colors
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import UInt8

TILE_WIDTH = 320
HEADER = 80
CAPTION = 24
LEGEND_PITCH = 26
LEGEND_COLUMN = 180


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


def draw_sheet(rows: Sequence[SheetRow], methods: Sequence[str], label_set: LabelSet, *, title: str) -> UInt8:
    """Draw the sheet: camera, truth and one column a method.

    Args:
        rows: At least one.
        methods: Names of the columns, in their order.
        label_set: Of all label images.
        title: Head of the picture.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    tile_height = round(TILE_WIDTH * rows[0].rgb.shape[0] / rows[0].rgb.shape[1])
    columns = 2 + len(methods)
    width = 2 * MARGIN + columns * TILE_WIDTH + (columns - 1) * GAP
    legend = _legend_entries(rows, label_set)
    across = max(1, (width - 2 * MARGIN) // LEGEND_COLUMN)
    legend_height = -(-len(legend) // across) * LEGEND_PITCH + MARGIN
    canvas = new_canvas(width, HEADER + len(rows) * (CAPTION + tile_height + GAP) + legend_height)
    draw_text(canvas, shorten(title, width - 2 * MARGIN, 22), (MARGIN, 16), 22, TEXT)
    for column, name in enumerate(("camera", "truth", *methods)):
        draw_text(canvas, shorten(name, TILE_WIDTH, 16), (_left(column), 52), 16, TEXT)
    y = HEADER
    for row in rows:
        _draw_row(canvas, row, methods, label_set, (y, tile_height))
        y += CAPTION + tile_height + GAP
    for number, (name, color) in enumerate(legend):
        x, top = MARGIN + number % across * LEGEND_COLUMN, y + number // across * LEGEND_PITCH
        cv2.rectangle(canvas, (x, top + 2), (x + 18, top + 18), color, -1)
        draw_text(canvas, shorten(name, LEGEND_COLUMN - 34, 15), (x + 26, top + 2), 15, TEXT)
    return canvas


def write_picture(path: Path, picture: UInt8) -> None:
    """Write an RGB picture (H, W, 3) as PNG, whole or not at all.

    Raises:
        SemanticMapperError: it cannot be encoded or written.
    """
    small = (cv2.IMWRITE_PNG_COMPRESSION, 6)  # half the size that it has by default
    encoded, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), small)
    if not encoded:
        raise SemanticMapperError(f"{path}: the picture could not be encoded as PNG")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data.tobytes())
    except OSError as error:
        raise SemanticMapperError(f"{path}: cannot be written: {error.strerror or error}") from error


def _left(column: int) -> int:
    return MARGIN + column * (TILE_WIDTH + GAP)


def _draw_row(
    canvas: UInt8, row: SheetRow, methods: Sequence[str], label_set: LabelSet, place: tuple[int, int]
) -> None:
    y, tile_height = place
    size = (TILE_WIDTH, tile_height)
    tiles = [(row.name, row.rgb, cv2.INTER_AREA), ("", class_colors(row.truth, label_set), cv2.INTER_NEAREST)]
    for name in methods:
        picture = class_colors(row.labels[name], label_set) if name in row.labels else new_canvas(*size)
        tiles.append((row.notes.get(name, ""), picture, cv2.INTER_NEAREST))
    for column, (caption, picture, interpolation) in enumerate(tiles):
        draw_text(canvas, shorten(caption, TILE_WIDTH, 15), (_left(column), y + 2), 15, DIM_TEXT)
        scaled = cv2.resize(picture, size, interpolation=interpolation)
        paste(canvas, np.asarray(scaled, np.uint8), (_left(column), y + CAPTION))


def _legend_entries(rows: Sequence[SheetRow], label_set: LabelSet) -> list[tuple[str, tuple[int, int, int]]]:
    """Names and colours of the classes that any picture shows."""
    shown = [label.ravel() for row in rows for label in (row.truth, *row.labels.values())]
    present = np.bincount(np.concatenate(shown), minlength=256) > 0
    entries = [
        (name, color)
        for name, color, class_id in zip(label_set.names, label_set.colors, label_set.ids, strict=True)
        if present[class_id]
    ]
    return [*entries, ("unknown", UNKNOWN)] if present[label_set.ignore_id] else entries
