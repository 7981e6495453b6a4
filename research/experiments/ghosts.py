"""What becomes of a thing that leaves the scene, and of all that stays, with ``voxel_map.clear_free_space`` on and off.

``gone`` draws a box or a person-sized cylinder into depth and colour of ten frames of a log or of a test room; then the
same camera goes on without it. Of each of its surface points in the map it counts the frames that see through it, and
looks whether the point is there after the fifth, and whether the instance that the thing was is reported as gone.
``static`` replays a log ten times into one map. ``cost`` maps the
same frames with clearing on and off in turns.

Example: python -m research.experiments.ghosts gone rooms --picture ghost.png
         python -m research.experiments.ghosts gone kitchen.mcap
         python -m research.experiments.ghosts static kitchen.mcap --mesh redkitchen/mesh_labels.npz
         python -m research.experiments.ghosts cost kitchen.mcap
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig, room_frames
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.evaluation.splat import draw_points
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.labels import ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import write_picture
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

SHOWN = 10  # frames that the thing stands in view for
AFTER = 5  # frames that see through a point before it has to be gone
PLAYS = 10  # of the log into one map
STARTS = 5  # places in a log where a thing is put
BEHIND_M = 0.1  # a frame sees through a point where it measures at least this much more than its depth
COLOR = (200, 30, 160)
ROOM_CAMERA = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
ROOM_FRAMES = 120


class Thing(NamedTuple):
    """A box or an upright cylinder.

    Args:
        T_thing_world: (4, 4), z up in the thing, its centre at 0.
        half_m: Half of its sides (3,); of a cylinder the first is its radius.
        is_round: A cylinder.
    """

    T_thing_world: Float64
    half_m: Float64
    is_round: bool

    def hit(self, camera: Float64, rays: Float64) -> Float64:
        """Where rays (N, 3) from a point (3,) in the world enter it, in lengths of the ray; inf = never."""
        origin, rays = transform(self.T_thing_world, camera), rays @ self.T_thing_world[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = (np.stack((-self.half_m, self.half_m)) - origin)[:, None] / rays  # (2, N, 3)
            enter, leave = ends.min(axis=0), ends.max(axis=0)
            if self.is_round:
                a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ origin[:2]
                root = np.sqrt(b * b - a * ((origin[:2] ** 2).sum() - self.half_m[0] ** 2))  # NaN: passes by
                enter = np.stack(((-b - root) / a, enter[:, 2]), axis=1)
                leave = np.stack(((-b + root) / a, leave[:, 2]), axis=1)
            near, far = enter.max(axis=1), leave.min(axis=1)
        return np.where((near < far) & (near > 0), near, np.inf)


def with_thing(frame: PosedFrame, thing: Thing, class_id: int) -> PosedFrame:
    """The frame as if the thing had stood there, in front of what it hides; of a class where the frame has labels."""
    k, depth = frame.intrinsics, frame.depth_m
    assert depth is not None
    v, u = np.indices(depth.shape)
    rays = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(depth.shape)), axis=-1).reshape(-1, 3)
    z = thing.hit(frame.T_world_camera[:3, 3], rays @ frame.T_world_camera[:3, :3].T).reshape(depth.shape)
    hides = np.isfinite(z) & ((depth == 0) | (z < depth))
    rgb = np.where(hides[..., None], np.array(COLOR, np.uint8), frame.rgb)
    label = None if frame.label is None else np.where(hides, class_id, frame.label).astype(np.uint8)
    return replace(frame, depth_m=np.where(hides, z, depth).astype(np.float32), rgb=rgb, label=label)


def place_thing(frame: PosedFrame, up: Float64, half_m: Sequence[float], is_round: bool) -> Thing:
    """In the middle of a view, before what is there."""
    assert frame.depth_m is not None
    h, w = frame.depth_m.shape
    middle = frame.depth_m[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3]
    z = 0.65 * float(np.median(middle[middle > 0]))
    x = np.cross(up, frame.T_world_camera[:3, 2])
    x /= np.linalg.norm(x)
    T_world_thing = np.eye(4)
    T_world_thing[:3, :3] = np.stack((x, np.cross(up, x), up), axis=1)
    T_world_thing[:3, 3] = transform(frame.T_world_camera, np.array([0.0, 0.0, z]))
    return Thing(invert_pose(T_world_thing), np.array(half_m), is_round)


def map_frame(voxel_map: VoxelMap, frame: PosedFrame) -> None:
    """Fuse a frame, with its labels as votes where it has any."""
    assert frame.depth_m is not None
    labels = voxel_map.label_set
    if frame.label is None:
        voxel_map.integrate(frame, frame.depth_m, None)
        return
    rows = labels.to_channels(frame.label, "label").astype(np.int32)
    rows[(rows < 0) | (rows >= len(labels))] = -1
    table = np.full((len(labels), len(labels)), 0.1 / (len(labels) - 1), np.float32)
    np.fill_diagonal(table, 0.9)
    voxel_map.integrate(frame, frame.depth_m, table, rows=rows)


class Gone(NamedTuple):
    """What came of one thing.

    Args:
        points: Surface points of the thing in the map.
        due: Those of them that ``AFTER`` frames saw through.
        left: Those of these that were still there then.
        left_at_end: And after all frames.
        instances: 1 where the thing was an instance of its own.
        gone: 1 where that was reported as gone.
        gone_at: How many frames after the thing had left; -1 = never.
        gone_others: Instances that were reported as gone though they were not the thing.
    """

    points: int
    due: int
    left: int
    left_at_end: int
    instances: int
    gone: int
    gone_at: int
    gone_others: int


def show_and_go(
    frames: Sequence[PosedFrame], start: int, thing: Thing, labels: LabelSet, clears: bool
) -> tuple[Gone, list[MapPoints]]:
    """Map ``SHOWN`` frames with the thing, then all others without; also the map after these and at the end."""
    config = VoxelMapConfig(clear_free_space=clears)
    shown, bare = VoxelMap(config, labels), VoxelMap(config, labels)
    mirror, tracker = MapMirror.of(shown), InstanceTracker()
    class_id = labels.thing_ids(STUFF_NAMES)[-1]
    for frame in frames[start : start + SHOWN]:
        map_frame(shown, with_thing(frame, thing, class_id))
        map_frame(bare, frame)
    things = tracker.update(mirror.apply(shown.changes(mirror.version)))
    pictures = [shown.points()]
    xyz = pictures[0].xyz.astype(np.float64)
    apart = 2 * config.voxel_size_m
    xyz = xyz[KDTree(bare.points().xyz).query(xyz, distance_upper_bound=apart)[0] > apart]
    near = [KDTree(xyz).query(t.voxels * config.voxel_size_m, distance_upper_bound=apart)[0] <= apart for t in things]
    own = {t.id for t, n in zip(things, near, strict=True) if t.class_id == class_id and n.mean() > 0.5}
    seen, left = np.zeros(len(xyz), int), 0
    there = np.zeros(len(xyz), bool)
    later = (*frames[start + SHOWN :], *frames[: start + SHOWN])
    for frame in later:
        map_frame(shown, frame)
        tracker.update(mirror.apply(shown.changes(mirror.version)))
        looks = sees_through(frame, xyz)
        due = looks & (seen == AFTER - 1)
        seen += looks
        if due.any():
            there = _is_there(shown, xyz)
            left += int((there & due).sum())
    pictures.append(shown.points())
    at_end = int((_is_there(shown, xyz) & (seen >= AFTER)).sum())
    gone = [t for t in tracker.gone if t.id in own]
    gone_at = [n for n, frame in enumerate(later, 1) if gone and frame.stamp_ns == gone[0].gone_ns] or [-1]
    told = (
        int(bool(own)),
        int(bool(gone)),
        gone_at[0],
        sum(t.id <= len(things) and t.id not in own for t in tracker.gone),
    )
    return Gone(len(xyz), int((seen >= AFTER).sum()), left, at_end, *told), pictures


def sees_through(frame: PosedFrame, xyz: Float64) -> NDArray[np.bool_]:
    """Which points (N, 3) of the world lie well in front of what a frame measures at their pixel."""
    assert frame.depth_m is not None
    k = frame.intrinsics
    p = transform(invert_pose(frame.T_world_camera), xyz)
    z = np.maximum(p[:, 2], 1e-6)
    u, v = np.rint(k.fx * p[:, 0] / z + k.cx), np.rint(k.fy * p[:, 1] / z + k.cy)
    inside = (p[:, 2] > 0.2) & (u >= 0) & (v >= 0) & (u < k.width) & (v < k.height)
    depth = frame.depth_m[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
    return inside & (depth <= VoxelMapConfig().depth_max_m) & (depth > p[:, 2] + BEHIND_M)


def _is_there(voxel_map: VoxelMap, xyz: Float64) -> NDArray[np.bool_]:
    reach = voxel_map.config.voxel_size_m
    return KDTree(voxel_map.points().xyz).query(xyz, distance_upper_bound=reach)[0] <= reach


def run_gone(given: argparse.Namespace) -> dict[str, Any]:
    """Things in a log or in test rooms."""
    walks: list[tuple[str, list[PosedFrame], LabelSet, list[int]]] = []
    if given.log == "rooms":
        for seed in TEST_SEEDS[: given.rooms]:
            path = CameraPathConfig(step_m=0.03)
            noise = None if given.exact else NoiseConfig()
            walk = list(room_frames(seed, ROOM_FRAMES, ROOM_CAMERA, path=path, noise=noise))
            walks.append((f"room {seed}", walk, ROOMS, [0]))
    else:
        frames, labels = _read(Path(given.log))
        walks.append((given.log, frames, labels, [n * len(frames) // STARTS for n in range(STARTS)]))
    result: dict[str, Any] = {}
    for name, half, is_round in (("box", (0.2, 0.2, 0.2), False), ("person", (0.25, 0.25, 0.85), True)):
        for clears in (True, False):
            found: list[Gone] = []
            for where, frames, labels, starts in walks:
                up = camera_up(np.stack([f.T_world_camera for f in frames]))
                for start in starts:
                    thing = place_thing(frames[start], up, half, is_round)
                    gone, pictures = show_and_go(frames, start, thing, labels, clears)
                    found.append(gone)
                    print(name, "on" if clears else "off", where, start, gone, flush=True)
                    if given.picture and name == "person" and clears and len(found) == 1:
                        _draw(given.picture, frames[start], pictures)
            total = Gone(*(sum(column) for column in zip(*found, strict=True)))
            result[f"{name}, clearing {'on' if clears else 'off'}"] = {
                **total._replace(gone_at=0)._asdict(),
                "gone_at": sorted(one.gone_at for one in found),
                "cleared_in_time": 1 - total.left / max(total.due, 1),
            }
    return result


def run_static(given: argparse.Namespace) -> dict[str, Any]:
    """A log, again and again into one map."""
    frames, labels = _read(Path(given.log))
    mesh = np.load(given.mesh) if given.mesh else None
    maps: dict[bool, Float64] = {}
    result: dict[str, Any] = {}
    for clears in (False, True):
        config = VoxelMapConfig(clear_free_space=clears, no_return_range_m=given.no_return)
        voxel_map = VoxelMap(config, labels)
        for play in range(PLAYS):
            for frame in frames:
                map_frame(voxel_map, frame)
            print("on" if clears else "off", "play", play, "cleared", voxel_map.cleared, flush=True)
        maps[clears] = voxel_map.points().xyz.astype(np.float64)
        figures: dict[str, Any] = {"points": len(maps[clears]), "cleared_voxels": voxel_map.cleared}
        if mesh is not None:
            figures |= _against_mesh(maps[clears], mesh["vertices"], mesh["faces"])
        result["on" if clears else "off"] = figures
    reach = VoxelMapConfig().voxel_size_m
    lost = KDTree(maps[True]).query(maps[False], distance_upper_bound=reach)[0] > reach
    result["lost_fraction"] = float(lost.mean())
    if mesh is not None:  # of what the mesh says is there
        real = _distance(maps[False], mesh["vertices"], mesh["faces"]) < reach
        result["lost_fraction_of_mesh"] = float(lost[real].mean())
        result["lost_that_is_off_the_mesh"] = float((~real)[lost].mean()) if lost.any() else 0.0
    return result


def run_cost(given: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds of fusing a frame, each frame with clearing on and off, in alternating order."""
    frames, labels = _read(Path(given.log))
    maps = {on: VoxelMap(VoxelMapConfig(clear_free_space=on), labels) for on in (False, True)}
    took: list[tuple[float, float, float, float]] = []
    for play in range(3):
        for number, frame in enumerate(frames):
            ms, cpu_ms = {}, {}
            for on in (True, False) if (number + play) % 2 else (False, True):
                start, cpu_start = time.perf_counter(), time.process_time()
                map_frame(maps[on], frame)
                ms[on] = (time.perf_counter() - start) * 1e3
                cpu_ms[on] = (time.process_time() - cpu_start) * 1e3
            if play:  # the first lets the maps grow
                took.append((ms[False], ms[True], cpu_ms[False], cpu_ms[True]))
    off, on, cpu_off, cpu_on = np.array(took).T
    return {
        "off_ms": np.percentile(off, (50, 95)).round(2).tolist(),
        "on_ms": np.percentile(on, (50, 95)).round(2).tolist(),
        "difference_ms": np.percentile(on - off, (25, 50, 75, 95)).round(2).tolist(),
        "cpu_difference_ms": float((cpu_on - cpu_off).mean().round(2)),  # of all threads
        "frames": len(took),
    }


