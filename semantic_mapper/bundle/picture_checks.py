"""What is wrong with pictures, and between pictures and poses: named and counted."""

from __future__ import annotations

from collections import Counter, deque

import cv2
import numpy as np

from semantic_mapper.geometry import rotation_vector
from semantic_mapper.types import Float64, UInt8

_SIDE = 160  # pixels that pictures are judged in
_DARK = 24.0  # grey level that hardly any pixel of a dark picture reaches
_JUMP = 0.5  # of the mean brightness, natural logarithm, from one picture to the next
_BLUR = 0.35  # of the median sharpness of the pictures before
_RECENT = 15  # pictures that sharpness is compared with
_STILL_PX = 0.004  # of the image's width that corners move by at most in pictures of a camera that stands
_MOVED_M, _MOVED_RAD = 0.03, 0.05  # that poses move by at least to contradict them
_MISFIT = 0.006  # of the image's width by which poses may be off between keyframes
_SENTENCES = {
    "dark": "the picture is too dark",
    "blurred": "the picture is blurred: move the camera more slowly, or give it more light",
    "exposure_jump": "the exposure has jumped since the picture before",
    "still_pictures": "poses move, but the pictures do not: does the source of poses tell of this camera?",
    "misfit": "poses do not fit the pictures: check their time stamps, T_base_camera and the calibration",
}


class PictureChecker:
    """Judges the pictures of one camera in their order.

    Attributes:
        counters: Pictures by what was wrong: "dark", "blurred", "exposure_jump"; and, by ``compare``, "still_pictures"
            (poses that move though pictures do not) and "misfit" (poses that do not fit the pictures).
        reason: What is wrong with the last picture, empty where nothing is.
    """

    def __init__(self) -> None:
        self._sharpness: deque[float] = deque(maxlen=_RECENT)
        self._brightness: float | None = None
        self._found: tuple[str, ...] = ()
        self._contradictions: tuple[str, ...] = ()
        self.counters: Counter[str] = Counter()

    @property
    def reason(self) -> str:
        """See the class."""
        return "; ".join(_SENTENCES[name] for name in self._found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each thing that is wrong with the last picture, or between it and its pose."""
        return tuple(_SENTENCES[name] for name in (*self._found, *self._contradictions))

    def look(self, rgb: UInt8) -> tuple[str, ...]:
        """Judge the next picture (H, W, 3); the names of what is wrong."""
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        gray = cv2.resize(
            gray, (_SIDE, max(1, round(_SIDE * gray.shape[0] / gray.shape[1]))), interpolation=cv2.INTER_AREA
        )
        bright = float(np.log(gray.mean() + 1.0))
        # Edges against contrast: a dim picture is as sharp as a bright one.
        sharp = float(cv2.Laplacian(gray, cv2.CV_32F).var() / (gray.var() + 1.0))
        found: list[str] = []
        if np.percentile(gray, 95) < _DARK:
            found.append("dark")
        elif len(self._sharpness) >= _RECENT // 3 and sharp < _BLUR * float(np.median(self._sharpness)):
            found.append("blurred")
        if "dark" not in found and self._brightness is not None and abs(bright - self._brightness) > _JUMP:
            found.append("exposure_jump")
        if "dark" not in found:
            self._sharpness.append(sharp)
        self._brightness = bright
        self._found = tuple(found)
        self.counters.update(found)
        return self._found

    def compare(self, given: Float64 | None, flow: float, error: float) -> tuple[str, ...]:
        """Judge a pose against the picture.

        Args:
            given: Motion (4, 4) that poses tell of since the last keyframe; None = not known.
            flow: Median motion of corners since then, as a fraction of the image's width; NaN = not known.
            error: Median distance between corners and where they would be by the poses, likewise.
        """
        found: list[str] = []
        if given is not None and flow < _STILL_PX:
            moved = np.linalg.norm(given[:3, 3]) > _MOVED_M or np.linalg.norm(rotation_vector(given)) > _MOVED_RAD
            if moved:
                found.append("still_pictures")
        if error > _MISFIT:
            found.append("misfit")
        self._contradictions = tuple(found)
        self.counters.update(found)
        return self._contradictions
