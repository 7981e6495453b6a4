"""Fusion of frames into the voxel map against Open3D's own, in one process."""

from __future__ import annotations

# Open3D comes without types.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.bench import HEIGHT, WARM_UP, WIDTH, first_frames
from semantic_mapper.types import Float32, PosedFrame

COARSE = (120, 160)  # size of the rendered view that is upsampled, as the pipeline has it
CLASSES = (20, 40)


def bench_fusion(log: Path, frames: int = 20, voxel_size_m: float = 0.02) -> dict[str, Any]:
    """Time our fusion with 20 and 40 classes against Open3D's ``integrate`` without any, frame by frame in turns.

    Both find their own blocks. Open3D fuses TSDF and colour; ours class evidence, too, of a quarter-size rendered view.
    Gives plain data: milliseconds a frame (medians); ``ratio_20`` and ``ratio_40`` are ours over Open3D's.
    """
    posed, _ = first_frames(log, frames + WARM_UP)
    config = VoxelMapConfig(voxel_size_m=voxel_size_m)
    reference = _Open3DFusion(config)
    maps = {n: VoxelMap(config, make_label_set("bench", [f"class {c}" for c in range(n)])) for n in CLASSES}
    votes = {count: _some_probabilities(count) for count in CLASSES}
    open3d_ms: list[float] = []
    ours_ms: dict[int, list[float]] = {count: [] for count in CLASSES}
    height, width = COARSE  # each pixel takes the coarse one that it lies in
    rows = np.arange(HEIGHT)[:, None] * height // HEIGHT * width + np.arange(WIDTH) * width // WIDTH
    rows = rows.astype(np.int32)
    for frame in posed:
        depth = np.ascontiguousarray(frame.depth_m, np.float32)
        open3d_ms.append(_milliseconds(reference.integrate, frame, depth))
        for count, voxel_map in maps.items():
            ours_ms[count].append(_milliseconds(voxel_map.integrate, frame, depth, votes[count], rows=rows))
    theirs = float(np.median(open3d_ms[WARM_UP:]))
    ours = {count: float(np.median(values[WARM_UP:])) for count, values in ours_ms.items()}
    return {
        "frames": len(posed) - WARM_UP,
        "voxel_size_m": voxel_size_m,
        "threads": torch.get_num_threads(),
        "blocks": maps[20].block_count,
        "open3d_blocks": reference.block_count,
        "open3d_ms": round(theirs, 1),
        **{f"ms_{count}": round(ms, 1) for count, ms in ours.items()},
        **{f"ratio_{count}": round(ms / theirs, 2) for count, ms in ours.items()},
    }


class _Open3DFusion:
    """Open3D's own fusion of TSDF and colour, with its own choice of blocks."""

    def __init__(self, config: VoxelMapConfig) -> None:
        self._o3d = load_open3d()
        self._config = config
        core = self._o3d.core
        dtypes, shapes, cpu = (core.float32,) * 3, ((1,), (1,), (3,)), core.Device("CPU:0")
        names, size_m, blocks = ("tsdf", "weight", "color"), config.voxel_size_m, config.initial_blocks
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(names, dtypes, shapes, size_m, 8, blocks, cpu)

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


def _milliseconds(work: Callable[..., object], *arguments: object, **options: object) -> float:
    began = time.perf_counter()
    work(*arguments, **options)
    return (time.perf_counter() - began) * 1e3


def _some_probabilities(classes: int) -> Float32:
    """(h * w, L): patches of 10 x 10 pixels of one class each, as sure as a field is."""
    rng = np.random.default_rng(0)
    patch: NDArray[np.int64] = rng.integers(0, classes, (COARSE[0] // 10, COARSE[1] // 10))
    sure = np.eye(classes, dtype=np.float32)[np.repeat(np.repeat(patch, 10, 0), 10, 1)]
    return np.ascontiguousarray(0.9 * sure + np.float32(0.1 / classes)).reshape(-1, classes)
