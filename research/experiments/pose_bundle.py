"""Poses against pictures: how far given poses are off in the pictures, before and after the bundle; visual odometry.

Examples:
    python -m research.experiments.pose_bundle refine --log kitchen.mcap --rooms 2
    python -m research.experiments.pose_bundle visual --log kitchen.mcap --rooms 5
    python -m research.experiments.pose_bundle height --rooms 5
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from research.evaluation.trajectory import absolute_trajectory_error
from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig, room_frames
from research.scenes.config import PoseNoiseConfig
from research.scenes.pose_noise import drifting_poses
from semantic_mapper.bundle.refiner import PoseRefiner
from semantic_mapper.bundle.tracks import follow
from semantic_mapper.config import PoseRefinerConfig, convert_config
from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import VisualPoses
from semantic_mapper.drivers.poses.visual import VisualPoseSource
from semantic_mapper.geometry import invert_pose, project, transform, unproject
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

CAMERA = CameraIntrinsics(220.6, 220.6, 159.5, 119.5, 320, 240)
WALK = CameraPathConfig(step_m=0.05)
HEIGHT_M = 1.2  # of the camera that is carried at one height
NOISE = NoiseConfig(depth="exact")  # pictures as a camera takes them; depth only judges the poses
WHEELS = PoseNoiseConfig(translation_share=0.02, rotation_deg_per_m=0.5, closure_frames=0)
DISTURBED_M, DISTURBED_DEG = 0.02, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A recording: frames with depth, and where they truly are (as far as is known)."""

    name: str
    frames: Sequence[PosedFrame]
    truth: Float64

    @property
    def path_m(self) -> float:
        """Length of the way."""
        return float(np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1).sum())


def room_walk(seed: int, count: int, path: CameraPathConfig = WALK) -> Walk:
    """Frames through a room."""
    frames = list(room_frames(seed, count, CAMERA, path=path, noise=NOISE))
    return Walk(f"room {seed}", frames, np.array([f.T_world_camera for f in frames]))


def log_walk(path: Path, count: int) -> Walk:
    """Frames of a log, with its poses for true ones."""
    with LogReader(path) as log:
        frames = [frame for frame, _ in zip(log, range(count), strict=False)]
    return Walk(path.stem, frames, np.array([f.T_world_camera for f in frames]))


def disturb(walk: Walk, seed: int = 0) -> Walk:
    """The walk with each pose off by 2 cm and half a degree, on its own."""
    rng = np.random.default_rng(seed)
    frames: list[PosedFrame] = []
    for frame in walk.frames:
        T = frame.T_world_camera.copy()
        axis, shift = rng.standard_normal((2, 3))
        T[:3, :3] = cv2.Rodrigues(np.radians(DISTURBED_DEG) / np.sqrt(3) * axis)[0] @ T[:3, :3]
        T[:3, 3] += DISTURBED_M / np.sqrt(3) * shift
        frames.append(replace(frame, T_world_camera=T, pose_sigma=DISTURBED_M))
    return Walk(walk.name, frames, walk.truth)


def flow_error_px(frames: Sequence[PosedFrame], poses: Float64, gap: int, every: int) -> float:
    """Median over frames of the median distance between where corners move and where depth and poses take them.

    In pixels of an image 640 wide, ``gap`` frames apart.
    """
    medians: list[float] = []
    for i in range(0, len(frames) - gap, every):
        a, b = frames[i], frames[i + gap]
        assert a.depth_m is not None
        grays = [cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY) for f in (a, b)]
        corners = cv2.goodFeaturesToTrack(grays[0], 400, 0.01, 8)
        if corners is None:
            continue
        pixels = np.asarray(corners, np.float64)[:, 0]
        nearest = np.rint(pixels).astype(int)
        points = unproject(a.depth_m, a.intrinsics)[nearest[:, 1], nearest[:, 0]]
        seen = points[:, 2] > 0
        there = transform(invert_pose(poses[i + gap]) @ poses[i], points)
        seen &= there[:, 2] > 0.1
        expected = project(there[seen], b.intrinsics)
        found, good = follow(np.asarray(grays[0], np.uint8), np.asarray(grays[1], np.uint8), pixels[seen], expected)
        if good.sum() >= 20:
            medians.append(float(np.median(np.linalg.norm(found - expected, axis=1)[good])))
    return float(np.median(medians)) * 640 / frames[0].intrinsics.width


