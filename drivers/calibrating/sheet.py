"""The board as a picture to print, of its true size where the printer does not scale."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np

from semantic_mapper.drivers.poses.board import make_board
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import UInt8

PIXELS_A_METRE = 11811  # 300 dots an inch, about
MARGIN_M = 0.005  # white, all round; the words stand in the lower one
LARGEST_PX = 30_000  # a side


def draw_sheet(config: BoardPoses) -> tuple[UInt8, int]:
    """The board with its margin, (H, W) uint8, and how many pixels of it are a metre.

    Squares have a whole number of pixels, so that all are alike.

    Raises:
        ConfigError: a board that cannot be, or too large to be drawn.
    """
    square_px = max(8, round(config.square_m * PIXELS_A_METRE))
    a_metre = square_px / config.square_m
    gap_px = 0 if config.pattern == "charuco" else round((config.square_m - config.marker_m) * a_metre)
    width, height = config.columns * square_px - gap_px, config.rows * square_px - gap_px
    margin = round(MARGIN_M * a_metre)
    if max(width, height) + 2 * margin > LARGEST_PX:
        raise ConfigError(
            f"a board of {width / a_metre:.2f} x {height / a_metre:.2f} m is too large to be drawn at {a_metre:.0f} "
            "pixels a metre; have it printed from a drawing of your own"
        )
    board: Any = make_board(config)
    sheet = np.full((height + 2 * margin, width + 2 * margin), 255, np.uint8)
    sheet[margin : margin + height, margin : margin + width] = board.generateImage((width, height), marginSize=0)
    words = (
        f"{config.pattern} {config.columns} x {config.rows}, {1000 * config.square_m:g} mm a square, marker "
        f"{1000 * config.marker_m:g} mm. Print at 100 %, then measure a square."
    )
    scale = 0.6 * margin / 32  # Hershey letters are about 32 pixels high at 1
    cv2.putText(
        sheet,
        words,
        (margin, height + 2 * margin - round(0.25 * margin)),
        cv2.FONT_HERSHEY_SIMPLEX,
        scale,
        90,
        max(1, round(2 * scale)),
        cv2.LINE_AA,
    )
    return sheet, round(a_metre)


def sheet_png(config: BoardPoses) -> bytes:
    """The sheet as a PNG file that says how large it is.

    Raises:
        ConfigError: see ``draw_sheet``.
    """
    from PIL import Image

    sheet, a_metre = draw_sheet(config)
    data, dpi = io.BytesIO(), 0.0254 * a_metre
    Image.fromarray(sheet).save(data, "PNG", dpi=(dpi, dpi))
    return data.getvalue()
