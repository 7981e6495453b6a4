"""How much of the image and of tilt the views of a board cover, and what is missing, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.types import Float64

CELLS = 6  # a side; the image is divided into this many cells
REGIONS = ("top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right")
_ACROSS = 3  # regions a side
_SEEN_CELLS = 2  # of the four of a region that must have corners in them


def area_counts(pixels: Sequence[Float64], size: tuple[int, int]) -> NDArray[np.int64]:
    """Corners in each cell of the image, (CELLS, CELLS)."""
    counts = np.zeros((CELLS, CELLS), np.int64)
    for corners in pixels:
        cells = np.clip(((corners + 0.5) / size * CELLS).astype(int), 0, CELLS - 1)
        np.add.at(counts, (cells[:, 1], cells[:, 0]), 1)
    return counts


def missing_regions(counts: NDArray[np.int64]) -> tuple[str, ...]:
    """Names of the ninths of the image in which the board was not seen, or hardly."""
    side = CELLS // _ACROSS
    seen = (counts > 0).reshape(_ACROSS, side, _ACROSS, side).sum(axis=(1, 3)).ravel()
    return tuple(name for name, cells in zip(REGIONS, seen, strict=True) if cells < _SEEN_CELLS)


def tilt_degrees(T_camera_board: Float64) -> Float64:
    """How far the board leans, (2,): up or down, and to a side; (0, 0) where it is seen head on."""
    x, y, z = T_camera_board[:3, 2]
    return np.degrees(np.array((np.arctan2(y, z), np.arctan2(x, z))))


def shortfalls(
    config: CalibrationConfig, views: int, counts: NDArray[np.int64], tilts: Float64 | None
) -> tuple[str, ...]:
    """What is missing for a calibration that can be believed, as sentences that say what to do.

    Args:
        config: What is requested.
        views: How many there are.
        counts: See ``area_counts``.
        tilts: (N, 2) degrees; None where they are not known yet.
    """
    lacks: list[str] = []
    if views < config.min_views:
        lacks.append(f"{views} views that differ from each other, {config.min_views} are needed: move the board about")
    missing = missing_regions(counts)
    if missing:
        lacks.append(f"the board was not seen in these parts of the image: {', '.join(missing)}; hold it there, too")
    if tilts is None:
        return tuple(lacks)
    steepest = np.abs(tilts).max(axis=0) if len(tilts) else np.zeros(2)
    for name, most in zip(("up or down", "to the left or right"), steepest, strict=True):
        if most < config.min_tilt_deg:
            lacks.append(
                f"the board never leaned {name} by {config.min_tilt_deg:g} degrees (at most {most:.0f}); without that "
                "the focal length cannot be distinguished from the distance"
            )
    return tuple(lacks)
