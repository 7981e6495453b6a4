#!/bin/sh
# Guess: trimesh scales colours of 16 bits, which LAS files hold, to its 8 bits, as it scales floats of 0 to 1; or
#        refuses.
# Found: it keeps the lower byte. LAS's 16 bits are the 8 of a picture times 256, so that every colour is black: orange
#        (65280, 32768, 16384) becomes (0, 0, 0); times 257, as other writers have it, 65535 happens to be right, and
#        128 * 256 + 10 becomes 10. The same in a mesh's vertex colours and in what is exported; no warning.
# Seen:  trimesh 5.2.0 with laspy 2.7.0, Python 3.11, Linux x86-64.
# Who:   users who show scans of LAS, which hold 16 bits, or write them to PLY.
# What to do: hand it (colours >> 8).astype(numpy.uint8).
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import io
import sys

import laspy
import numpy as np
import trimesh

PICTURE = np.array([[255, 128, 64], [10, 200, 30], [255, 255, 255]], np.uint8)


def scanned(colours):
    """A LAS file's points and colours, after writing and reading."""
    scan = laspy.create(point_format=3, file_version="1.2")
    scan.x, scan.y, scan.z = np.arange(len(colours)), np.zeros(len(colours)), np.zeros(len(colours))
    scan.red, scan.green, scan.blue = colours.T
    file = io.BytesIO()
    scan.write(file)
    file.seek(0)
    read = laspy.read(file)
    return read.xyz, np.column_stack((read.red, read.green, read.blue))


points, colours = scanned(PICTURE.astype(np.uint16) * 256)
assert colours.dtype == np.uint16
cloud = trimesh.PointCloud(points, colors=colours)
mesh = trimesh.Trimesh(points, [[0, 1, 2]], vertex_colors=colours, process=False)
exported = trimesh.load(io.BytesIO(cloud.export(file_type="ply")), file_type="ply").colors
of_floats = trimesh.PointCloud(points, colors=colours / 65280).colors
print("in the file:", *colours, "\ncloud:", *cloud.colors, "\nmesh:", *mesh.visual.vertex_colors)
print("exported:", *exported, "\nof floats:", *of_floats)
black = [0, 0, 0]
sys.exit(
    any((found[:, :3] != black).any() for found in (cloud.colors, mesh.visual.vertex_colors, exported))
    or (np.abs(of_floats[:, :3].astype(int) - PICTURE) > 1).any()
    or trimesh.visual.to_rgba(np.array([128 * 256 + 10, 65535, 0], np.uint16))[:3].tolist() != [10, 255, 0]
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q trimesh==5.2.0 laspy==2.7.0 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
