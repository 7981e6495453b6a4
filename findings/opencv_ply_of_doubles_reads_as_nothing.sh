#!/bin/sh
# Guess: loadPointCloud of OpenCV 5 reads a PLY file whose coordinates are doubles, as plyfile, NumPy users and Open3D
#        write them; or it throws an error, as its documentation says of a cloud that cannot be read.
# Found: it gives (None, None, None) and goes on; loadMesh the same of a mesh. Only the log has a line ("should be
#        float"). The same file in floats is read. What OpenCV wrote from colours of 8 bits is odd as well:
#        savePointCloud multiplies them by 255, so that a property of type uchar holds 65025, which plyfile refuses and
#        which OpenCV reads back as 1 of 255.
# Seen:  opencv-contrib-python-headless 5.0.0.93, plyfile 1.1.5, Python 3.11, Linux x86-64.
# Who:   users who read clouds of other programs, and see "no points" where a file is wrong for OpenCV alone.
# What to do: check the result for None; convert to float32 first, and hand over colours as floats of 0 to 1.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import cv2
import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

POINTS = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def write(kind, path):
    vertices = np.array(POINTS, dtype=[(axis, kind) for axis in "xyz"])
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    PlyData([PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")], text=True).write(path)


read = {}
for kind in ("f4", "f8"):
    write(kind, path := f"{sys.argv[1]}/{kind}.ply")
    cloud, mesh = cv2.loadPointCloud(path), cv2.loadMesh(path)
    read[kind] = [found[0] if found[0] is None else len(found[0].reshape(-1, 3)) for found in (cloud, mesh)]
print("points of cloud and of mesh:", read)
red = np.tile(np.array([[255, 0, 0]], np.uint8), (3, 1))[:, None]
cv2.savePointCloud(path := f"{sys.argv[1]}/colour.ply", np.array(POINTS, np.float32)[:, None], None, red)
text = open(path, encoding="ascii").read()
declared, written = "property uchar red" in text, text.splitlines()[-1].split()[3]
try:
    PlyData.read(path)
    refused = ""
except (PlyParseError, OverflowError, ValueError) as error:
    refused = str(error)
back = cv2.loadPointCloud(path)[2].reshape(-1, 3)[0] * 255
print(f"red 255 is written as {written} in a uchar: {declared}; plyfile: {refused!r}; OpenCV reads {back}")
sys.exit(
    read["f4"] != [3, 3]
    or read["f8"] != [None, None]
    or not declared
    or written != "65025"
    or not refused
    or round(float(back[0])) != 1
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q opencv-contrib-python-headless==5.0.0.93 plyfile==1.1.5 numpy==2.4.6
"$work/env/bin/python" "$work/try.py" "$work"
