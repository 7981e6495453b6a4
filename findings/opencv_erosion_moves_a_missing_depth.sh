#!/bin/sh
# Guess: erode and dilate of OpenCV, over a float depth image with NaN where depth is missing, either leave NaN out or spread
#        it over the window; the place itself stays NaN or is filled.
# Found: of float32 the NaN moves. With a window of 3x3 one missing pixel is NaN one pixel up and to the left, and nowhere
#        else; with 5x5 two pixels down and to the left; closed, two to the left. The missing pixel itself gets a value. Of
#        float64 the NaN becomes a square of 2x2 (3x3 window) or vanishes (5x5). So the mask of what is missing fits no
#        longer. No error, no warning.
# Seen:  opencv-contrib-python-headless 5.0.0.93, Python 3.11, Linux x86-64, with and without AVX2.
# Who:   users who grow or clean edges of a depth image whose missing values are NaN, as rescaleDepth gives them.
# What to do: take the mask first, put +inf (before erode) or 0 (before dilate) there, and apply the mask afterwards.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import cv2
import numpy as np

MISSING = 20, 20


def nan_at(change, kind):
    """Where NaN is after ``change``, from where it was: (down, right)."""
    depth = np.full((40, 40), 2.0, kind)
    depth[MISSING] = np.nan
    return [tuple(int(x) for x in place - MISSING) for place in np.argwhere(np.isnan(change(depth)))]


def window(side):
    return np.ones((side, side), np.uint8)


changes = {
    "erode 3x3": lambda d: cv2.erode(d, window(3)), "dilate 3x3": lambda d: cv2.dilate(d, window(3)),
    "erode 5x5": lambda d: cv2.erode(d, window(5)), "dilate 5x5": lambda d: cv2.dilate(d, window(5)),
    "close 3x3": lambda d: cv2.morphologyEx(d, cv2.MORPH_CLOSE, window(3)),
}
found = {kind.__name__: {name: nan_at(change, kind) for name, change in changes.items()} for kind in (np.float32, np.float64)}
for kind, places in found.items():
    print(kind, places)
single = found["float32"]
square = [(0, 0), (0, 1), (1, 0), (1, 1)]
sys.exit(
    any(single[f"{name} 3x3"] != [(-1, -1)] or single[f"{name} 5x5"] != [(2, -2)] for name in ("erode", "dilate"))
    or single["close 3x3"] != [(0, -2)]
    or any(found["float64"][f"{name} 3x3"] != square or found["float64"][f"{name} 5x5"] for name in ("erode", "dilate"))
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q opencv-contrib-python-headless==5.0.0.93 numpy==2.4.6
for disabled in none AVX2,AVX512-SKX; do
    echo "disabled: $disabled"
    OPENCV_CPU_DISABLE=$disabled "$work/env/bin/python" "$work/try.py" 2>/dev/null
done
