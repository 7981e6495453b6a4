"""Buildings that three robots have mapped, each its part in a world of its own, merged into tiles by ``fleet merge``.

Each robot surveys two thirds of the rooms of a generated storey with an OAK-D's depth and the shipped weights; every
room is seen by two of them, from other poses. Where their maps lie is found, not given. The merged map and its parts
are compared with what perfect cameras at the same poses see: each part with what it has seen itself, the merged map
with what any of them has seen. Maps, tiles and scores are kept: a run that ended early goes on where it was.

Example: python -m research.experiments.fleet_merge --buildings 12 --keep runs/fleet-merge
Example: python -m research.experiments.fleet_merge --buildings 1 --keep runs/fleet-merge --picture building.png
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from research.evaluation.room_map import in_rooms
from research.scenes import NoiseConfig
from research.scenes.config import TEST_SEEDS
from research.scenes.daylight import pose_of
from research.scenes.storey import Storey, make_storey, survey_poses, survey_views
from semantic_mapper.config import MapperConfig, VoxelMapConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.evaluation.metrics import map_confusion
from semantic_mapper.geometry import invert_pose, rotation_vector, transform, unproject, yaw_transform
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.cli.console import frame_progress
from semantic_mapper.nodes.fleet.cluster import connected
from semantic_mapper.nodes.fleet.merge import Run, merge_maps, run_on_ray
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.plots import CYCLE, new_figure, rendered, write_picture
from semantic_mapper.queries.tiles import TiledMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

CAMERA = CameraIntrinsics(80.0, 80.0, 79.5, 59.5, 160, 120)
VOXEL_M = 0.03
ROBOTS = 3
NEAR_M = 0.05  # farther from the map, a true surface counts as missed
TRUTH_VOXEL_M = 0.01
ASKED = 1  # points of each building from which every class is looked for


class Score(msgspec.Struct, frozen=True):
    """Of one map.

    Args:
        miou: Over the surface that its own cameras could see; what the map lacks is wrong.
        seen: Fraction of that surface within ``NEAR_M`` of the map.
        error_mm, error_p95_mm: Of its points, from the nearest true one: mean, and 95th percentile.
    """

    miou: float
    seen: float
    error_mm: float
    error_p95_mm: float


class Building(msgspec.Struct, frozen=True):
    """What is measured of one building.

    Args:
        seed: Of the storey.
        parts, merged: Scores of the robots' maps and of the merged map.
        off_mm, off_deg: Greatest error of a map's place.
        tiles, megabytes: Of the store.
        peak_mb: Greatest memory of a worker so far, libraries included; workers stay from building to building.
        seconds: Of the merge.
        asked, loaded: Questions ``nearest``, each with no tile in memory, and tiles that they have loaded.
    """

    seed: int
    parts: tuple[Score, ...]
    merged: Score
    off_mm: float
    off_deg: float
    tiles: int
    megabytes: float
    peak_mb: float
    seconds: float
    asked: int
    loaded: int


class Truth(NamedTuple):
    """Surface points (N, 3) in the building's world, and their class ids (N,)."""

    xyz: Float32
    label: UInt8


def robot_poses(storey: Storey, seed: int, robot: int) -> Float64:
    """T_building_camera (N, 4, 4): the survey of two thirds of the rooms, from stops and angles of the robot's own."""
    poses = survey_poses(storey)
    rng = np.random.default_rng((seed, robot))
    room = storey.room_at(poses[:, :2, 3])
    found: list[Float64] = []
    for T in poses[room % ROBOTS != robot][robot % 2 :: 2]:  # every direction once, up or down
        ahead = T[:3, 2]
        yaw = np.arctan2(ahead[1], ahead[0]) + rng.uniform(-0.35, 0.35)
        pitch = np.arcsin(ahead[2]) + rng.uniform(-0.1, 0.1)
        found.append(pose_of(T[:3, 3] + rng.uniform(-0.1, 0.1, 3), float(yaw), float(pitch)))
    return np.array(found)


def robot_world(seed: int, robot: int) -> Float64:
    """T_building_robot (4, 4): the first robot's world is the building's."""
    if robot == 0:
        return np.eye(4)
    rng = np.random.default_rng((seed, robot, 1))
    yaw_deg = rng.uniform(-180, 180)
    return yaw_transform(rng.uniform((-20, -20, -1), (20, 20, 1)), yaw_deg)


def frames_of(storey: Storey, seed: int, robot: int) -> Iterator[PosedFrame]:
    """What a robot sees, with poses in its own world."""
    poses, T_robot_building = robot_poses(storey, seed, robot), invert_pose(robot_world(seed, robot))
    noisy = replace(storey, scene=replace(storey.scene, seed=storey.scene.seed + 1000 * robot))  # noise of its own
    for seq, view in enumerate(survey_views(noisy, poses, CAMERA, NoiseConfig())):
        T = T_robot_building @ poses[seq]
        yield PosedFrame((seq + 1) * 100_000_000, seq, f"robot-{robot}", view.rgb, view.depth_m, None, CAMERA, T)


