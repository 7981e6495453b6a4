"""Walks through generated storeys that come back, with loop closure and without: error of the path and of the map.

The camera tours all rooms, looks all round in each, and goes through the first two again. Depth is an OAK-D's. The map
is compared with one that was fused from the same depth at true poses. Runs differ by chance: each is repeated with
other noise, and the table has the median and the range.

Example: python -m research.experiments.loop_closure --seeds 200000 200001 --json runs/loops.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from research.experiments.odometry import follow
from research.scenes import NoiseConfig
from research.scenes.daylight import pose_of
from research.scenes.storey import Storey, make_storey, survey_views
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.evaluation.trajectory import absolute_trajectory_error, relative_pose_error
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

CAMERA = CameraIntrinsics(264.0, 264.0, 159.5, 119.5, 320, 240)
EYE_M = 1.35
CELL_M = 0.1
CLEAR_M = 0.25
STEP_M, STEP_RAD = 0.08, np.deg2rad(8.0)  # between two frames, 1/15 s apart
PITCH = -0.25
VOXEL_M = 0.03
FRAME_NS = 66_666_667


def tour(storey: Storey) -> list[int]:
    """Rooms in the order in which they are visited: to each and back, then to the second once more."""
    links: dict[int, list[int]] = {}
    for door in storey.doors:
        a, b = door.rooms
        links.setdefault(a, []).append(b)
        links.setdefault(b, []).append(a)
    order: list[int] = []
    seen: set[int] = set()

    def visit(room: int) -> None:
        seen.add(room)
        order.append(room)
        for other in sorted(links.get(room, [])):
            if other not in seen:
                visit(other)
                order.append(room)

    visit(0)
    return [*order, *order[1:2]]


def walk(storey: Storey) -> Float64:
    """T_world_camera (N, 4, 4) of the tour, a look all round at the first visit of a room and at the last one."""
    low, high = storey.scene.primitives.bounds()
    xs, ys = (np.arange(CELL_M, side, CELL_M) for side in storey.scene.size_m[:2])
    grid = np.array([(x, y, EYE_M) for y in ys for x in xs])
    near = np.array([_gap(low, high, p) for p in grid])
    stops = []
    for room in storey.rooms:
        inside = ((grid[:, :2] > room.low) & (grid[:, :2] < room.high)).all(axis=1)
        middle = np.linalg.norm(grid[:, :2] - (room.low + room.high) / 2, axis=1)
        stops.append(int(np.where(inside & (near > CLEAR_M), middle, np.inf).argmin()))
    columns, count = len(xs), len(grid)
    a = np.arange(count)
    pairs = [(a[a % columns < columns - 1], 1), (a[: count - columns], columns)]
    ends = np.concatenate([np.stack((k, k + step)) for k, step in pairs], axis=1)
    cost = (
        1.0
        + 20.0 * (np.maximum(0.35 - near[ends].min(axis=0), 0) / 0.35) ** 2
        + 1000.0 * (near[ends].min(axis=0) < 0.1)
    )
    graph = coo_array((cost, ends), shape=(count, count)).tocsr()
    order = tour(storey)
    poses: list[Float64] = []
    yaw = 0.0
    for number, room in enumerate(order):
        if number:
            _, before = dijkstra(graph, directed=False, indices=stops[order[number - 1]], return_predecessors=True)
            cells = [stops[room]]
            while cells[-1] != stops[order[number - 1]]:
                cells.append(int(before[cells[-1]]))
            yaw = _go(poses, _smooth(grid[cells[::-1]]), yaw)
        if room not in order[:number] or number >= len(order) - 2:
            yaw = _turn(poses, grid[stops[room]], yaw, yaw + 2 * np.pi)
    return np.array(poses)


def _gap(low: Float64, high: Float64, point: Float64) -> float:
    return float(np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1).min())


def _smooth(points: Float64) -> Float64:
    for _ in range(6):
        points[1:-1] = (points[:-2] + 2 * points[1:-1] + points[2:]) / 4
    return points


def _turn(poses: list[Float64], place: Float64, start: float, end: float) -> float:
    for yaw in np.linspace(start, end, max(2, 1 + int(abs(end - start) / STEP_RAD)))[1:]:
        poses.append(pose_of(place, yaw, PITCH + 0.1 * np.sin(3 * yaw)))
    return end


def _go(poses: list[Float64], points: Float64, yaw: float) -> float:
    """Along a line, looking ahead, after turning toward it."""
    way = np.concatenate(((0.0,), np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    at = np.arange(STEP_M, way[-1], STEP_M)
    places = np.stack([np.interp(at, way, points[:, k]) for k in range(3)], axis=1)
    ahead = np.stack([np.interp(np.minimum(at + 0.5, way[-1]), way, points[:, k]) for k in range(3)], axis=1) - places
    for place, (x, y, _) in zip(places, ahead, strict=True):
        wanted = float(np.arctan2(y, x)) if np.hypot(x, y) > 0.1 else yaw
        off = (wanted - yaw + np.pi) % (2 * np.pi) - np.pi
        if abs(off) > 8 * STEP_RAD:
            yaw = _turn(poses, place, yaw, yaw + off)
        else:
            yaw += float(np.clip(off, -STEP_RAD, STEP_RAD))
            poses.append(pose_of(place, yaw, PITCH))
    return yaw


def film(storey: Storey, noise: int = 0) -> list[PosedFrame]:
    """The walk as frames with true poses; each ``noise`` gives the sensors other noise."""
    poses = walk(storey)
    storey = replace(storey, scene=replace(storey.scene, seed=storey.scene.seed + 1_000_000 * noise))
    frames: list[PosedFrame] = []
    for seq, view in enumerate(survey_views(storey, poses, CAMERA, NoiseConfig())):
        stamp_ns = (seq + 1) * FRAME_NS
        frames.append(PosedFrame(stamp_ns, seq, "walk", view.rgb, view.depth_m, None, CAMERA, poses[seq], "truth"))
    return frames


def surface(frames: Sequence[PosedFrame], poses: Float64) -> Float64:
    """Points (N, 3) of the map at these poses; frames without one are left out."""
    voxel_map = VoxelMap(VoxelMapConfig(voxel_size_m=VOXEL_M), ROOMS)
    for frame, pose in zip(frames, poses, strict=True):
        if np.isfinite(pose).all() and frame.depth_m is not None:
            voxel_map.integrate(replace(frame, T_world_camera=pose), frame.depth_m, None)
    return voxel_map.points().xyz.astype(np.float64)


def measure(frames: Sequence[PosedFrame], truth: Float64, config: OdometryPoses) -> dict[str, Any]:
    """Figures of one run; metres, degrees, milliseconds; of the world with the most poses. None without half of them.

    Errors "as they came" are those of the poses before corrections, from where the world began, not aligned.
    """
    run = follow(frames, config)
    found, given = np.array(run.estimated), np.array(run.given)
    known = np.isfinite(found[:, 0, 0])
    if known.mean() < 0.5:
        return {"with_pose": float(known.mean())}
    came = np.array(run.as_they_came)[known]
    off_came = np.linalg.norm(came[:, :3, 3] - given[known, :3, 3], axis=1)
    off = cKDTree(truth).query(surface(frames, found))[0]
    return {
        "frames": len(found),
        "way_m": float(np.linalg.norm(np.diff(given[:, :3, 3], axis=0), axis=1).sum()),
        "with_pose": float(known.mean()),
        "ate_m": absolute_trajectory_error(found[known], given[known]).rmse_m,
        "ate_as_they_came_m": absolute_trajectory_error(came, given[known]).rmse_m,
        "largest_as_they_came_m": float(off_came.max()),
        "within_3_sigma": float((off_came <= 3 * np.array(run.sigma_m)[known] + 1e-9).mean()),
        "rpe_m": relative_pose_error(found[known], given[known], 20).rmse_m,
        "rpe_deg": relative_pose_error(found[known], given[known], 20).rmse_deg,
        "surface_median_m": float(np.median(off)),
        "surface_p90_m": float(np.quantile(off, 0.9)),
        "surface_beyond_6_cm": float((off > 0.06).mean()),
        "corrections": run.corrections,
        "processor_ms": {q: float(np.percentile(run.processor_ms, q)) for q in (50, 95, 99)},
        **run.counters,
    }


def spread(rows: list[dict[str, Any]], name: str, times: float, unit: str) -> str:
    """Median of runs, and the least and the greatest."""
    values = np.array([r.get(name, np.nan) for r in rows]) * times
    median, low, high = (f"{v:.0f}" for v in (np.nanmedian(values), np.nanmin(values), np.nanmax(values)))
    return f"{median} ({low} to {high}){unit}"


def table(rows: list[dict[str, Any]]) -> str:
    """One line for each storey, without loop closure and with it."""
    lines = [
        "| storey | loop closure | runs | frames with a pose | ATE | ATE, as they came | largest error, as they came "
        "| map, 90 % | map, beyond 6 cm | loops closed |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for seed, closes in dict.fromkeys((r["seed"], r["loop_closure"]) for r in rows):
        runs = [r for r in rows if (r["seed"], r["loop_closure"]) == (seed, closes)]
        posed = spread(runs, "with_pose", 100, " %")
        done = [r for r in runs if "ate_m" in r]
        if not done:
            lines.append(f"| {seed} | {'on' if closes else 'off'} | {len(runs)} | {posed} |" + " |" * 6)
            continue
        mm = ("ate_m", "ate_as_they_came_m", "largest_as_they_came_m", "surface_p90_m")
        cells = [spread(done, name, 1000, " mm") for name in mm]
        cells.append(spread(done, "surface_beyond_6_cm", 100, " %"))
        cells.append(spread(done, "loops_closed", 1, "") if closes else "")
        lines.append(f"| {seed} | {'on' if closes else 'off'} | {len(runs)} | {posed} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run it, and print a table after each pass."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(200_000, 200_006)))
    parser.add_argument("--noise", type=int, default=3, help="passes, each with noise of its own")
    parser.add_argument("--area", type=float, default=32.0, help="of a storey, square metres")
    parser.add_argument("--json", type=Path, help="the figures, for programs")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for noise in range(given.noise):
        for seed in given.seeds:
            frames = film(make_storey(seed, given.area), noise)
            truth = surface(frames, np.array([f.T_world_camera for f in frames]))
            for closes in (False, True):
                run = measure(frames, truth, OdometryPoses(loop_closure=closes))
                rows.append({"seed": seed, "noise": noise, "loop_closure": closes, **run})
                if given.json is not None:
                    given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
        print(table(rows), flush=True)


if __name__ == "__main__":
    main()