def refine(walk: Walk, config: PoseRefinerConfig) -> dict[str, Any]:
    """Figures of given poses, of the refined ones as they come, and after their corrections."""
    refiner = PoseRefiner(walk.frames[0].intrinsics, config)
    live: list[Float64] = []
    final: dict[tuple[str, int], Float64] = {}
    processor_ms: list[float] = []
    refined = 0
    for frame in walk.frames:
        started = time.process_time()
        result = refiner.push(frame)
        processor_ms.append(1e3 * (time.process_time() - started))
        live.append(result.T_world_camera)
        refined += result.refined
        final[frame.camera_id, frame.stamp_ns] = result.T_world_camera
        final |= refiner.corrections()
    given = np.array([f.T_world_camera for f in walk.frames])
    every = max(1, len(live) // 30)
    rows: dict[str, Any] = {}
    paths = {"given": given, "as they come": np.array(live), "corrected": np.array([*final.values()])}
    if not np.array_equal(given, walk.truth):
        paths["true"] = walk.truth  # what is left is the error of following corners
    for name, poses in paths.items():
        rows[name] = {
            "flow_2_px": flow_error_px(walk.frames, poses, 2, every),
            "flow_5_px": flow_error_px(walk.frames, poses, 5, every),
            "ate_mm": 1e3 * absolute_trajectory_error(poses, walk.truth).rmse_m,
        }
    ms = {f"p{p}": float(np.percentile(processor_ms, p)) for p in (50, 95)}
    return {**rows, "refined": refined / len(live), "processor_ms": ms}


class ListedPoses(PoseSource):
    """A pose source that reads its poses from a list."""

    def __init__(self, poses: dict[int, Float64]) -> None:
        super().__init__()
        self._poses = poses

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Of its stamp."""
        T = self._poses.get(image.stamp_ns)
        return None if T is None else PoseEstimate(T, "listed")


def visual(walk: Walk, config: VisualPoses) -> dict[str, Any]:
    """Figures of visual odometry whose scale comes from drifting wheels, or (``config``) from the camera's height."""
    wheels = drifting_poses(walk.truth, 1, WHEELS)
    reference = ListedPoses({f.stamp_ns: T for f, T in zip(walk.frames, wheels, strict=True)})
    if config.camera_height_m:
        reference = None
    estimated: list[Float64] = []
    processor_ms: list[float] = []
    with VisualPoseSource(config, reference) as source:
        for f in walk.frames:
            started = time.process_time()
            found = source.pose(CameraImage(f.stamp_ns, f.seq, f.camera_id, f.rgb, None, f.intrinsics))
            processor_ms.append(1e3 * (time.process_time() - started))
            estimated.append(np.full((4, 4), np.nan) if found is None else found.T_world_camera)
    poses = np.array(estimated)
    known = np.isfinite(poses[:, 0, 0])
    error = absolute_trajectory_error(poses[known], walk.truth[known]).rmse_m if known.sum() > 3 else np.nan
    ways = (np.linalg.norm(np.diff(p[known, :3, 3], axis=0), axis=1).sum() for p in (poses, walk.truth))
    way, true_way = ways
    wheel_error = absolute_trajectory_error(wheels, walk.truth).rmse_m
    return {
        "frames": len(poses),
        "path_m": walk.path_m,
        "with_pose": float(known.mean()),
        "ate_m": error,
        "ate_percent_of_path": 100 * error / walk.path_m,
        "scale": float(way / max(true_way, 1e-9)),
        "wheels_percent_of_path": 100 * wheel_error / walk.path_m,
        "processor_ms": {f"p{p}": float(np.percentile(processor_ms, p)) for p in (50, 95)},
        "counters": {name: count for name, count in source.counters.items() if count},
    }


def main() -> None:
    """Run it, and print the figures as JSON, a line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("refine", "visual", "height"))
    parser.add_argument("--log", type=Path, action="append", default=[])
    parser.add_argument("--rooms", type=int, default=0, help="walks through this many rooms of the test split")
    parser.add_argument("--frames", type=int, default=200, help="of each recording, at most")
    given = parser.parse_args()
    if given.what == "height":
        level = CameraPathConfig(step_m=WALK.step_m, min_height_m=HEIGHT_M, max_height_m=HEIGHT_M)
        for seed in TEST_SEEDS[: given.rooms]:
            walk = room_walk(seed, given.frames, level)
            asked = {"camera_height_m": HEIGHT_M, "T_world_start": walk.truth[0].tolist()}
            figures = visual(walk, convert_config(asked, VisualPoses, "benchmark"))
            print(json.dumps({"recording": walk.name, **figures}), flush=True)
        return
    for path in given.log:
        walk = log_walk(path, given.frames)
        figures = refine(walk, PoseRefinerConfig()) if given.what == "refine" else visual(walk, VisualPoses())
        print(json.dumps({"recording": walk.name, **figures}), flush=True)
    for seed in TEST_SEEDS[: given.rooms]:
        walk = room_walk(seed, given.frames)
        figures = refine(disturb(walk), PoseRefinerConfig()) if given.what == "refine" else visual(walk, VisualPoses())
        print(json.dumps({"recording": walk.name, **figures}), flush=True)


if __name__ == "__main__":
    main()