def map_part(storey: Storey, seed: int, robot: int, path: Path) -> None:
    """Map a robot's frames with the shipped weights, where its map is missing."""
    if path.is_file():
        return
    mapper = Mapper.load(config=MapperConfig(voxel_map=VoxelMapConfig(voxel_size_m=VOXEL_M)))
    for frame in frames_of(storey, seed, robot):
        try:
            mapper.step(frame)
        except FrameError as error:
            print(f"{seed}, robot {robot}: {error}")
    path.parent.mkdir(parents=True, exist_ok=True)
    mapper.voxel_map.save(path)


def truth_of(storey: Storey, poses: Float64) -> Truth:
    """What perfect cameras see, one point a cell of ``TRUTH_VOXEL_M``."""
    xyz: list[Float32] = []
    label: list[UInt8] = []
    for T, view in zip(poses, survey_views(storey, poses, CAMERA), strict=True):
        hit = view.depth_m > 0
        xyz.append(transform(T, unproject(view.depth_m, CAMERA)[hit]).astype(np.float32))
        label.append(view.label[hit])
    points, labels = np.concatenate(xyz), np.concatenate(label)
    cell = np.floor(points / TRUTH_VOXEL_M).astype(np.int64)
    _, first = np.unique(cell @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    return Truth(points[first], labels[first])


def score(points: MapPoints, label: UInt8, truth: Truth) -> Score:
    """Hold a map, in the building's world, against the surface that its cameras could see."""
    miou = map_confusion(truth.xyz, truth.label, points.xyz, label, ROOMS, max_distance_m=NEAR_M).metrics().miou
    seen = cKDTree(points.xyz).query(truth.xyz, distance_upper_bound=NEAR_M)[0] <= NEAR_M
    off = 1000 * cKDTree(truth.xyz).query(points.xyz)[0]
    return Score(miou or 0.0, float(seen.mean()), float(off.mean()), float(np.percentile(off, 95)))


def count_loads(store: Path) -> tuple[int, int]:
    """Questions ``nearest`` from points all over the building for every class, and tiles loaded for them."""
    manifest = TiledMap.open(store).manifest
    rows = [row.surface for row in manifest.tiles]
    low = np.min([row.lower for row in rows if row.lower], axis=0) * manifest.config.voxel_size_m
    high = np.max([row.upper for row in rows if row.upper], axis=0) * manifest.config.voxel_size_m
    asked = loaded = 0
    for point in np.random.default_rng(0).uniform(low, high, (ASKED, 3)):
        for name in sorted({name for row in rows for name in row.classes}):
            tiled = TiledMap.open(store)
            tiled.nearest(name, point)
            asked, loaded = asked + 1, loaded + tiled.loads
    return asked, loaded


def map_paths(seed: int, area_m2: float, keep: Path) -> list[Path]:
    """Of the robots' maps."""
    return [keep / f"{seed}-{area_m2:g}" / f"robot-{robot}.npz" for robot in range(ROBOTS)]


def measure(seed: int, area_m2: float, keep: Path, picture: Path | None, run: Run) -> Building:
    """Merge and score one building, whose maps are there."""
    storey, maps = make_storey(seed, area_m2), map_paths(seed, area_m2, keep)
    began = time.monotonic()
    store = maps[0].parent / "store"
    report = merge_maps([str(p) for p in maps], Store(str(store), create=True), {}, run, frame_progress)
    seconds = time.monotonic() - began
    off_mm, off_deg = 0.0, 0.0
    for robot, source in enumerate(report.manifest.sources):
        off = invert_pose(robot_world(seed, robot)) @ np.array(source.T_world_map)
        off_mm = max(off_mm, 1000 * float(np.linalg.norm(off[:3, 3])))
        off_deg = max(off_deg, float(np.rad2deg(np.linalg.norm(rotation_vector(off)))))
    truths = [truth_of(storey, robot_poses(storey, seed, robot)) for robot in range(ROBOTS)]
    parts = [moved(VoxelMap.load(path), robot_world(seed, robot)) for robot, path in enumerate(maps)]
    both = moved(TiledMap.open(store).load(), np.eye(4))
    truth = truth_of(storey, np.concatenate([robot_poses(storey, seed, robot) for robot in range(ROBOTS)]))
    if picture is not None:
        write_picture(picture, draw([p.xyz for p, _ in parts], both[0], report.manifest.edge_blocks, seed))
    asked, loaded = count_loads(store)
    return Building(
        seed,
        tuple(score(*part, own) for part, own in zip(parts, truths, strict=True)),
        score(*both, truth),
        off_mm,
        off_deg,
        len(report.manifest.tiles),
        sum((store / row.file).stat().st_size for row in report.manifest.tiles) / 1e6,
        report.peak_bytes / 1e6,
        seconds,
        asked,
        loaded,
    )


def moved(voxel_map: VoxelMap, T_building_map: Float64) -> tuple[MapPoints, UInt8]:
    """The points of a map in the building's world, and their class ids of ``ROOMS``."""
    points = voxel_map.points()
    xyz = transform(T_building_map, points.xyz.astype(np.float64)).astype(np.float32)
    return replace(points, xyz=xyz), in_rooms(points.label, voxel_map.label_set)


@rendered
def draw(parts: Sequence[Float32], merged: MapPoints, edge_blocks: int, seed: int) -> Figure:
    """From above, without what is higher than 2 m: who has seen what, and the merged map with its tiles."""
    figure = new_figure(1500, 620, layout="constrained")
    of_parts, of_merged = figure.subplots(1, 2, sharex=True, sharey=True)
    for robot, xyz in enumerate(parts):
        low = xyz[(xyz[:, 2] < 2.0)][:: 1 + len(xyz) // 40_000]
        of_parts.scatter(low[:, 0], low[:, 1], s=1.5, color=CYCLE[robot], label=f"robot {robot}", alpha=0.5, lw=0)
    of_parts.legend(markerscale=8, loc="upper right")
    of_parts.set_title(f"building {seed}: three maps, in the building's world")
    low = np.flatnonzero(merged.xyz[:, 2] < 2.0)[:: 1 + len(merged.xyz) // 150_000]
    order = low[np.argsort(merged.xyz[low, 2])]
    of_merged.scatter(*merged.xyz[order, :2].T, s=1.5, c=ROOMS.colorize(merged.label[order]) / 255, lw=0)
    edge_m = edge_blocks * 8 * VOXEL_M
    for axis, line in ((0, of_merged.axvline), (1, of_merged.axhline)):
        ends = np.floor(merged.xyz[:, axis].min() / edge_m), np.ceil(merged.xyz[:, axis].max() / edge_m)
        for n in np.arange(ends[0], ends[1] + 1):
            line(n * edge_m, color="white", lw=0.8)
    of_merged.set_title("merged, by class; lines are edges of tiles")
    for axes in (of_parts, of_merged):
        axes.set_aspect("equal")
        axes.set_xlim(merged.xyz[:, 0].min() - 0.5, merged.xyz[:, 0].max() + 0.5)
        axes.set_ylim(merged.xyz[:, 1].min() - 0.5, merged.xyz[:, 1].max() + 0.5)
        axes.set_xlabel("metres")
        axes.grid(visible=False)
    return figure


def show(found: Sequence[Building]) -> None:
    """Print the table, and whether each merged map is as good as the mean of its parts."""
    print(
        "| building | mIoU parts, mean | merged | error parts, mean | merged | seen parts, mean | merged "
        "| place off by | tiles | MB | peak MB | tiles a `nearest` |"
    )
    print("|---" * 12 + "|")
    for b in found:
        mean = {name: float(np.mean([getattr(p, name) for p in b.parts])) for name in Score.__struct_fields__}
        print(
            f"| {b.seed} | {100 * mean['miou']:.1f} | {100 * b.merged.miou:.1f} | {mean['error_mm']:.1f} mm "
            f"| {b.merged.error_mm:.1f} mm | {100 * mean['seen']:.1f} % | {100 * b.merged.seen:.1f} % "
            f"| {b.off_mm:.0f} mm, {b.off_deg:.2f}° | {b.tiles} | {b.megabytes:.0f} | {b.peak_mb:.0f} "
            f"| {b.loaded / b.asked:.2f} |"
        )
    better = [b.merged.miou >= np.mean([p.miou for p in b.parts]) for b in found]
    closer = [b.merged.error_mm <= np.mean([p.error_mm for p in b.parts]) for b in found]
    miou = np.mean([[np.mean([p.miou for p in b.parts]), b.merged.miou] for b in found], axis=0)
    error = np.mean([[np.mean([p.error_mm for p in b.parts]), b.merged.error_mm] for b in found], axis=0)
    print(
        f"{len(found)} buildings: mIoU {100 * miou[0]:.1f} -> {100 * miou[1]:.1f}, not worse in {sum(better)}; error "
        f"{error[0]:.1f} -> {error[1]:.1f} mm, not worse in {sum(closer)}"
    )


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--buildings", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="begin with this building")
    parser.add_argument("--area", type=float, default=45.0, help="m2 of a building")
    parser.add_argument("--keep", type=Path, required=True, help="folder for maps, tiles and scores")
    parser.add_argument("--picture", type=Path, help="draw the last building from above (PNG); scores it again")
    args = parser.parse_args()
    found: list[Building] = []
    seeds = list(TEST_SEEDS)[args.first : args.first + args.buildings]
    for seed in seeds:
        storey = make_storey(seed, args.area)
        for robot, path in enumerate(map_paths(seed, args.area, args.keep)):
            map_part(storey, seed, robot, path)
    with connected("local") as cluster:
        run = run_on_ray(cluster)
        for seed in seeds:
            scores = args.keep / f"{seed}-{args.area:g}" / "scores.json"
            picture = args.picture if seed == seeds[-1] else None
            if not scores.is_file() or picture is not None:
                building = measure(seed, args.area, args.keep, picture, run)
                if not scores.is_file():
                    scores.write_bytes(msgspec.json.encode(building))
            found.append(msgspec.json.decode(scores.read_bytes(), type=Building))
            print(msgspec.json.encode(found[-1]).decode(), flush=True)
    show(found)


if __name__ == "__main__":
    main()
