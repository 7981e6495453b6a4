"""RGB-D odometry over a log without its poses: how far its path is from the true one, what it takes, both as a picture.

Example: python -m research.experiments.odometry kitchen.mcap --picture odometry.png --write kitchen-odometry.mcap
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from research.evaluation.trajectory import absolute_trajectory_error, align_rigid, relative_pose_error
from research.plots import draw_paths
from semantic_mapper.config import convert_config, read_toml
from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.geometry import invert_pose
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.types import Float64, PosedFrame


@dataclass(slots=True)
class Run:
    """What the odometry made of a log; rows of NaN where it was lost. ``estimated``: after all corrections.

    Of several worlds the one with the most poses counts, and begins at the true pose of its first frame.
    """

    estimated: list[Float64] = field(default_factory=list)
    as_they_came: list[Float64] = field(default_factory=list)
    given: list[Float64] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    clock_ms: list[float] = field(default_factory=list)
    processor_ms: list[float] = field(default_factory=list)
    corrections: int = 0
    counters: dict[str, int] = field(default_factory=dict)


def follow(frames: Sequence[PosedFrame], config: OdometryPoses) -> Run:
    """Run the odometry."""
    run, better, worlds = Run(), dict[int, Float64](), list[int]()
    with OdometryPoseSource(config) as odometry:
        for frame in frames:
            image = CameraImage(frame.stamp_ns, frame.seq, frame.camera_id, frame.rgb, frame.depth_m, frame.intrinsics)
            clock, processor = time.perf_counter(), time.process_time()
            estimate = odometry.pose(image)
            corrected = odometry.correction()
            run.processor_ms.append((time.process_time() - processor) * 1e3)
            run.clock_ms.append((time.perf_counter() - clock) * 1e3)
            run.given.append(frame.T_world_camera)
            run.as_they_came.append(np.full((4, 4), np.nan) if estimate is None else estimate.T_world_camera)
            run.sigma_m.append(0.0 if estimate is None else estimate.sigma)
            worlds.append(-1 if estimate is None else estimate.world)
            better |= {} if corrected is None else corrected.poses
            run.corrections += corrected is not None
        corrected = odometry.correction(final=True)
        better |= {} if corrected is None else corrected.poses
    chosen = max(worlds, key=lambda world: (world >= 0, worlds.count(world)))
    first = worlds.index(chosen)
    T_truth_world = run.given[first] @ invert_pose(run.as_they_came[first])
    for k, (frame, world) in enumerate(zip(frames, worlds, strict=True)):
        came = run.as_they_came[k] if world == chosen else np.full((4, 4), np.nan)
        run.as_they_came[k] = T_truth_world @ came
        run.estimated.append(T_truth_world @ (better.get(frame.stamp_ns, came) if world == chosen else came))
    run.counters = dict(odometry.counters)
    return run


def report(run: Run) -> dict[str, Any]:
    """Figures of a run; errors in metres and degrees, over the frames that have a pose."""
    estimated, given = np.array(run.estimated), np.array(run.given)
    known = np.isfinite(estimated[:, 0, 0])
    e, g = estimated[known], given[known]
    path = float(np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=1).sum())
    came = np.array(run.as_they_came)[known]
    at_end = float(np.linalg.norm(e[-1, :3, 3] - g[-1, :3, 3]))
    sigma = np.array(run.sigma_m)[known]
    off = np.linalg.norm(e[:, :3, 3] - g[:, :3, 3], axis=1)
    absolute = absolute_trajectory_error(e, g)._asdict()
    return {
        "frames": len(given),
        "path_m": path,
        **run.counters,
        "ate_m": {name: value for name, value in absolute.items() if name != "rmse_deg"},  # of positions alone
        "ate_as_they_came_m": absolute_trajectory_error(came, g).rmse_m,
        "corrections": run.corrections,
        "end_without_alignment_m": at_end,
        "off_by_at_most_3_sigma_share": float((off[1:] <= 3 * sigma[1:]).mean()),
        "rpe_frame": relative_pose_error(e, g, 1)._asdict(),
        "rpe_20_frames": relative_pose_error(e, g, 20)._asdict() if len(e) > 20 else None,
        "clock_ms": {"p50": float(np.median(run.clock_ms)), "p95": float(np.percentile(run.clock_ms, 95))},
        "processor_ms": {"p50": float(np.median(run.processor_ms)), "p95": float(np.percentile(run.processor_ms, 95))},
    }


def picture(run: Run, title: str, path: Path) -> None:
    """Both paths from above, the estimated one aligned."""
    estimated, given = np.array(run.estimated), np.array(run.given)
    known = np.isfinite(estimated[:, 0, 0])
    T = align_rigid(estimated[known, :3, 3], given[known, :3, 3])
    moved = estimated[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    up = -given[:, :3, 1].mean(axis=0)  # a camera is held upright, more or less
    write_picture(path, draw_paths(title, {"given poses": given[:, :3, 3], "odometry, aligned": moved}, up))


def main() -> None:
    """Run it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--config", type=Path, help="TOML with settings of the odometry (drivers/poses/config.py)")
    parser.add_argument("--max-frames", type=int, default=0, help="0 = all")
    parser.add_argument("--every", type=int, default=1, help="use every n frames")
    parser.add_argument("--picture", type=Path, help="PNG with both paths from above")
    parser.add_argument("--write", type=Path, help="log with the odometry's poses, to be mapped like any other")
    parser.add_argument("--json", type=Path, help="the figures, for programs")
    given = parser.parse_args()
    settings = {} if given.config is None else read_toml(given.config)
    config = convert_config(settings, OdometryPoses, str(given.config))
    with LogReader(given.log) as log:
        frames = list(log)[:: given.every][: given.max_frames or None]
        run = follow(frames, config)
        if given.write is not None:
            with LogWriter(given.write, log.info, overwrite=True) as writer:
                for frame, pose, sigma in zip(frames, run.estimated, run.sigma_m, strict=True):
                    if np.isfinite(pose).all():
                        changes = {"T_world_camera": pose, "pose_source": "odometry", "pose_sigma": sigma}
                        writer.write_frame(replace(frame, **changes))
    figures = report(run)
    print(json.dumps(figures, indent=1))
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    if given.picture is not None:
        ate_cm = 100 * figures["ate_m"]["rmse_m"]
        title = f"{given.log.name}: {figures['path_m']:.1f} m, ATE {ate_cm:.1f} cm (RMSE)"
        picture(run, title, given.picture)


if __name__ == "__main__":
    main()
