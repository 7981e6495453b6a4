"""Rooms, doors and objects of a map against generated storeys, whose rooms are known.

python -m research.experiments.rooms_graph --keep runs/storeys
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from research.scenes import NoiseConfig
from research.scenes.config import TEST_SEEDS
from research.scenes.storey import Storey, make_storey, survey_poses, survey_views
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.graph import CELL_M, GraphTracker, SceneGraph
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.types import Bool, CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(80.0, 80.0, 79.5, 59.5, 160, 120)
DOOR_NEAR_M = 0.5
WRONG = 0.2  # of the blocks of 8^3 voxels
UP = (0.0, 0.0, 1.0)
SURE = 0.8  # probability of the true class that each pixel votes with


def map_storey(storey: Storey, voxel_size_m: float) -> VoxelMap:
    """Fuse the survey: depth of an OAK-D, true classes, true poses."""
    voxel_map = VoxelMap(VoxelMapConfig(voxel_size_m=voxel_size_m), ROOMS)
    count = len(ROOMS)
    table = np.full((count, count), (1 - SURE) / (count - 1), np.float32)
    np.fill_diagonal(table, SURE)
    poses = survey_poses(storey)
    for seq, view in enumerate(survey_views(storey, poses, CAMERA, NoiseConfig())):
        frame = PosedFrame(
            stamp_ns=(seq + 1) * 100_000_000,
            seq=seq,
            camera_id="storey",
            rgb=view.rgb,
            depth_m=view.depth_m,
            label=view.label,
            intrinsics=CAMERA,
            T_world_camera=poses[seq],
            pose_source="storey",
        )
        voxel_map.integrate(frame, view.depth_m, table, rows=ROOMS.to_channels(view.label).astype(np.int32))
    return voxel_map


def kept_map(seed: int, area_m2: float, voxel_size_m: float, keep: Path) -> Path:
    """The saved map of a storey, made where it is missing."""
    path = keep / f"{seed}-{area_m2:g}-{voxel_size_m:g}.npz"
    if not path.is_file():
        keep.mkdir(parents=True, exist_ok=True)
        map_storey(make_storey(seed, area_m2), voxel_size_m).save(path)
    return path


class Counts(NamedTuple):
    """Of what was found, what is there, and what agrees."""

    found: float
    there: float
    agree: float

    @property
    def f1(self) -> float:
        """F1."""
        return 2 * self.agree / (self.found + self.there)


def compare(storey: Storey, graph: SceneGraph) -> dict[str, Counts]:
    """Rooms (IoU of 0.5 and more), their floor, doors (within 0.5 m and of the right rooms), rooms of things.

    Each room that was found stands for one that is there, so that they overlap most.
    """
    columns, rows = (np.array(storey.scene.size_m[:2]) / CELL_M).astype(int) + 1
    x, y = np.meshgrid((np.arange(columns) + 0.5) * CELL_M, (np.arange(rows) + 0.5) * CELL_M)
    truth = storey.room_at(np.stack((x.ravel(), y.ravel()), 1)).reshape(rows, columns)
    masks: list[Bool] = []
    for room in graph.rooms:
        mask = np.zeros((rows, columns), np.uint8)
        cv2.fillPoly(mask, [np.rint(room.outline[:, :2] / CELL_M - 0.5).astype(np.int32)], 1)
        masks.append(mask > 0)
    both = np.array([[(mask & (truth == k)).sum() for k in range(len(storey.rooms))] for mask in masks])
    size, whole = np.array([mask.sum() for mask in masks]), np.bincount(truth[truth >= 0], minlength=len(storey.rooms))
    pairs = list(zip(*linear_sum_assignment(-both), strict=True))
    number = {graph.rooms[a].id: int(b) for a, b in pairs}
    sure = sum(bool(both[a, b] >= 0.5 * (size[a] + whole[b] - both[a, b])) for a, b in pairs)
    doors = 0
    for door in storey.doors:
        near = [d for d in graph.doors if np.linalg.norm(d.center[:2] - door.center) < DOOR_NEAR_M]
        doors += any({number.get(a) for a in d.rooms} == set(door.rooms) for d in near)
    in_room = storey.room_at(np.array([thing.centroid[:2] for thing in graph.things]))
    placed = [
        (graph.room_of[thing.id], int(room)) for thing, room in zip(graph.things, in_room, strict=True) if room >= 0
    ]
    return {
        "rooms": Counts(len(masks), len(storey.rooms), sure),
        "floor": Counts(size.sum(), whole.sum(), sum(int(both[a, b]) for a, b in pairs)),
        "doors": Counts(len(graph.doors), len(storey.doors), doors),
        "things": Counts(
            sum(own is not None for own, _ in placed),
            len(placed),
            sum(own is not None and number.get(own) == room for own, room in placed),
        ),
    }


def with_classes(snapshot: MapSnapshot, which: str, seed: int) -> MapSnapshot:
    """The map as it is, without classes, or with one wrong class throughout each of a fifth of its blocks."""
    label = snapshot.voxels.label
    if which == "none":
        label = np.zeros_like(label)
    elif which == "wrong":
        rng = np.random.default_rng(seed)
        wrong = rng.random(len(label)) < WRONG
        other = np.array(ROOMS.ids, np.uint8)[rng.integers(len(ROOMS), size=len(label))]
        label = np.where(wrong[:, None] & (label != ROOMS.ignore_id), other[:, None], label)
    return replace(snapshot, voxels=snapshot.voxels._replace(label=label))


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description="Rooms of maps of generated storeys.")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(TEST_SEEDS))
    parser.add_argument("--area", type=float, default=110.0, help="m2 of a storey")
    parser.add_argument("--voxel", type=float, default=0.05, help="metres")
    parser.add_argument("--classes", choices=("true", "wrong", "none"), default="true", help="wrong: a fifth of blocks")
    parser.add_argument("--keep", type=Path, required=True, help="folder for the maps")
    args = parser.parse_args()
    total: dict[str, Counts] = {}
    same = 0
    print("seed    rooms there  found  F1: rooms  floor  doors  things   CPU s: things  rooms")
    for seed in args.seeds:
        storey = make_storey(seed, args.area)
        snapshot = MapMirror.of(VoxelMap.load(kept_map(seed, args.area, args.voxel, args.keep))).snapshot()
        seen = with_classes(snapshot, args.classes, seed)
        start = time.process_time()
        things = InstanceTracker().update(snapshot)
        between = time.process_time()
        graph = GraphTracker(UP).update(seen, things)
        spent = between - start, time.process_time() - between
        found = compare(storey, graph)
        for name, counts in found.items():
            total[name] = Counts(*np.add(total.get(name, Counts(0, 0, 0)), counts).tolist())
        same += len(graph.rooms) == len(storey.rooms)
        scores = "".join(f"{found[name].f1:7.3f}" for name in total)
        print(
            f"{seed:6} {len(storey.rooms):12} {len(graph.rooms):6} {scores} {spent[0]:16.2f} {spent[1]:6.2f}",
            flush=True,
        )
    print("all: " + ", ".join(f"{name} F1 {counts.f1:.3f}" for name, counts in total.items()))
    print(f"right number of rooms: {same} of {len(args.seeds)}")


if __name__ == "__main__":
    main()
