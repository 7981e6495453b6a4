#!/bin/sh
# Guess: ImgTransformation.isAlignedTo of DepthAI says whether pixels of two pictures show the same thing, so that
#        colour may be laid over depth: two cameras at different places are not aligned.
# Found: places and directions do not count. Two cameras of the same intrinsics and size are "aligned" when they are 2 m
#        apart or look 30 degrees apart, although the poses are there: by the same objects a point at 1 m lies 45 pixels
#        apart in a rectified pair of 7.5 cm. isEqualTransformation does compare the poses.
# Seen:  depthai 3.12.0, Python 3.11, Linux x86-64, without a device.
# Who:   users who ask it before they lay colour over depth: rectified pairs have equal intrinsics.
# What to do: ask isEqualTransformation, or compare getExtrinsicsTransformationMatrixTo with the identity as well.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import depthai as dai
import numpy as np


def camera(x_cm=0.0, turned_deg=0.0, focal_px=600.0):
    made = dai.ImgTransformation()
    made.setSourceSize(1280, 800)
    made.setSize(1280, 800)
    made.setIntrinsicMatrix([[focal_px, 0, 640], [0, focal_px, 400], [0, 0, 1]])
    c, s = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    pose = dai.Extrinsics()
    pose.rotationMatrix = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose.translation = dai.Point3f(x_cm, 0, 0)
    pose.lengthUnit = dai.LengthUnit.CENTIMETER
    pose.toCameraSocket = dai.CameraBoardSocket.CAM_A
    made.setExtrinsics(pose)
    return made


here = camera()
others = {
    "same": camera(),
    "7.5 cm apart": camera(7.5),
    "2 m apart": camera(200),
    "turned by 30 degrees": camera(0, 30),
    "other focal length": camera(focal_px=500),
}
found = {name: (here.isAlignedTo(other), here.isEqualTransformation(other)) for name, other in others.items()}
apart = here.projectPointTo(others["7.5 cm apart"], dai.Point2f(640, 400), 1000).x - 640
print(f"aligned, equal: {found}; a point at 1 m, 7.5 cm apart: {apart:.1f} px")
expected = {name: (name != "other focal length", name == "same") for name in others}
sys.exit(found != expected or abs(abs(apart) - 45) > 0.1)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q depthai==3.12.0 numpy==2.4.6
DEPTHAI_LEVEL=error "$work/env/bin/python" "$work/try.py"