def _read(path: Path) -> tuple[list[PosedFrame], LabelSet]:
    with open_log(path) as log:
        return list(log), log.info.label_set or ROOMS


def _against_mesh(xyz: Float64, vertices: Float32, faces: NDArray[Any]) -> dict[str, float]:
    return {
        "median_mm": float(np.median(_distance(xyz, vertices, faces))) * 1e3,
        "completeness_5cm": float((KDTree(xyz).query(vertices, distance_upper_bound=0.05)[0] <= 0.05).mean()),
    }


def _distance(xyz: Float64, vertices: Float32, faces: NDArray[Any]) -> Float32:
    scene, tensor = load_open3d().t.geometry.RaycastingScene(), load_open3d().core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene.compute_distance(tensor(xyz.astype(np.float32))).numpy()


def _draw(path: Path, frame: PosedFrame, maps: Sequence[MapPoints]) -> None:
    """The maps side by side, as the first camera saw them from some way back."""
    pictures: list[UInt8] = []
    camera = None
    for points in maps:
        view = transform(invert_pose(frame.T_world_camera), points.xyz.astype(np.float64))
        if camera is None:
            low, high = np.percentile(view[:, :2], (2, 98), axis=0)
            camera = ((low + high) / 2, float(min(400 / (high - low)[0], 300 / (high - low)[1])))
        pictures.append(draw_points(view, points.rgb, (400, 300), (255, 255, 255), camera=camera)[0])
    write_picture(path, np.concatenate(pictures, axis=1))


def _runs() -> Iterator[tuple[str, Any]]:
    yield "gone", run_gone
    yield "static", run_static
    yield "cost", run_cost


def main() -> None:
    """Print the figures of one of the three as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", choices=[name for name, _ in _runs()])
    parser.add_argument("log", help="a log, or (gone) `rooms`")
    parser.add_argument("--rooms", type=int, default=3, help="test rooms")
    parser.add_argument("--exact", action="store_true", help="rooms without noise and holes in depth")
    parser.add_argument("--mesh", type=Path, help="vertices and faces of the reference, .npz")
    parser.add_argument("--no-return", type=float, default=0.0, help="metres that missing depth clears (static)")
    parser.add_argument("--picture", type=Path, help="PNG of the map before and after")
    given = parser.parse_args()
    print(json.dumps(dict(_runs())[given.run](given), indent=1))


if __name__ == "__main__":
    main()
