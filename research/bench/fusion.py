"""Measure mapping: fusion against Open3D's own, and whole steps of the pipeline, in one process."""

from __future__ import annotations

# Open3D comes without types.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from msgspec.structs import replace
from numpy.typing import NDArray

from research.scenes import TEST_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.config import MapperConfig, Quality, VoxelMapConfig, with_quality
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

VGA = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
STEP_M = 0.1  # of way between frames
COARSE = (120, 160)  # size of the rendered view that is lifted, as the pipeline has it
CLASSES = (20, 40)
QUALITIES_COMPARED: tuple[Quality, ...] = ("fast", "balanced")
WARM_UP = 3  # frames that do not count: compiling, first growth


def bench_fusion(frames: int = 20, voxel_size_m: float = 0.02) -> dict[str, Any]:
    """Time our fusion with 20 and 40 classes against Open3D's ``integrate`` without any, frame by frame in turns.

    Both find their own blocks. Open3D fuses TSDF and colour; ours class evidence, too, of a quarter-size rendered view.

    Returns:
        Plain data: milliseconds a frame (medians); ``ratio_20`` and ``ratio_40`` are ours over Open3D's,
        ``ratio_20_int16`` and ``ratio_40_int16`` those with ``voxel_map.evidence`` "int16".
    """
    posed = list(room_frames(TEST_SEEDS[0], frames + WARM_UP, VGA, path=CameraPathConfig(step_m=STEP_M)))
    config = VoxelMapConfig(voxel_size_m=voxel_size_m)
    reference = _Open3DFusion(config)
    ours: dict[str, VoxelMap] = {}
    for count in CLASSES:
        label_set = make_label_set("bench", [f"class {c}" for c in range(count)])
        ours[f"{count}"] = VoxelMap(config, label_set)
        ours[f"{count}_int16"] = VoxelMap(replace(config, evidence="int16"), label_set)
    votes = {count: _some_probabilities(count) for count in CLASSES}
    spent: dict[str, list[float]] = {"open3d": [], **{name: [] for name in ours}}
    height, width = COARSE  # each pixel takes the coarse one that it lies in
    rows = np.arange(VGA.height)[:, None] * height // VGA.height * width + np.arange(VGA.width) * width // VGA.width
    rows = rows.astype(np.int32)
    for frame in posed:
        depth = _depth(frame)
        spent["open3d"].append(_milliseconds(lambda f=frame, d=depth: reference.integrate(f, d)))
        for name, voxel_map in ours.items():
            p = votes[len(voxel_map.label_set)]
            spent[name].append(
                _milliseconds(lambda f=frame, d=depth, m=voxel_map, p=p: m.integrate(f, d, p, rows=rows))
            )
    median = {name: float(np.median(values[WARM_UP:])) for name, values in spent.items()}
    return {
        "frames": frames,
        "voxel_size_m": voxel_size_m,
        "threads": torch.get_num_threads(),
        "blocks": ours["20"].block_count,
        "open3d_blocks": reference.block_count,
        "open3d_ms": round(median["open3d"], 1),
        **{f"ms_{name}": round(median[name], 1) for name in ours},
        **{f"ratio_{name}": round(median[name] / median["open3d"], 2) for name in ours},
    }


