"""Measure mapping on this machine: fusion against Open3D's own, and whole steps of the pipeline, in one process."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb
from semantic_mapper.kernels.binding import thread_count
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.peers.comparison import WARM_UP, read_frames
from semantic_mapper.replay.peers.fusion import Open3DFusion, make_setup, some_votes
from semantic_mapper.types import PosedFrame

WIDTH, HEIGHT = 640, 480  # of the frames that are measured
CLASSES = (20, 40)


def bench_fusion(log: Path, frames: int = 20, voxel_size_m: float = 0.02, repeats: int = 5) -> dict[str, Any]:
    """Time our fusion with 20 and 40 classes against Open3D's ``integrate`` without any, frame by frame in turns, whose
    order changes; each repeat starts with empty maps.

    Both find their own blocks. Open3D fuses TSDF and colour; ours class evidence, too, of a quarter-size rendered view.
    Gives plain data: milliseconds a frame, medians of all; ``ratio_20`` and ``ratio_40``, ours over Open3D's, each the
    median of those of the repeats, the least and the largest.
    """
    posed = [_resized(frame) for frame in read_frames(log, frames + WARM_UP)[0]]
    config = VoxelMapConfig(voxel_size_m=voxel_size_m)
    votes = {count: some_votes(count, (HEIGHT, WIDTH)) for count in CLASSES}
    medians: list[dict[str, float]] = []
    sizes = {"blocks": 0, "open3d_blocks": 0}
    for repeat in range(repeats):
        reference = Open3DFusion(make_setup(posed[0].intrinsics, config))
        maps = {n: VoxelMap(config, make_label_set("bench", [f"class {c}" for c in range(n)])) for n in CLASSES}
        taken: dict[str, list[float]] = {name: [] for name in ("open3d", *map(str, CLASSES))}
        for number, frame in enumerate(posed):
            depth = np.ascontiguousarray(frame.depth_m, np.float32)
            frame = dataclasses.replace(frame, depth_m=depth)
            turns: Mapping[str, Callable[[], object]] = {"open3d": partial(reference.add, frame)} | {
                str(n): partial(voxel_map.integrate, frame, depth, votes[n][0], rows=votes[n][1])
                for n, voxel_map in maps.items()
            }
            order = list(turns)
            for name in order[(first := (number + repeat) % len(order)) :] + order[:first]:
                taken[name].append(_milliseconds(turns[name]))
        medians.append({name: float(np.median(values[WARM_UP:])) for name, values in taken.items()})
        sizes = {"blocks": maps[CLASSES[0]].block_count, "open3d_blocks": reference.block_count}
    found: dict[str, Any] = {
        "frames": len(posed) - WARM_UP,
        "repeats": repeats,
        "voxel_size_m": voxel_size_m,
        "threads": thread_count(),
        **sizes,
        "open3d_ms": round(float(np.median([m["open3d"] for m in medians])), 1),
    }
    for count in map(str, CLASSES):
        ratios = [m[count] / m["open3d"] for m in medians]
        found[f"ms_{count}"] = round(float(np.median([m[count] for m in medians])), 1)
        found[f"ratio_{count}"] = [round(float(r), 2) for r in (np.median(ratios), min(ratios), max(ratios))]
    return found


def bench_pipeline(log: Path, weights: Path | None, config: MapperConfig, frames: int = 20) -> dict[str, Any]:
    """Time whole steps: 640x480 frames of a log in, the semantic map out.

    The frames have a sensor's depth; none with ``depth.source`` "computed": a step computes it as a live mapper does.
    Gives plain data: ``hz`` (1 / mean of a step), ``p50_ms`` and ``p95_ms`` of ``step``, medians of its stages, and the
    mIoU of the rendered labels (None for a log without labels).
    """
    pipeline = Mapper.load(weights, config).pipeline
    posed, label_set = read_frames(log, frames + WARM_UP)
    posed = [_resized(frame) for frame in posed]
    if config.depth.source == "computed":
        posed = [dataclasses.replace(frame, depth_m=None) for frame in posed]
    steps: list[float] = []
    confusion = ConfusionMatrix(pipeline.label_set)
    in_map = None if label_set is None else pipeline.label_set.channel_map_from(label_set)
    stages: dict[str, list[float]] = {}
    for number, frame in enumerate(posed):
        began = time.perf_counter()
        update = pipeline.step(frame)
        if number < WARM_UP:
            continue
        steps.append((time.perf_counter() - began) * 1e3)
        if frame.label is not None and in_map is not None:
            confusion.update(pipeline.label_set.to_ids(in_map[frame.label]), update.label, f"frame {number}")
        rest = steps[-1] - sum(update.stage_ms.values())  # poses and depth, where these are computed
        for name, value in {**update.stage_ms, "before": rest}.items():
            stages.setdefault(name, []).append(value)
    score = confusion.metrics().miou
    return {
        "frames": len(steps),
        "size": f"{WIDTH}x{HEIGHT}",
        "voxel_size_m": config.voxel_map.voxel_size_m,
        "threads": thread_count(),
        "hz": round(1e3 / float(np.mean(steps)), 2),
        "p50_ms": round(float(np.percentile(steps, 50)), 1),
        "p95_ms": round(float(np.percentile(steps, 95)), 1),
        "stages_ms": {name: round(float(np.median(values)), 1) for name, values in stages.items()},
        "blocks": pipeline.voxel_map.block_count,
        "miou": None if score is None else round(score, 4),
        "quality": config.quality,
        "depth": "computed" if config.depth.source == "computed" else "sensor",
    }


def _resized(frame: PosedFrame) -> PosedFrame:
    k = scale_intrinsics(frame.intrinsics, WIDTH, HEIGHT)
    label = None if frame.label is None else resize_label(frame.label, k)
    rgb, depth_m = resize_rgb(frame, k), resize_depth(frame, k)
    return dataclasses.replace(frame, rgb=rgb, depth_m=depth_m, label=label, intrinsics=k)


def _milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return (time.perf_counter() - began) * 1e3
