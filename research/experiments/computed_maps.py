"""Maps from computed depth in rooms, with poses that are exact or off, as given and refined, against the true surface.

Example: python -m research.experiments.computed_maps --rooms 4
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from research.experiments.motion_depth import ROOM_FOCAL, ROOM_WIDTH
from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig
from research.scenes.sequence import room_views
from semantic_mapper.config import DepthConfig, VoxelMapConfig, convert_config
from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.frame_depth import FrameDepth, computed_trust
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

DELAY_FRAMES = 6  # as ``replay`` has it
EVERY_TRUTH, EVERY_POINT = 3, 5  # frames, and pixels of them, that the true surface is made from


class PoseErrors(NamedTuple):
    """How given poses are off: metres and degrees (one sigma, each pose by itself; or added from frame to frame)."""

    each_m: float = 0.0
    each_deg: float = 0.0
    drift_m: float = 0.0
    drift_deg: float = 0.0


ERRORS = {
    "exact": PoseErrors(),
    "1 cm, 0.3 degrees, each": PoseErrors(0.01, 0.3),
    "2 cm, 0.5 degrees, each": PoseErrors(0.02, 0.5),
    "drift of 5 mm, 0.1 degrees a frame": PoseErrors(0, 0, 0.005, 0.1),
}


class Step(NamedTuple):
    """A frame without depth at the pose that is given, its exact depth (H, W), and where it truly is (4, 4)."""

    frame: PosedFrame
    depth_m: Float32
    T_world_camera: Float64


def room_walk(seed: int, count: int, errors: PoseErrors) -> list[Step]:
    """Pictures with the noise of a camera, 5 cm apart."""
    height, focal = ROOM_WIDTH * 3 // 4, ROOM_FOCAL * ROOM_WIDTH
    camera = CameraIntrinsics(focal, focal, (ROOM_WIDTH - 1) / 2, (height - 1) / 2, ROOM_WIDTH, height)
    noise = NoiseConfig(depth="none")
    rng, drift, steps = np.random.default_rng(seed), np.eye(4), list[Step]()
    for view in room_views(seed, count, camera, path=CameraPathConfig(step_m=0.05), noise=noise):
        drift = _change(rng, errors.drift_m, errors.drift_deg) @ drift
        T = drift @ view.frame.T_world_camera
        each = _change(rng, errors.each_m, errors.each_deg)
        T[:3, :3], T[:3, 3] = each[:3, :3] @ T[:3, :3], T[:3, 3] + each[:3, 3]
        frame = replace(view.frame, T_world_camera=T, depth_m=None)
        steps.append(Step(frame, view.rendered.exact_depth_m, view.frame.T_world_camera))
    return steps


def _change(rng: np.random.Generator, metres: float, degrees: float) -> Float64:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians(degrees) / np.sqrt(3) * rng.standard_normal(3))[0]
    T[:3, 3] = metres / np.sqrt(3) * rng.standard_normal(3)
    return T


def measure(steps: list[Step], config: DepthConfig) -> dict[str, float]:
    """Error of depth and poses, and of the map against the true surface."""
    computer, done = FrameDepth(config, lambda frame, k: _nothing(k)), list[PosedFrame]()
    for step in steps:
        try:
            done += computer.push(step.frame)
        except FrameError:  # a picture that would spoil the map
            continue
    done += computer.finish()
    truth = {step.frame.seq: step for step in steps}
    voxel_map, off, away = VoxelMap(VoxelMapConfig(), ROOMS), list[float](), list[float]()
    for frame in done:
        assert frame.depth_m is not None and frame.depth_sigma_m is not None
        true, known = truth[frame.seq], frame.depth_m > 0
        if known.any():
            off.append(float(np.mean(np.abs(frame.depth_m - true.depth_m)[known] / true.depth_m[known])))
        away.append(float(np.linalg.norm(frame.T_world_camera[:3, 3] - true.T_world_camera[:3, 3])))
        trust = computed_trust(frame.depth_m, frame.depth_sigma_m)
        voxel_map.integrate(frame, frame.depth_m, None, trust=trust, measured=False)
    found = {"abs_rel": float(np.mean(off)), "pose_mm": float(np.mean(away)) * 1e3}
    surface = true_surface([(s.depth_m, s.frame.intrinsics, s.T_world_camera) for s in steps[::EVERY_TRUTH]])
    return found | distances(voxel_map.points().xyz, surface)


def distances(points: Float32, surface: Float64) -> dict[str, float]:
    """How far the points (N, 3) of a map are from the true surface (M, 3), and what fraction of that one they show."""
    if not len(points):
        return {"median_mm": float("nan"), "points_within_5_cm": 0.0, "within_5_cm": 0.0, "within_10_cm": 0.0}
    off, seen = cKDTree(surface).query(points)[0], cKDTree(points).query(surface)[0]
    return {
        "median_mm": float(np.median(off)) * 1e3,
        "points_within_5_cm": float((off < 0.05).mean()),
        "within_5_cm": float((seen < 0.05).mean()),
        "within_10_cm": float((seen < 0.10).mean()),
    }


def _nothing(k: CameraIntrinsics) -> tuple[Float32, np.ndarray]:
    """No hint: the map is not asked."""
    return np.zeros((k.height, k.width), np.float32), np.zeros((k.height, k.width), bool)


def true_surface(views: Iterable[tuple[Float32, CameraIntrinsics, Float64]], every: int = EVERY_POINT) -> Float64:
    """Points (N, 3) of what was truly seen, from depths (H, W), cameras and poses (4, 4); of each ``every``-th."""
    return np.concatenate([transform(T, unproject(depth, k)[depth > 0])[::every] for depth, k, T in views])


def main() -> None:
    """Run it, and print the figures: means over rooms."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=4, help="test rooms")
    parser.add_argument("--frames", type=int, default=60, help="of each, 5 cm apart")
    parser.add_argument("--delay", type=int, default=DELAY_FRAMES, help="later frames that a frame waits for")
    parser.add_argument("--json", type=Path, help="the figures, for programs")
    given = parser.parse_args()
    torch.set_num_threads(1)
    figures: dict[str, dict[str, float]] = {}
    for name, errors in ERRORS.items():
        walks = [room_walk(seed, given.frames, errors) for seed in TEST_SEEDS[: given.rooms]]
        for refined in (False, True):
            data = {"refine_poses": refined, "from_motion": {"delay_frames": given.delay}}
            config = convert_config(data, DepthConfig, "settings")
            rows = [measure(walk, config) for walk in walks]
            row = {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
            what = f"{name}; {'refined' if refined else 'as given'}"
            figures[what] = row
            print(f"{what}: {json.dumps({k: round(v, 3) for k, v in row.items()})}")
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
