#!/bin/sh
# Guess: RealSense's decimation filter changes the intrinsics so that a point of the smaller depth image lies where the
#        points of the large one lay.
# Found: it divides the principal point by the magnitude, as if pixels were counted from their edges, while deprojection
#        counts from their centres. Points move to the left and up by (magnitude - 1) / 2 pixels of the large image: at
#        2 m and f 600 by 1.7 mm with magnitude 2, the default, by 5 mm with 4 and by 11.7 mm with 8. rs.pointcloud and
#        rs2_deproject_pixel_to_point go by the same numbers. The stream says fx 75 and ppx 39.94 in place of 39.5.
# Seen:  pyrealsense2 2.59.1.11053, Python 3.11, Linux x86-64, with a software device.
# Who:   users who decimate depth before they make points, as the SDK's examples do, and compare or fuse them with a
#        full image, a colour image or another camera: a shift that looks like a poor calibration.
# What to do: use (ppx + 0.5) / magnitude - 0.5 of the large image, for y as well.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/try.py" <<'PY'
import ctypes
import sys

import libusb_package
import numpy as np

ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)  # which RealSense's wheel lacks
import pyrealsense2 as rs

WIDTH, HEIGHT, F, CX, CY = 640, 480, 600.0, 319.5, 239.5

lens = rs.intrinsics()
lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = WIDTH, HEIGHT, F, F, CX, CY
video = rs.video_stream()
video.type, video.uid, video.fmt = rs.stream.depth, 1, rs.format.z16
video.width, video.height, video.fps, video.bpp, video.intrinsics = WIDTH, HEIGHT, 30, 2, lens
sensor = rs.software_device().add_sensor("Depth")
profile = sensor.add_video_stream(video)
sensor.add_read_only_option(rs.option.depth_units, 0.001)
queue = rs.frame_queue(2)
sensor.open(profile)
sensor.start(queue)

depth_mm = np.full((HEIGHT, WIDTH), 3000, np.uint16)  # a wall, and before it a box that all magnitudes cut at its edges
depth_mm[120:216, 384:480] = 2000
frame = rs.software_video_frame()
frame.pixels, frame.stride, frame.bpp = depth_mm, 2 * WIDTH, 2
frame.timestamp, frame.domain, frame.frame_number = 1000.0, rs.timestamp_domain.hardware_clock, 1
frame.profile = profile.as_video_stream_profile()
sensor.on_video_frame(frame)
large = queue.wait_for_frame()


def middle_mm(depth):
    """Middle (x, y) of the box, by the SDK's own points."""
    points = np.asarray(rs.pointcloud().calculate(depth).get_vertices()).view(np.float32).reshape(-1, 3)
    return 1000 * points[abs(points[:, 2] - 2) < 0.1, :2].mean(axis=0)


true_mm = np.array([(431.5 - CX) / F, (167.5 - CY) / F]) * 2000
print(f"the box's middle: {true_mm.round(2)} mm, by the large image {middle_mm(large).round(2)}")
off = [abs(middle_mm(large) - true_mm).max()]
for magnitude in (2, 4, 8):
    decimate = rs.decimation_filter()
    decimate.set_option(rs.option.filter_magnitude, magnitude)
    small = decimate.process(large)
    said = small.profile.as_video_stream_profile().intrinsics
    moved_mm = middle_mm(small) - true_mm
    expected_mm = -(magnitude - 1) / 2 / F * 2000
    print(f"magnitude {magnitude}: fx {said.fx:g}, ppx {said.ppx:.4f}; the middle moved by {moved_mm.round(2)} mm")
    off.append(abs(moved_mm - expected_mm).max())
sys.exit(bool(max(off) > 0.05))
PY
python3 -m venv "$work/env"
"$work/env/bin/pip" install -q pyrealsense2==2.59.1.11053 numpy==2.4.6 libusb-package==1.0.30.0
"$work/env/bin/python" "$work/try.py"
