"""A map of many blocks, mostly on disk, and what is asked of it: seconds and largest memory, each in its own process.

The floor of a hall with a chair in each picture. Of each 8 x 8 pixels 4 x 4 are measured: blocks of 3 KB, so that disks
have room for them, in the folder for temporary files. 2,200,000 blocks make a zip of more than 65,535 members.

python -m research.experiments.big_map runs/big.npz --blocks 2200000
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.find import find, open_objects
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.nearest import nearest
from semantic_mapper.queries.occupancy import occupancy
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.queries.surface import costmap
from semantic_mapper.types import CameraIntrinsics, PosedFrame

K, AWAY_M, MEMORY_MB = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480), 4.0, 2000


def fuse(voxel_map: VoxelMap, side: int, number: int) -> None:
    """One picture of the floor, next to the others, in rows of ``side``."""
    y, x = np.mgrid[: K.height, : K.width]
    chair = (abs(x - 320) < 50) & (abs(y - 240) < 50)
    depth = np.where((y & 4) | (x & 4), 0, np.where(chair, AWAY_M - 0.5, AWAY_M)).astype(np.float32)
    classes = np.eye(len(ROOMS), dtype=np.float32)[[ROOMS.names.index(name) for name in ("floor", "chair")]]
    pose = np.diag((1.0, -1.0, -1.0, 1.0))  # looks down
    pose[:3, 3] = number % side * AWAY_M * K.width / K.fx, number // side * AWAY_M * K.height / K.fy, AWAY_M
    rgb = np.full((*depth.shape, 3), 128, np.uint8)
    voxel_map.integrate(
        PosedFrame(number, number, "down", rgb, depth, None, K, pose), depth, classes, rows=chair.astype(np.int32)
    )


def build(blocks: int) -> VoxelMap:
    """Fuse pictures until there are as many blocks."""
    made = VoxelMap(VoxelMapConfig(max_blocks=2 * blocks, memory_mb=MEMORY_MB), ROOMS)
    while made.block_count < blocks:
        fuse(made, int((blocks / 1500) ** 0.5), made.frames)
    return made


def work(name: str, path: Path, blocks: int) -> None:
    """Do one after the other, each with what the first gave, and print a row for each."""
    points = np.random.default_rng(0).uniform((0, 0, 0), (100, 100, 1), (10_000, 3))
    steps: dict[str, dict[str, Callable[[Any], Any]]] = {
        "build": {
            "build": lambda _: build(blocks),
            "a frame more": lambda made: fuse(made, 20, made.frames + 400),
            "save": lambda made: made.save(path),
        },
        "load": {"load": lambda _: VoxelMap.load(path), "surface points": lambda loaded: loaded.points()},
        "query": {
            "open to be queried": lambda _: MapMirror.load(path).snapshot(),
            "occupancy of 10,000 points": lambda snapshot: occupancy(snapshot, points),
            "nearest": lambda snapshot: nearest(snapshot, "chair", (50, 50, 1)),
            "instances": lambda snapshot: InstanceTracker().update(snapshot),
            "costmap": lambda snapshot: costmap(snapshot, 0.3, up=(0, 0, 1)),
        },
        "find": {
            "open, recalling objects": lambda _: open_objects(path),
            "find": lambda opened: find("chair", *opened, up=(0, 0, 1)),
        },
    }
    given = None
    for step, do in steps[name].items():
        began, worked = time.perf_counter(), time.process_time()
        result = do(given)
        given = result if given is None else given
        spent = time.perf_counter() - began, time.process_time() - worked
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
        print(f"| {step} | {spent[0]:.1f} | {spent[1]:.1f} | {peak_mb:,.0f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("--blocks", type=int, default=2_200_000)
    parser.add_argument("--only", nargs="*", default=["build", "load", "query", "find"])
    options = parser.parse_args()
    print("| step | seconds | CPU s | largest memory so far, MB |")
    for name in options.only:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            pool.submit(work, name, options.map, options.blocks).result()
