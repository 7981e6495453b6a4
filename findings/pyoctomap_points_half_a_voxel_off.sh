#!/bin/sh
# Guess: extractPointCloud() of pyoctomap gives the centres of the occupied and of the free voxels.
# Found: the point of a leaf of the finest level lies at the voxel's upper corner: half a voxel off along x, y and z, 87
#        mm in all for voxels of 10 cm. Leaves that were merged are divided into points at the right centres, so that
#        one cloud has both kinds. getCoordinate() of the leaves is right. ColorOcTree has the same shift.
# Seen:  pyoctomap 1.2.2, Python 3.11, Linux x86-64.
# Who:   users who score or fuse an OctoMap by its points: a map is half a voxel from where it was measured.
# What to do: take the leaves' getCoordinate().
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import numpy as np
import pyoctomap

VOXEL_M = 0.1
WALL = np.array([[20.5, y + 0.5, z + 0.5] for y in range(-9, 9, 3) for z in range(-6, 6, 3)]) * VOXEL_M  # at centres
BLOCK = np.array([[x + 0.5, y + 0.5, z + 0.5] for x in range(2) for y in range(2) for z in range(2)]) * VOXEL_M


def offset_m(found, expected):
    """The one shift, if there is one, by which the found points are off."""
    nearest = [found[i] - expected[np.argmin(np.linalg.norm(expected - found[i], axis=1))] for i in range(len(found))]
    assert np.ptp(nearest, axis=0).max() < 1e-6, "more than one shift"
    return np.round(nearest[0], 6)


wrong = False
for kind in (pyoctomap.OcTree, pyoctomap.ColorOcTree):
    seen = kind(VOXEL_M)
    for point in WALL:
        seen.updateNode(point, True)
    leaves = np.array([leaf.getCoordinate() for leaf in seen.begin_leafs()])
    merged = kind(VOXEL_M)
    for point in BLOCK:
        for _ in range(20):  # until all have the same, greatest occupancy
            merged.updateNode(point, True)
    of_leaves, of_points = offset_m(leaves, WALL), offset_m(seen.extractPointCloud()[0], WALL)
    of_merged = offset_m(merged.extractPointCloud()[0], BLOCK)
    print(f"{kind.__name__}: leaves {of_leaves}, points {of_points}, points of a merged leaf {of_merged} m off")
    wrong |= bool(of_leaves.any() or of_merged.any() or not np.allclose(of_points, VOXEL_M / 2))
sys.exit(wrong)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q pyoctomap==1.2.2 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
