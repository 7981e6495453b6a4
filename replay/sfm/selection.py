"""Which frames of a film are worth a look: sharp ones, a step of motion apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.replay.sfm.film import Film
from semantic_mapper.types import Bool, Float64, Int64, UInt8

LOOK_WIDTH = 320  # frames are looked at in this size
STEP = 0.04  # motion between two picked frames, of the image's width
LEAST_MOTION = 0.005  # ... below which two frames are one
EDGES = 0.75  # weight of what moves fast: straight ahead most of the picture hardly moves, and its edges pass by
MAX_PICKS = 400  # longer ways get longer steps
BLURRED = 0.5  # of the sharpness of the frames around: less is a blurred frame
AROUND_NS = 700_000_000  # either side
DARK, FLAT = 14.0, 5.0  # grey levels: mean and standard deviation of a frame that shows nothing
_CORNERS, _LEAST_TRACKED = 150, 12


@dataclass(frozen=True, slots=True, eq=False)
class FilmLook:
    """What the first pass over a film has found, a value for each of its N frames.

    Args:
        index: (N,) number of the frame in the film.
        stamp_ns: (N,) rising.
        motion: (N,) since the frame before, of the image's width: median of what is followed; NaN where nothing is.
        fast: (N,) the same of what moves most: 85th percentile. Without rotation, a camera moving sideways has about
            1.25 times the median, one moving straight ahead 2 to 3 times.
        sharpness: (N,) RMS of the Laplacian over the contrast, to be compared with frames nearby only.
        dark: (N,) whether it shows nothing: black, covered, or one colour.
    """

    index: Int64
    stamp_ns: Int64
    motion: Float64
    fast: Float64
    sharpness: Float64
    dark: Bool

    @property
    def blurred(self) -> Bool:
        """(N,) much less sharp than the frames around it."""
        found = np.zeros(len(self.index), np.bool_)
        for i, stamp in enumerate(self.stamp_ns):
            low, high = np.searchsorted(self.stamp_ns, (stamp - AROUND_NS, stamp + AROUND_NS))
            low, high = min(low, max(0, i - 2)), max(high, min(len(self.index), i + 3))  # slow films, too
            found[i] = self.sharpness[i] < BLURRED * np.median(self.sharpness[low:high])
        return found & ~self.dark

    @property
    def way(self) -> Float64:
        """(N,) motion since the first frame; one that could not be followed counts as a whole step."""
        return np.cumsum(np.nan_to_num(np.maximum(self.motion, EDGES * self.fast), nan=STEP))


def look_through(film: Film, on_frame: Callable[[int], None]) -> FilmLook:
    """Read a film once; ``on_frame`` gets the number of frames read."""
    rows: list[tuple[int, int, float, float, float, bool]] = []
    last: UInt8 | None = None
    height = max(1, round(LOOK_WIDTH * film.height / film.width))
    for frame in film:
        gray = np.asarray(cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        small = np.asarray(cv2.resize(gray, (LOOK_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
        dark = bool(small.mean() < DARK and small.std() < 2 * FLAT) or bool(small.std() < FLAT)
        motion, fast = (0.0, 0.0) if last is None else _motion(last, small)
        rows.append((frame.index, frame.stamp_ns, motion, fast, _sharpness(gray), dark))
        last = small
        on_frame(len(rows))
    index, stamps, motion, fast, sharpness, dark = zip(*rows, strict=True) if rows else ((),) * 6
    return FilmLook(
        np.array(index, np.int64),
        np.array(stamps, np.int64),
        np.array(motion, np.float64),
        np.array(fast, np.float64),
        np.array(sharpness, np.float64),
        np.array(dark, np.bool_),
    )


def pick_frames(look: FilmLook, step: float = STEP, most: int = MAX_PICKS) -> Int64:
    """Rows of ``look`` for structure from motion: of each step of motion the sharpest frame, at most about ``most``."""
    usable = np.flatnonzero(~look.dark & ~look.blurred)
    if not len(usable):
        return usable
    way = look.way[usable]
    step = max(step, float(way[-1] - way[0]) / most)
    window = np.floor((way - way[0]) / step).astype(np.int64)
    order = np.lexsort((usable, -look.sharpness[usable], window))
    first = np.concatenate(([True], np.diff(window[order]) > 0))
    return np.sort(usable[order[first]])


def _sharpness(gray: UInt8) -> float:
    """RMS of the Laplacian over the contrast: a darker frame is not less sharp."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).std()) / max(float(gray.std()), 1.0)


def _motion(last: UInt8, now: UInt8) -> tuple[float, float]:
    """Median and 85th percentile of the motion of corners, of the width; NaN where they cannot be followed."""
    corners = cv2.goodFeaturesToTrack(last, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _LEAST_TRACKED:
        return float("nan"), float("nan")
    moved, found, _ = cv2.calcOpticalFlowPyrLK(last, now, corners, np.zeros_like(corners), winSize=(15, 15), maxLevel=3)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        now, last, moved, np.zeros_like(corners), winSize=(15, 15), maxLevel=3
    )
    true = (np.linalg.norm(back - corners, axis=2) < 1.0) & (found > 0) & (found_back > 0)
    if true.sum() < _LEAST_TRACKED:
        return float("nan"), float("nan")
    median, fast = np.percentile(np.linalg.norm(moved - corners, axis=2)[true], (50, 85)) / now.shape[1]
    return float(median), float(fast)
