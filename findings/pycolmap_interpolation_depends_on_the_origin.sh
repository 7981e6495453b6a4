#!/bin/sh
# Guess: pycolmap's interpolate_camera_poses gives, half way between two poses, a camera half way between their places.
# Found: it interpolates the translation of "camera from world", which is not the camera's place. A camera that turns by
#        60 degrees without moving leaves its place in between, by 13 % of its distance from the world's origin: 1.3 m
#        at 10 m, 134 m at 1 km. Moving the origin changes the path. Rigid3d.interpolate, the same way, of "world from
#        camera" is right.
# Seen:  pycolmap 4.2.1, Python 3.11, Linux x86-64.
# Who:   users who fill in poses between the pictures of a model, whose origin is as a rule far from each camera.
# What to do: interpolate the inverses.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import numpy as np
import pycolmap


def camera(place_m, turned_rad):
    """World from camera, turned about y."""
    return pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0, np.sin(turned_rad / 2), 0, np.cos(turned_rad / 2)])), np.array(place_m, float)
    )


wrong = False
for far_m in (0, 10, 1000):
    place = (far_m, 0, 0)
    first, last = camera(place, 0), camera(place, np.pi / 3)
    between = pycolmap.interpolate_camera_poses(first.inverse(), last.inverse(), 0.5).inverse()
    of_inverses = pycolmap.Rigid3d.interpolate(first, last, 0.5)
    off, right = (np.linalg.norm(pose.translation - place) for pose in (between, of_inverses))
    turned = np.degrees(between.rotation.angle())
    print(
        f"{far_m} m from the origin: {off:.3f} m off, turned by {turned:.1f} degrees; of the inverses {right:.3f} m off"
    )
    wrong |= abs(off - far_m * (1 - np.cos(np.pi / 6))) > 1e-6 or right > 1e-9 or abs(turned - 30) > 1e-6
sys.exit(bool(wrong))
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q pycolmap==4.2.1 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
