"""Measure what a step costs as one setting grows: classes, voxel size, source views, samples, rays, size of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from research.bench.walk import WARM_UP, timed_step, wide_camera
from research.scenes import TEST_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.config import MapperConfig, convert_config, to_plain, with_quality
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.types import Float32, PosedFrame

CLASSES = (10, 20, 40)
VOXELS_CM = (5, 2, 1)
SOURCE_VIEWS = (2, 4, 8)
SAMPLES = (2, 4, 8)  # a ray, near the depth prior
SHARES = (0.1, 0.3, 1.0)  # of the rays
COPIES = (0, 4, 16)  # of the room, beside it
STEP_M = 0.2  # of way between frames
APART_M = 20.0  # from one copy of the room to the next
PAGED_MB = 300  # voxel_map.memory_mb of the growing map, unless the config says another


def bench_growth(
    weights: Path | None,
    config: MapperConfig,
    frames: int = 12,
    width: int = 160,
    on_run: Callable[[int], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Step through the same frames of a test room, each time with one setting changed.

    The runs of a setting go through the frames together, in turns, so that what else the machine does meanwhile slows
    all of them alike. With other numbers of classes the field has random weights: it takes the time of trained ones.

    Args:
        weights: None = those that ship with the package.
        config: Of the mapper; what each run does not change.
        frames: That count, in each run.
        width: Of the images, 4 : 3.
        on_run: Called with how many runs are done.

    Returns:
        One dict a run: ``axis`` and ``value`` (what was changed), medians ``step_ms``, ``cpu_ms`` (processor time of
        the step), ``render_ms``, ``fuse_ms``, means ``rays`` and ``views`` (source views in use, with the frame itself:
        of those that are allowed, as many as see it), and ``blocks`` of the map at the end. The value of axis "blocks"
        is how many the map held before, most of them on disk.
    """
    count = WARM_UP + max(SOURCE_VIEWS) + frames  # those that count have as many source views as are allowed
    posed = list(room_frames(TEST_SEEDS[0], count, wide_camera(width), path=CameraPathConfig(step_m=STEP_M)))
    found: list[dict[str, Any]] = []
    for axis, values in AXES.items():
        pipelines = [_pipeline(weights, config, axis, value) for value in values]
        if axis == "blocks":
            values = [_fill(pipeline, posed, int(value)) for pipeline, value in zip(pipelines, values, strict=True)]
        for value, figures in zip(values, _measure(pipelines, posed, frames), strict=True):
            found.append({"axis": axis, "value": value, **figures})
            on_run(len(found))
    return found


AXES: dict[str, Sequence[float]] = {
    "classes": CLASSES,
    "voxel_cm": VOXELS_CM,
    "views": SOURCE_VIEWS,
    "samples": SAMPLES,
    "ray_share": SHARES,
    "blocks": COPIES,
}


def _pipeline(weights: Path | None, config: MapperConfig, axis: str, value: float) -> MappingPipeline:
    plain = to_plain(with_quality(config))
    plain["quality"] = "custom"
    if axis == "voxel_cm":
        plain["voxel_map"]["voxel_size_m"] = value / 100
    elif axis == "views":
        plain["keyframes"]["source_views"] = value
    elif axis == "samples":
        plain["sampling"] |= {"guided": value, "free_space": 0}
    elif axis == "ray_share":
        plain["render"]["ray_fraction"] = value
    elif axis == "blocks":
        plain["voxel_map"]["memory_mb"] = plain["voxel_map"]["memory_mb"] or PAGED_MB
    bundle = Mapper.load(weights, convert_config(plain, MapperConfig, f"bench growth, {axis} {value:g}"))
    model = bundle.checkpoint.model
    if axis != "classes" or not isinstance(model, SRay):
        return bundle.pipeline
    labels = make_label_set("bench", [f"class {c}" for c in range(int(value))])
    torch.manual_seed(0)
    settings = bundle.pipeline.config
    return MappingPipeline(settings, make_field(SRay(model.config, labels).eval(), settings), labels)


def _fill(pipeline: MappingPipeline, posed: Sequence[PosedFrame], copies: int) -> int:
    """Fuse the room beside itself so often, with votes; returns how many blocks that makes."""
    classes = len(pipeline.label_set)
    votes: Float32 = np.full((1, classes), 1 / classes, np.float32)
    for copy in range(1, copies + 1):
        for frame in posed:
            assert frame.depth_m is not None
            T_world_camera = frame.T_world_camera.copy()
            T_world_camera[0, 3] += copy * APART_M
            moved = replace(frame, T_world_camera=T_world_camera)
            pipeline.voxel_map.integrate(moved, frame.depth_m, votes, rows=np.zeros(frame.depth_m.shape, np.int32))
    return pipeline.voxel_map.block_count


def _measure(pipelines: Sequence[MappingPipeline], posed: Sequence[PosedFrame], frames: int) -> list[dict[str, Any]]:
    """Figures of each pipeline over the last ``frames``, stepped in turns."""
    rows = [[_timed_step(pipeline, frame) for pipeline in pipelines] for frame in posed]
    counted = np.array(rows[-frames:])  # (frames, pipelines, figures)
    times, means = np.median(counted[:, :, :4], axis=0), counted[:, :, 4:].mean(axis=0)
    return [
        {
            **{name: round(float(ms), 2) for name, ms in zip(_TIMES, of_times, strict=True)},
            "rays": round(float(rays)),
            "views": round(float(views), 1),
            "blocks": pipeline.voxel_map.block_count,
        }
        for pipeline, of_times, (rays, views) in zip(pipelines, times, means, strict=True)
    ]


_TIMES = ("step_ms", "cpu_ms", "render_ms", "fuse_ms")


def _timed_step(pipeline: MappingPipeline, frame: PosedFrame) -> tuple[float, ...]:
    """As ``_TIMES``, and rays and source views."""
    update, step_ms, cpu_ms = timed_step(pipeline, frame)
    stages = update.stage_ms
    views = len(update.source_seqs) + pipeline.config.keyframes.use_current_view
    return step_ms, cpu_ms, stages["render"], stages["fuse"], update.rays, views
