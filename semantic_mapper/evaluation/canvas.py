"""Small drawing helpers of the report: canvas, smooth text, colours."""

from __future__ import annotations

import functools
from bisect import bisect_right

import cv2
import numpy as np

from semantic_mapper.types import UInt8

MARGIN = 24
GAP = 14
BACKGROUND = (22, 25, 31)
PANEL = (31, 35, 43)
TEXT = (234, 237, 242)
DIM_TEXT = (158, 166, 178)
UNKNOWN = (112, 116, 122)

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FINE = 4  # text is drawn this much larger and scaled down: Hershey strokes look coarse otherwise


def new_canvas(width: int, height: int) -> UInt8:
    """A (height, width, 3) picture of background."""
    return np.full((height, width, 3), BACKGROUND, np.uint8)


def paste(canvas: UInt8, picture: UInt8, at: tuple[int, int]) -> None:
    """Copy ``picture`` into ``canvas`` with its upper left corner at (x, y); it has to fit."""
    x, y = at
    canvas[y : y + picture.shape[0], x : x + picture.shape[1]] = picture


def text_width(text: str, height: int) -> int:
    """Width in pixels of a line whose letters with their ascenders and descenders are ``height`` high."""
    return _letters(text, height).shape[1]


def shorten(text: str, width: int, height: int) -> str:
    """``text``, cut with "..." where it is wider than ``width`` pixels."""
    if len(text) <= width and text_width(text, height) <= width:  # no letter is narrower than a pixel
        return text
    letters = range(1, min(len(text), width) + 1)
    return text[: bisect_right(letters, width, key=lambda count: text_width(text[:count] + "...", height))] + "..."


def draw_text(canvas: UInt8, text: str, at: tuple[int, int], height: int, color: tuple[int, int, int]) -> None:
    """Draw one line with its upper left corner at (x, y), cut at the canvas; letters the font lacks become "?"."""
    x, y = at
    letters = _letters(text, height)
    part = canvas[y : y + letters.shape[0], x : x + letters.shape[1]]
    cover = letters[: part.shape[0], : part.shape[1], None].astype(np.float32) / 255
    part[:] = (part * (1 - cover) + np.array(color, np.float32) * cover).astype(np.uint8)


@functools.lru_cache(maxsize=1024)
def _letters(text: str, height: int) -> UInt8:
    """Coverage (h, w) of a line of text, as wide as what was drawn: releases of OpenCV differ in font and measure."""
    text = text.encode("ascii", "replace").decode("ascii")
    tall = height * _FINE
    mask = np.zeros((round(tall * 1.3), tall * (len(text) + 2)), np.uint8)
    scale = tall / 32  # letters with ascenders and descenders are about 32 pixels high at scale 1
    thickness = max(1, round(tall / 14))
    cv2.putText(mask, text, (0, round(tall * 0.95)), _FONT, scale, 255, thickness, cv2.LINE_AA)
    drawn = np.flatnonzero(mask.any(axis=0))
    width = -(-(int(drawn[-1]) + 1) // _FINE) if len(drawn) else 1
    size = (width, mask.shape[0] // _FINE)
    return cv2.resize(mask[:, : width * _FINE], size, interpolation=cv2.INTER_AREA).astype(np.uint8)
