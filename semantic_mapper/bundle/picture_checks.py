"""What is wrong with pictures by themselves: named and counted."""

from __future__ import annotations

from collections import Counter, deque

import cv2
import numpy as np

from semantic_mapper.types import UInt8

_SIDE = 160  # pixels that pictures are judged in
_DARK = 24.0  # grey level that hardly any pixel of a dark picture reaches
_JUMP = 0.5  # of the mean brightness, natural logarithm, from one picture to the next
_BLUR = 0.35  # of the median sharpness of the pictures before
_RECENT = 15  # pictures that sharpness is compared with
SENTENCES = {
    "dark": "pictures are too dark: more light, or a longer exposure",
    "blurred": "pictures are blurred: move the camera more slowly, or give it more light",
    "exposure_jump": "the exposure jumps from picture to picture: fix it, or let it change more slowly",
}


class PictureChecker:
    """Judges the pictures of one camera in their order."""

    def __init__(self) -> None:
        self._sharpness: deque[float] = deque(maxlen=_RECENT)
        self._brightness: float | None = None
        self.counters: Counter[str] = Counter()  # pictures by what was wrong, a name of ``SENTENCES``
        self.warnings: tuple[str, ...] = ()  # a sentence for each thing that is wrong with the last picture

    def look(self, rgb: UInt8) -> tuple[str, ...]:
        """Judge the next picture (H, W, 3); the names of what is wrong."""
        size = _SIDE, max(1, round(_SIDE * rgb.shape[0] / rgb.shape[1]))
        gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        before, self._brightness = self._brightness, float(np.log(gray.mean() + 1.0))
        if np.percentile(gray, 95) < _DARK:
            found = ["dark"]
        else:
            # Edges against contrast: a dim picture is as sharp as a bright one.
            sharp = float(cv2.Laplacian(gray, cv2.CV_32F).var() / (gray.var() + 1.0))
            usual = float(np.median(self._sharpness)) if len(self._sharpness) >= _RECENT // 3 else 0.0
            found = ["blurred"] if sharp < _BLUR * usual else []
            if before is not None and abs(self._brightness - before) > _JUMP:
                found.append("exposure_jump")
            self._sharpness.append(sharp)
        self.counters.update(found)
        self.warnings = tuple(SENTENCES[name] for name in found)
        return tuple(found)
