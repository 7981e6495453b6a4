"""Corners that are followed from image to image (Lucas-Kanade), each with a number of its own."""

from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.types import Float64, Int64, UInt8

_WINDOW = (21, 21)  # pixels that a corner is compared by
_CONTRAST_WINDOW = 0.1  # of the width; each pixel has the mean and spread of such a square around it taken away
_CONTRAST_NOISE = 4.0  # of 255; what varies less stays flat
_CONTRAST_GAIN = 40.0  # grey levels a spread
_LEVELS = 3  # of the pyramid, next to the image itself
_STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
_BACK_PX = 0.7  # followed forth and back, a corner must come so near to where it was
_QUALITY = 0.005  # of a corner, against the best one of the image
_RIM_PX = 8
_EPIPOLAR_PX = 1.5
_EPIPOLAR_LEAST = 12  # corners that a fundamental matrix is fitted to


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Corners of one image."""

    ids: Int64  # (N,) numbers, ascending; the same corner has the same number in every image
    pixels: Float64  # (N, 2) float64 as (u, v)

    def rows(self, ids: Int64) -> Int64:
        """Rows (M,) of tracks that are there."""
        return np.searchsorted(self.ids, ids).astype(np.int64)

    def without(self, ids: Int64) -> "Tracks":
        """All but these."""
        keep = ~np.isin(self.ids, ids)
        return Tracks(self.ids[keep], self.pixels[keep])


NO_TRACKS = Tracks(np.zeros(0, np.int64), np.zeros((0, 2)))


def prepare_image(rgb: UInt8, width: int, height: int) -> UInt8:
    """A colour image (H, W, 3) as corners are followed in it: grey, of this size, with even local contrast."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if gray.shape != (height, width):
        gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    # Exposure may change between images. What evens it out has to move with the scene: CLAHE's tiles stand still, and
    # corners lag behind the motion by 1 to 2 %.
    light, side = gray.astype(np.float32), 2 * round(_CONTRAST_WINDOW * width / 2) + 1
    mean = cv2.blur(light, (side, side))
    spread = np.sqrt(np.maximum(cv2.blur(light * light, (side, side)) - mean * mean, 0)) + _CONTRAST_NOISE
    return np.clip(128 + _CONTRAST_GAIN * (light - mean) / spread, 0, 255).astype(np.uint8)


def follow(before: UInt8, after: UInt8, pixels: Float64, guess: Float64) -> tuple[Float64, np.ndarray]:
    """Where corners (N, 2) of one image are in another, from a guess (N, 2); whether they were found there and back."""
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, bool)
    start, found = pixels.astype(np.float32)[:, None], guess.astype(np.float32)[:, None].copy()
    flags, size = cv2.OPTFLOW_USE_INITIAL_FLOW, (_WINDOW, _LEVELS, _STEPS)
    found, forth, _ = cv2.calcOpticalFlowPyrLK(before, after, start, found, None, None, *size, flags)
    back, home, _ = cv2.calcOpticalFlowPyrLK(after, before, found, start.copy(), None, None, *size, flags)
    height, width = after.shape
    there = np.asarray(found, np.float64)[:, 0]
    inside = ((there > _RIM_PX) & (there < (width - _RIM_PX, height - _RIM_PX))).all(axis=1)
    near = np.linalg.norm(back[:, 0] - start[:, 0], axis=1) < _BACK_PX
    return there, inside & near & (forth[:, 0] > 0) & (home[:, 0] > 0)


class Tracker:
    """Follows up to ``count`` corners through a stream of images of one size."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._next_id = 0
        self._last: UInt8 | None = None
        self._before: UInt8 | None = None
        self.tracks = NO_TRACKS

    def advance(self, image: UInt8, guess: Float64 | None = None) -> Tracks:
        """Follow the corners into the next image; ``guess`` (N, 2): where they are expected, None = where they were."""
        if self._last is not None and len(self.tracks.ids):
            guess = self.tracks.pixels if guess is None else guess
            pixels, good = follow(self._last, image, self.tracks.pixels, guess)
            good &= _on_epipolar_lines(self.tracks.pixels, pixels, good)
            self.tracks = Tracks(self.tracks.ids[good], pixels[good])
        self._before, self._last = self._last, image
        return self.tracks

    def fresh(self) -> "Tracker":
        """One that follows nothing yet, and gives numbers that this one has not given."""
        other = Tracker(self._count)
        other._next_id = self._next_id
        return other

    def retry(self, image: UInt8, tracks: Tracks, guess: Float64) -> Tracks:
        """``advance`` of the last image again, from another guess."""
        self._last, self.tracks = self._before, tracks
        return self.advance(image, guess)

    def drop(self, ids: Int64) -> None:
        """Follow these corners no longer."""
        self.tracks = self.tracks.without(ids)

    def replenish(self) -> Tracks:
        """Find new corners in the image of the last ``advance``, away from those that are followed."""
        missing = self._count - len(self.tracks.ids)
        if self._last is None or missing <= 0:
            return self.tracks
        gray = self._last
        apart = 0.6 * np.sqrt(gray.size / self._count)
        free = np.zeros_like(gray)
        free[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX] = 255
        for u, v in np.rint(self.tracks.pixels).astype(int).tolist():
            cv2.circle(free, (u, v), round(apart), 0, -1)
        corners = cv2.goodFeaturesToTrack(gray, missing, _QUALITY, apart, mask=free, blockSize=5)
        if corners is not None and len(corners):
            pixels = np.asarray(corners, np.float64)[:, 0]
            ids = self._next_id + np.arange(len(pixels), dtype=np.int64)
            self._next_id += len(pixels)
            self.tracks = Tracks(np.concatenate((self.tracks.ids, ids)), np.concatenate((self.tracks.pixels, pixels)))
        return self.tracks


def _on_epipolar_lines(before: Float64, after: Float64, good: np.ndarray) -> np.ndarray:
    """(N,) whether corners move as a still scene does; all of them where there are too few to judge."""
    fits = np.ones(len(before), bool)
    if good.sum() >= _EPIPOLAR_LEAST:
        cv2.setRNGSeed(1)
        _, inliers = cv2.findFundamentalMat(before[good], after[good], cv2.FM_RANSAC, _EPIPOLAR_PX, 0.99, 300)
        if inliers is not None and inliers.sum() >= 0.4 * good.sum():
            fits[good] = inliers.ravel() > 0
    return fits