def bench_pipeline(weights: Path | None, config: MapperConfig, frames: int = 40) -> dict[str, Any]:
    """Time whole steps: 640x480 frames of a test room in, the semantic map out.

    The frames have a sensor's depth; none with ``depth.source`` "computed": a step computes it as a live mapper does.

    Returns:
        Plain data: ``hz`` (1 / mean of a step), ``p50_ms`` and ``p95_ms`` of ``step``, medians of its stages, and the
        mIoU of the rendered labels.
    """
    pipeline = Mapper.load(weights, config).pipeline
    posed = list(room_frames(TEST_SEEDS[0], frames + WARM_UP, VGA, path=CameraPathConfig(step_m=STEP_M)))
    if config.depth.source == "computed":
        posed = [dataclasses.replace(frame, depth_m=None) for frame in posed]
    steps: list[float] = []
    confusion = ConfusionMatrix(pipeline.label_set)
    in_map = pipeline.label_set.channel_map_from(ROOMS)
    stages: dict[str, list[float]] = {}
    rays: list[int] = []
    for number, frame in enumerate(posed):
        began = time.perf_counter()
        update = pipeline.step(frame)
        if number < WARM_UP:
            continue
        steps.append((time.perf_counter() - began) * 1e3)
        rays.append(update.rays)
        assert frame.label is not None
        confusion.update(pipeline.label_set.to_ids(in_map[frame.label]), update.label, f"frame {number}")
        rest = steps[-1] - sum(update.stage_ms.values())  # poses and depth, where these are computed
        for name, value in {**update.stage_ms, "before": rest}.items():
            stages.setdefault(name, []).append(value)
    score = confusion.metrics().miou
    assert score is not None
    return {
        "frames": frames,
        "size": f"{VGA.width}x{VGA.height}",
        "voxel_size_m": config.voxel_map.voxel_size_m,
        "threads": torch.get_num_threads(),
        "hz": round(1e3 / float(np.mean(steps)), 2),
        "p50_ms": round(float(np.percentile(steps, 50)), 1),
        "p95_ms": round(float(np.percentile(steps, 95)), 1),
        "stages_ms": {name: round(float(np.median(values)), 1) for name, values in stages.items()},
        "rays": round(float(np.mean(rays))),
        "blocks": pipeline.voxel_map.block_count,
        "miou": round(score, 4),
        "quality": config.quality,
        "depth": "computed" if config.depth.source == "computed" else "sensor",
    }


def bench_qualities(weights: Path | None, config: MapperConfig, frames: int, known: dict[str, Any]) -> dict[str, Any]:
    """``bench_pipeline`` of the qualities in ``QUALITIES_COMPARED``, by name.

    Args:
        weights: None = those that ship with the package.
        config: Of the mapper; its own quality does not matter.
        frames: That count, in each.
        known: What ``bench_pipeline`` found of ``config``, not measured again if it is one of them.
    """
    found: dict[str, Any] = {}
    for quality in QUALITIES_COMPARED:
        wanted = with_quality(msgspec.structs.replace(config, quality=quality))
        same = msgspec.structs.replace(with_quality(config), quality=quality) == wanted
        found[quality] = known if same else bench_pipeline(weights, wanted, frames)
    return found


class _Open3DFusion:
    """Open3D's own fusion of TSDF and colour, with its own choice of blocks."""

    def __init__(self, config: VoxelMapConfig) -> None:
        self._o3d = load_open3d()
        self._config = config
        self._grid = _empty_grid(config.voxel_size_m, config.initial_blocks)

    @property
    def block_count(self) -> int:
        return int(self._grid.hashmap().size())

    def integrate(self, frame: PosedFrame, depth_m: Float32) -> None:
        core, config, k = self._o3d.core, self._config, frame.intrinsics
        # Open3D puts pixel centres at halves.
        K = core.Tensor(np.array([[k.fx, 0, k.cx + 0.5], [0, k.fy, k.cy + 0.5], [0, 0, 1]]))
        T_camera_world = core.Tensor(invert_pose(frame.T_world_camera))
        image = self._o3d.t.geometry.Image
        depth = image(core.Tensor.from_numpy(depth_m))
        color = image(core.Tensor.from_numpy(frame.rgb.astype(np.float32)))
        limits = (1.0, config.depth_max_m, config.truncation_voxels)
        blocks = self._grid.compute_unique_block_coordinates(depth, K, T_camera_world, *limits)
        self._grid.integrate(blocks, depth, color, K, K, T_camera_world, *limits)


def _milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return (time.perf_counter() - began) * 1e3


def _depth(frame: PosedFrame) -> Float32:
    assert frame.depth_m is not None
    return np.ascontiguousarray(frame.depth_m, np.float32)


def _some_probabilities(classes: int) -> Float32:
    """(h * w, L): patches of 10 x 10 pixels of one class each, as sure as a field is."""
    rng = np.random.default_rng(0)
    patch: NDArray[np.int64] = rng.integers(0, classes, (COARSE[0] // 10, COARSE[1] // 10))
    sure = np.eye(classes, dtype=np.float32)[np.repeat(np.repeat(patch, 10, 0), 10, 1)]
    return np.ascontiguousarray(0.9 * sure + np.float32(0.1 / classes)).reshape(-1, classes)


def _empty_grid(voxel_size_m: float, capacity: int) -> Any:
    o3d = load_open3d()
    dtypes, shapes, device = (o3d.core.float32,) * 3, ((1,), (1,), (3,)), o3d.core.Device("CPU:0")
    return o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), dtypes, shapes, voxel_size_m, 8, capacity, device)
