"""Measure the surface of a map whose frames lose their depth after the first few."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from research.evaluation.room_map import NEAR_M, true_surface
from research.scenes import VALIDATION_SEEDS, CameraPathConfig, NoiseConfig, make_room, room_frames
from research.suites.config import MAP_WIDTH, SequenceConfig, camera_of_width
from semantic_mapper.config import MapperConfig, with_quality
from semantic_mapper.mapper import Mapper


def bench_depthless(weights: Path | None, config: MapperConfig, frames: int = 24) -> list[dict[str, Any]]:
    """Map a validation room with depth in all frames, in the first quarter of them, and in none.

    Returns:
        A row each: frames with depth, points, median distance of these to the true surface in metres, fraction of them
        within 5 cm of it (``precise``), and fraction of the surface within 5 cm of a point (``complete``).
    """
    seed = VALIDATION_SEEDS[0]
    path = CameraPathConfig(step_m=SequenceConfig().step_m)
    posed = list(room_frames(seed, frames, camera_of_width(MAP_WIDTH), path=path, noise=NoiseConfig()))
    surface = true_surface(make_room(seed), [f.T_world_camera for f in posed]).xyz
    rows: list[dict[str, Any]] = []
    for measured in (frames, frames // 4, 0):
        pipeline = Mapper.load(weights, with_quality(config)).pipeline
        for number, frame in enumerate(posed):
            pipeline.step(replace(frame, label=None, depth_m=frame.depth_m if number < measured else None))
        xyz = pipeline.voxel_map.points().xyz
        row: dict[str, Any] = {"with_depth": measured, "points": len(xyz)}
        if len(xyz):
            off, near = cKDTree(surface).query(xyz)[0], cKDTree(xyz).query(surface)[0]
            row |= {"median_m": round(float(np.median(off)), 4), "precise": round(float((off < NEAR_M).mean()), 3)}
            row |= {"complete": round(float((near < NEAR_M).mean()), 3)}
        rows.append(row)
    return rows
