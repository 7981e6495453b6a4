"""Write a drive through a generated street as KITTI-360 lays its drives out: pictures, labels, poses and laser scans.

Example: python -m research.experiments.street /tmp/street && semantic-mapper import /tmp/street street.mcap
"""

from __future__ import annotations

import argparse
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from research.scenes.config import NoiseConfig
from research.scenes.shots import sequence_shots
from research.scenes.streets.drive import (
    CAMERA_M,
    SCANNER_M,
    STEP_M,
    drive,
    make_street,
    render_street,
    scan_street,
)
from semantic_mapper.geometry import invert_pose
from semantic_mapper.replay.importers.kitti360 import LABELS
from semantic_mapper.types import CameraIntrinsics, Float64

DRIVE = "2013_05_28_drive_0000_sync"
FULL_WIDTH, FULL_HEIGHT, FULL_FOCAL, FULL_CENTRE = 1408, 376, 552.554261, (682.049453, 238.769549)
# Axes of the scanner (ahead, left, up) in those of the camera (right, down, ahead); where it stands beside it.
T_CAMERA_SCANNER = np.array(
    [
        [0.0, -1.0, 0.0, -SCANNER_M[1]],
        [0.0, 0.0, -1.0, CAMERA_M - SCANNER_M[2]],
        [1.0, 0.0, 0.0, SCANNER_M[0]],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def camera_of_width(width: int) -> CameraIntrinsics:
    """KITTI-360's left camera at another width; its picture is 1408x376."""
    s = width / FULL_WIDTH
    return CameraIntrinsics(
        FULL_FOCAL * s, FULL_FOCAL * s, FULL_CENTRE[0] * s, FULL_CENTRE[1] * s, width, round(FULL_HEIGHT * s)
    )


def write_drive(root: Path, frames: int, width: int, seed: int) -> None:
    """Write the drive of ``seed``: ``frames`` frames of the left camera, ``width`` pixels wide."""
    camera = camera_of_width(width)
    street = make_street(seed, frames * STEP_M, LABELS)
    poses = drive(street, frames)
    noise = NoiseConfig()
    shots = sequence_shots(poses, seed, noise)
    raw, semantics = root / "data_2d_raw" / DRIVE / "image_00", root / "data_2d_semantics/train" / DRIVE / "image_00"
    scans = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    for folder in (raw / "data_rect", semantics / "semantic", scans, root / "data_poses" / DRIVE, root / "calibration"):
        folder.mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(poses):
        view = render_street(street, camera, pose, shots[k], noise, k)
        cv2.imwrite(str(raw / "data_rect" / f"{k:010d}.png"), view.rgb[..., ::-1])
        cv2.imwrite(str(semantics / "semantic" / f"{k:010d}.png"), view.label)
        scan_street(street, pose @ T_CAMERA_SCANNER, k).tofile(scans / f"{k:010d}.bin")
    start = datetime(2013, 5, 28, 8, 46, 2, tzinfo=UTC)
    times = [f"{start + timedelta(seconds=k / 10):%Y-%m-%d %H:%M:%S.%f}000" for k in range(frames)]
    (raw / "timestamps.txt").write_text("\n".join(times) + "\n")
    rows = [f"{k} {_row(pose)}" for k, pose in enumerate(poses)]
    (root / "data_poses" / DRIVE / "cam0_to_world.txt").write_text("\n".join(rows) + "\n")
    P = (camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0)
    lines = ("R_rect_00: 1 0 0 0 1 0 0 0 1", f"P_rect_00: {' '.join(map(repr, P))}")
    size = f"S_rect_00: {camera.width} {camera.height}"
    (root / "calibration" / "perspective.txt").write_text("\n".join((*lines, size)) + "\n")
    (root / "calibration" / "calib_cam_to_velo.txt").write_text(_row(invert_pose(T_CAMERA_SCANNER)[:3]) + "\n")


def _row(matrix: Float64) -> str:
    return " ".join(repr(float(v)) for v in matrix.ravel())


def main() -> None:
    """Write one drive."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, help="folder to write to")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--width", type=int, default=704, help="of the pictures; 1408 is that of the data set")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    write_drive(args.root, args.frames, args.width, args.seed)


if __name__ == "__main__":
    main()
