#!/bin/sh
# Guess: the fields of view that a picture's ImgTransformation gives stay those of the lens when the picture is mirrored
#        or turned by 180 degrees, and change places when it is turned by 90.
# Found: they are computed from the signed diagonal of the intrinsic matrix. Mirrored, the horizontal one is -93.7
#        degrees instead of 93.7; turned by 180, both are negative; turned by 90, both are -180 (the diagonal is 0);
#        turned by 10, 0.9 too wide. getDFov raises an error where the horizontal one is below 0. The intrinsic matrix
#        itself is right.
# Seen:  depthai 3.12.0, Python 3.11, Linux x86-64, without a device.
# Who:   users of cameras mounted upside down or on edge, who compute angles or distances from getHFov.
# What to do: compute the angle from the matrix, by the length of its rows.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import depthai as dai
import numpy as np


def picture(change=lambda made: made):
    made = dai.ImgTransformation()
    made.setSourceSize(1280, 800)
    made.setSize(1280, 800)
    made.setIntrinsicMatrix([[600, 0, 640], [0, 600, 400], [0, 0, 1]])
    change(made)
    return made


def turned(angle):
    return picture(lambda made: made.addRotation(angle, dai.Point2f(640, 400)))


def diagonal(made):
    try:
        return round(made.getDFov(), 1)
    except RuntimeError:
        return "error"


cases = {
    "as it is": picture(),
    "mirrored": picture(lambda made: made.addFlipHorizontal()),
    "turned by 10": turned(10),
    "turned by 90": turned(90),
    "turned by 180": turned(180),
}
found = {name: (round(made.getHFov(), 1), round(made.getVFov(), 1), diagonal(made)) for name, made in cases.items()}
for name, angles in found.items():
    focal = np.linalg.norm(np.array(cases[name].getIntrinsicMatrix())[0, :2])
    print(f"{name}: horizontal, vertical, diagonal {angles}; f by the first row's length {focal:.1f}")
sys.exit(
    found["as it is"] != (93.7, 67.4, 103.0)
    or found["mirrored"] != (-93.7, 67.4, "error")
    or found["turned by 180"] != (-93.7, -67.4, "error")
    or found["turned by 90"] != (-180.0, -180.0, "error")
    or not 94.5 < found["turned by 10"][0] < 95
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q depthai==3.12.0 numpy==2.4.6
DEPTHAI_LEVEL=error "$work/env/bin/python" "$work/try.py"
