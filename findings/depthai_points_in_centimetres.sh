#!/bin/sh
# Guess: ImgTransformation's project3DPointTo takes its point in millimetres, as spatial detections are given and as
#        projectPointTo takes its depth; or in the unit of the extrinsics that were set.
# Found: it takes centimetres, whatever the unit of the extrinsics. A point in mm is moved between two cameras as if it
#        were ten times as far: at 1 m, of a pair 7.5 cm apart with f 600, 4.5 px instead of 45. remap3DPointTo is the
#        same. A point in metres is off by 100 times the other way. No error: in one picture alone the unit cancels.
# Seen:  depthai 3.12.0, Python 3.11, Linux x86-64, without a device.
# Who:   users who draw detections of the depth camera into the colour picture.
# What to do: divide a detection's coordinates by 10.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import depthai as dai
import numpy as np


def camera(x, unit):
    made = dai.ImgTransformation()
    made.setSourceSize(1280, 800)
    made.setSize(1280, 800)
    made.setIntrinsicMatrix([[600, 0, 640], [0, 600, 400], [0, 0, 1]])
    pose = dai.Extrinsics()
    pose.rotationMatrix = np.eye(3).tolist()
    pose.translation = dai.Point3f(x, 0, 0)
    pose.lengthUnit = unit
    pose.toCameraSocket = dai.CameraBoardSocket.CAM_A
    made.setExtrinsics(pose)
    return made


wrong = False
for unit, x in ((dai.LengthUnit.MILLIMETER, 75.0), (dai.LengthUnit.CENTIMETER, 7.5), (dai.LengthUnit.METER, 0.075)):
    depth, colour = camera(x, unit), camera(0.0, unit)
    by_pixel = depth.projectPointTo(colour, dai.Point2f(640, 400), 1000).x - 640  # depth in mm, as documented
    by_point = [depth.project3DPointTo(colour, dai.Point3f(0, 0, z)).x - 640 for z in (1000, 100, 1)]
    moved = depth.remap3DPointTo(colour, dai.Point3f(0, 0, 1000)).x
    print(
        f"{unit}: pixel at 1000 mm {by_pixel:.2f} px; points at z 1000, 100, 1 {np.round(by_point, 2)}; {moved:.2f}"
    )
    wrong |= not np.allclose([by_pixel, *by_point, moved], [45, 4.5, 45, 4500, 7.5], rtol=1e-3)
sys.exit(wrong)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q depthai==3.12.0 numpy==2.4.6
DEPTHAI_LEVEL=error "$work/env/bin/python" "$work/try.py"
