"""Maps of rooms without depth: of depth that a fitted scene grid renders, of computed depth, and of neither.

Each as ``finetune --kind grid``, ``autolabel --depth`` and ``replay`` make it, against the true surface.

Example: python -m research.experiments.grid_maps --rooms 3
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence

import numpy as np
import torch

from research.experiments.computed_maps import ERRORS, EVERY_TRUTH, Step, distances, measure, room_walk, true_surface
from research.scenes import VALIDATION_SEEDS
from semantic_mapper.config import DepthConfig, VoxelMapConfig, convert_config
from semantic_mapper.errors import FrameError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.frame_depth import computed_trust
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.run_replay import mapper_config
from semantic_mapper.replay.autolabel import RENDERED_SPREAD, rendered_depth
from semantic_mapper.training.finetune import FinetuneConfig
from semantic_mapper.training.grid_fit import GridFitConfig
from semantic_mapper.training.scene_fit import fit_scene
from semantic_mapper.types import Float64

DELAY_FRAMES = 6  # as ``replay`` has it


def of_grid(steps: Sequence[Step], surface: Float64, settings: GridFitConfig) -> dict[str, float]:
    """Fit a grid to the pictures, render the depth of each, and map it."""
    began = time.process_time()
    config = FinetuneConfig(seconds=0, steps=settings.steps, grid=settings)
    checkpoint = fit_scene([s.frame for s in steps], ROOMS, None, config)
    seconds = time.process_time() - began
    voxel_map, off = VoxelMap(VoxelMapConfig(), ROOMS), list[float]()
    for step in steps:
        depth = rendered_depth(checkpoint.model, step.frame, checkpoint.width)
        there = depth > 0
        off += (np.abs(depth - step.depth_m)[there] / step.depth_m[there]).tolist()
        trust = computed_trust(depth, np.float32(RENDERED_SPREAD) * depth)
        voxel_map.integrate(step.frame, depth, None, trust=trust, measured=False)
    psnr = float(checkpoint.recipe["psnr"] or np.nan)
    figures = {"psnr": psnr, "abs_rel": float(np.mean(off)), "abs_rel_median": float(np.median(off))}
    return figures | {"cpu_s": seconds} | distances(voxel_map.points().xyz, surface)


def of_nothing(steps: Sequence[Step], surface: Float64) -> dict[str, float]:
    """``replay --depth off`` with the weights in the package."""
    mapper = Mapper.load(None, mapper_config(None, None, depth="off", delay_frames=DELAY_FRAMES))
    for step in steps:
        try:
            mapper.pipeline.step(step.frame)
        except FrameError:  # a picture that would spoil the map
            continue
    return distances(mapper.pipeline.voxel_map.points().xyz, surface)


def main() -> None:
    """Run it, and print the figures of each room."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=3, help="validation rooms")
    parser.add_argument("--frames", type=int, default=40, help="of each, 5 cm apart")
    parser.add_argument("--steps", type=int, default=GridFitConfig().steps)
    parser.add_argument("--side", type=int, default=GridFitConfig().long_side, help="vertices on its longest side")
    given = parser.parse_args()
    torch.set_num_threads(1)
    settings = GridFitConfig(steps=given.steps, long_side=given.side)
    computed = convert_config({"from_motion": {"delay_frames": DELAY_FRAMES}}, DepthConfig, "settings")
    for seed in VALIDATION_SEEDS[: given.rooms]:
        steps = room_walk(seed, given.frames, ERRORS["exact"])
        surface = true_surface([(s.depth_m, s.frame.intrinsics, s.T_world_camera) for s in steps[::EVERY_TRUTH]])
        for name, row in (
            ("grid", of_grid(steps, surface, settings)),
            ("computed", measure(steps, computed)),
            ("off", of_nothing(steps, surface)),
        ):
            print(f"room {seed}, {name}: {json.dumps({k: round(v, 3) for k, v in row.items()})}", flush=True)


if __name__ == "__main__":
    main()
