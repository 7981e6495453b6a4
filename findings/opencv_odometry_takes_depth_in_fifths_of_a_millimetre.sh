#!/bin/sh
# Guess: Odometry of OpenCV 5 takes a depth image of 16 bits in millimetres, as depthTo3d, registerDepth and
#        rescaleDepth of the same module do; or it has a setting for the unit.
# Found: it divides by 5,000, the unit of TUM's recordings. A camera that moves 30 mm to the right and 50 mm ahead is
#        said to have moved 6 and 10 mm; rotations are right, compute() says true. OdometrySettings has no unit to set.
#        The same depth in float metres gives 30 and 50 mm with RGB_DEPTH, 30 and 37 mm with DEPTH alone.
# Seen:  opencv-contrib-python-headless 5.0.0.93, Python 3.11, Linux x86-64; types DEPTH and RGB_DEPTH.
# Who:   users who hand it the images of a Kinect, RealSense or OAK as they are: a trajectory five times too short.
# What to do: hand it rescaleDepth's float metres.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import sys

import cv2
import numpy as np

K = np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1]], np.float32)
v, u = np.mgrid[:240, :320].astype(np.float32)
RAYS = np.stack([(u - 160) / 300, (v - 120) / 300, np.ones_like(u)], -1)


def look(R, t):
    """Depth in metres and a picture of a corner of a room: floor, wall ahead, wall to the left."""
    rays = RAYS @ R.T
    with np.errstate(divide="ignore"):
        walls = np.stack([(1.0 - t[1]) / rays[..., 1], (4.0 - t[2]) / rays[..., 2], (-1.5 - t[0]) / rays[..., 0]])
    depth = np.where(walls > 0, walls, np.inf).min(0)
    at = t + rays * depth[..., None]
    picture = 127 + 60 * np.sin(9 * at[..., 0]) + 60 * np.sin(11 * at[..., 1] + 7 * at[..., 2])
    return depth.astype(np.float32), picture.clip(0, 255).astype(np.uint8)


c, s = np.cos(0.02), np.sin(0.02)
R, t = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array([0.03, 0, 0.05])
before, after = look(np.eye(3), np.zeros(3)), look(R, t)


def moved_mm(kind, as_depth):
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(K)
    odometry = cv2.Odometry(kind, settings, cv2.OdometryAlgoType_COMMON)
    frames = [cv2.OdometryFrame(as_depth(depth), picture) for depth, picture in (before, after)]
    odometry.prepareFrames(*frames)
    found, Rt = odometry.compute(*frames)  # to the later camera from the earlier one
    assert found
    turned = np.degrees(np.linalg.norm(cv2.Rodrigues(Rt[:3, :3])[0]))
    return np.linalg.inv(Rt)[:3, 3] * 1000, turned


def millimetres(depth_m):
    return np.round(depth_m * 1000).astype(np.uint16)


print(
    "true:",
    t * 1000,
    f"mm, {np.degrees(0.02):.3f} deg; wall by depthTo3d {cv2.depthTo3d(millimetres(before[0]), K)[100, 200, 2]:.3f} m",
)
found = {}
for name in ("DEPTH", "RGB_DEPTH"):
    for unit, as_depth in (("float metres", lambda depth: depth), ("16 bits, mm", millimetres)):
        found[name, unit], turned = moved_mm(getattr(cv2, f"OdometryType_{name}"), as_depth)
        print(f"{name}, {unit}: {np.round(found[name, unit], 1)} mm, {turned:.3f} degrees")
units = [method for method in dir(cv2.OdometrySettings) if "factor" in method.lower() or "unit" in method.lower()]
sideways = {key: moved[0] for key, moved in found.items()}
sys.exit(
    bool(units)
    or any(abs(sideways[name, "float metres"] - 30) > 1.5 for name in ("DEPTH", "RGB_DEPTH"))
    or abs(found["RGB_DEPTH", "float metres"][2] - 50) > 2
    or any(abs(sideways[name, "16 bits, mm"] - 6) > 0.3 for name in ("DEPTH", "RGB_DEPTH"))
)
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q opencv-contrib-python-headless==5.0.0.93 numpy==2.4.6
"$work/env/bin/python" "$work/try.py"
