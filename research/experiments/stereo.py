"""Depth of the stereo driver in rendered rooms, against the truth.

python -m research.experiments.stereo --rooms 3 --views 4
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from research.scenes import TEST_SEEDS, camera_path, make_room, render_view
from semantic_mapper.drivers.stereo.calibration import StereoCalibration
from semantic_mapper.drivers.stereo.depth import StereoDepth
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

LEFT = CameraIntrinsics(330.0, 330.0, 239.5, 179.5, 480, 360)
RIGHT = CameraIntrinsics(334.0, 334.0, 242.0, 177.0, 480, 360)
BASELINE_M = 0.12
ASKEW_DEG = (0.6, -1.0, 0.4)  # the right camera is turned against the left one
NOISE = 1.5  # one sigma of a pixel's value
JPEG_QUALITY = 90
WRONG = 0.1  # relative error


def main() -> None:
    """Print one line a room, and the processor time of an image."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=3, help="rooms of the test set")
    parser.add_argument("--views", type=int, default=4, help="images of each")
    arguments = parser.parse_args()
    T_left_right = right_camera()
    stereo = StereoDepth(StereoCalibration(LEFT, RIGHT, invert_pose(T_left_right)), LEFT.width, 0.4, 8.0)
    rng = np.random.default_rng(5)
    spent_s: list[float] = []
    for seed in TEST_SEEDS[: arguments.rooms]:
        scene = make_room(seed)
        errors: list[Float64] = []
        covered, far = [], []
        for T in camera_path(scene, arguments.views, seed):
            pair = (render_view(scene, LEFT, T).rgb, render_view(scene, RIGHT, T @ T_left_right).rgb)
            left, right = stereo.rectify(*(as_a_webcam(rgb, rng) for rgb in pair))
            began = time.process_time()
            depth_m = stereo.depth(left, right)
            spent_s.append(time.process_time() - began)
            truth_m = render_view(scene, stereo.intrinsics, T @ stereo.T_left_rectified).exact_depth_m
            seen = (depth_m > 0) & (truth_m > 0)
            errors.append(depth_m[seen].astype(np.float64) / truth_m[seen] - 1)
            covered.append(float(seen.mean()))
            far.append(float(np.median(truth_m)))
        off = np.concatenate(errors)
        print(
            f"room {seed}: surfaces at {np.mean(far):.1f} m, depth at {100 * np.mean(covered):.0f} % of the pixels, "
            f"error {100 * np.median(np.abs(off)):.1f} % (bias {100 * np.median(off):+.1f} %), "
            f"{100 * float((np.abs(off) > WRONG).mean()):.1f} % off by more than {100 * WRONG:.0f} %"
        )
    print(f"{1000 * np.median(spent_s):.0f} ms of processor time an image, {stereo.disparities} disparities")


def right_camera() -> Float64:
    """``T_left_right`` (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians(ASKEW_DEG))[0]
    T[:3, 3] = (BASELINE_M, 0.002, -0.001)
    return T


def as_a_webcam(rgb: UInt8, rng: np.random.Generator) -> UInt8:
    """An image with noise, as JPEG."""
    noisy = np.clip(rgb + rng.normal(0, NOISE, rgb.shape), 0, 255).astype(np.uint8)
    file = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)


if __name__ == "__main__":
    main()
