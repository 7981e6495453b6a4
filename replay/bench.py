"""Measure mapping on this machine: whole steps of the pipeline."""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import LogError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import PosedFrame

WIDTH, HEIGHT = 640, 480  # of the frames that are measured
WARM_UP = 3  # frames that do not count: first growth of buffers


def bench_pipeline(log: Path, weights: Path | None, config: MapperConfig, frames: int = 20) -> dict[str, Any]:
    """Time whole steps: 640x480 frames of a log in, the semantic map out.

    The frames have a sensor's depth; none with ``depth.source`` "computed": a step computes it as a live mapper does.
    Gives plain data: ``hz`` (1 / mean of a step), ``p50_ms`` and ``p95_ms`` of ``step``, medians of its stages, and the
    mIoU of the rendered labels (None for a log without labels).
    """
    pipeline = Mapper.load(weights, config).pipeline
    posed, label_set = first_frames(log, frames + WARM_UP)
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
        "threads": torch.get_num_threads(),
        "hz": round(1e3 / float(np.mean(steps)), 2),
        "p50_ms": round(float(np.percentile(steps, 50)), 1),
        "p95_ms": round(float(np.percentile(steps, 95)), 1),
        "stages_ms": {name: round(float(np.median(values)), 1) for name, values in stages.items()},
        "blocks": pipeline.voxel_map.block_count,
        "miou": None if score is None else round(score, 4),
        "quality": config.quality,
        "depth": "computed" if config.depth.source == "computed" else "sensor",
    }


def first_frames(log: Path, count: int) -> tuple[list[PosedFrame], LabelSet | None]:
    """The first frames of a log with depth, at 640x480, and the label set of their labels.

    Raises LogError: there are not more than ``WARM_UP``.
    """
    with LogReader(log) as reader:
        frames = [_resized(f) for f in itertools.islice((f for f in reader if f.depth_m is not None), count)]
        label_set = reader.info.label_set
    if len(frames) <= WARM_UP:
        raise LogError(f"{log}: {len(frames)} frames with depth; this needs more than {WARM_UP}")
    return frames, label_set


def _resized(frame: PosedFrame) -> PosedFrame:
    k = scale_intrinsics(frame.intrinsics, WIDTH, HEIGHT)
    label = None if frame.label is None else resize_label(frame.label, k)
    rgb, depth_m = resize_rgb(frame, k), resize_depth(frame, k)
    return dataclasses.replace(frame, rgb=rgb, depth_m=depth_m, label=label, intrinsics=k)
