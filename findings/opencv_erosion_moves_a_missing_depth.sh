#!/bin/sh
# Guess: erode and dilate of OpenCV, over a float depth image with NaN where depth is missing, either leave NaN out or
#        spread it over the window; the place itself stays NaN or is filled.
# Found: of float32 the NaN moves. With a window of 3x3 a single missing pixel is NaN one pixel to the left and one up
#        or down, by whether its row is even, and nowhere else; with 5x5 two to the left and two up or down. The missing
#        pixel itself gets a value. Of float64 it vanishes at three places of four, by row and column even or odd, and
#        becomes a square of 2x2 at the fourth. So a mask of what is missing no longer fits. No error, no warning.
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

PLACES = [(20, 20), (20, 21), (21, 20), (21, 21)]


def nan_at(change, kind, side):
    """Where NaN is after ``change``, as (down, right) from where it was, of each place."""
    found = []
    for place in PLACES:
        depth = np.full((40, 40), 2.0, kind)
        depth[place] = np.nan
        changed = change(depth, np.ones((side, side), np.uint8))
        found.append([tuple(int(x) for x in at - place) for at in np.argwhere(np.isnan(changed))])
    return found


cases = [(kind, side) for kind in (np.float32, np.float64) for side in (3, 5)]
found = {
    (kind.__name__, side): [nan_at(change, kind, side) for change in (cv2.erode, cv2.dilate)] for kind, side in cases
}
for case, of_both in found.items():
    print(case, *of_both, sep="\n    ")
square = [[(0, 0), (0, 1), (1, 0), (1, 1)], [(1, 1), (1, 2), (2, 1), (2, 2)]]
expected = {
    ("float32", 3): [[(-1, -1)]] * 2 + [[(1, -1)]] * 2,
    ("float32", 5): [[(2, -2)]] * 2 + [[(-2, -2)]] * 2,
    ("float64", 3): [square[0], [], [], []],
    ("float64", 5): [[], [], [], square[1]],
}
sys.exit(any(found[case] != [places, places] for case, places in expected.items()))
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q opencv-contrib-python-headless==5.0.0.93 numpy==2.4.6
for disabled in '' AVX2,AVX512-SKX; do
    echo "without ${disabled:-nothing}"
    OPENCV_CPU_DISABLE=$disabled "$work/env/bin/python" "$work/try.py" 2>/dev/null
done
