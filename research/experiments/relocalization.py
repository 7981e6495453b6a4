"""How often a frame is found again in a map, how well, how fast, and how often in a map of another place.

``kitchen`` maps frames 0 to 99 of a log and looks for frames 100 to 199, whose poses are withheld. ``rooms`` maps test
rooms and looks for views beside the mapped way in other light, and for views of other rooms, and of the same room
mirrored, in which nothing may be found. Every frame counts alone: a live mapper waits for several that agree, and
``kitchen`` tells where that would put a camera that starts at any of its frames.

Example: python -m research.experiments.relocalization kitchen kitchen.mcap
         python -m research.experiments.relocalization rooms --rooms 20 --out rooms.json
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from research.experiments.put_things import map_frame
from research.scenes import (
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    NoiseConfig,
    RoomConfig,
    camera_path,
    make_room,
    room_frames,
)
from research.scenes.camera import clearance
from research.scenes.render import render_view
from research.scenes.scene import Scene
from semantic_mapper.config import VoxelMapConfig, convert_config
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.labels import ROOMS
from semantic_mapper.localization.features import find_place_features
from semantic_mapper.localization.places import MAX_FEATURES, PlaceStore, make_place
from semantic_mapper.localization.relocalizer import (
    NotFound,
    Relocalized,
    Relocalizer,
    Sighting,
    agreed,
    find_consensus,
    sighting,
)
from semantic_mapper.mapping.odometry_sessions import REMEMBERED
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

CAMERA = CameraIntrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
MAPPED = 80  # frames of each room
SPLITS = {"test": TEST_SEEDS, "validation": VALIDATION_SEEDS, "train": TRAIN_SEEDS[:20]}
PLACES = 20  # looked for in each room, and from other rooms
NOISE = NoiseConfig()
OTHER_LIGHT = NoiseConfig(exposure_stops=0.8, white_balance=0.25)
AHEAD_M = 3.0  # errors of a world that was found are measured so far ahead of the camera
WITHIN_M, WITHIN_DEG = 0.10, 3.0  # of the truth: further off, a frame that was "found" was found falsely


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """A map and what finds frames in it."""

    relocalizer: Relocalizer
    voxel_map: VoxelMap
    places: PlaceStore


def map_frames(frames: Iterable[PosedFrame]) -> Mapped:
    """Map frames with their labels as votes, and keep places as the pipeline does."""
    voxel_map, places = VoxelMap(VoxelMapConfig(), ROOMS), PlaceStore()
    for frame in frames:
        map_frame(voxel_map, frame)
        if places.wants(frame.T_world_camera) and frame.depth_m is not None:
            features = find_place_features(frame.rgb, frame.depth_m, MAX_FEATURES)
            places.add(make_place(frame.camera_id, frame.stamp_ns, frame.T_world_camera, features, frame.intrinsics))
    return Mapped(Relocalizer(places.places, voxel_map, ROOMS.ignore_id), voxel_map, places)


def look_for(mapped: Mapped, frame: PosedFrame, truth: Float64 | None) -> dict[str, Any]:
    """One query. Without a truth, whatever is found is false."""
    began = time.process_time()
    label = frame.label
    classify = None if label is None else lambda: label
    found = mapped.relocalizer.find(frame.rgb, frame.depth_m, frame.intrinsics, classify)
    seconds = time.process_time() - began
    row: dict[str, Any] = {"found": isinstance(found, Relocalized), "cpu_s": seconds, "inliers": found.inliers}
    row["reason"] = found.reason if isinstance(found, NotFound) else ""
    if truth is not None and isinstance(found, Relocalized):
        row["T_map_camera"] = found.T_map_camera.tolist()
        off = invert_pose(truth) @ found.T_map_camera
        row["off_m"] = float(np.linalg.norm(off[:3, 3]))
        row["off_deg"] = float(np.rad2deg(np.linalg.norm(rotation_vector(off))))
    row["false"] = row["found"] and not (row.get("off_m", 9.0) <= WITHIN_M and row.get("off_deg", 99) <= WITHIN_DEG)
    return row


def lock(seen: Iterable[Sighting | None]) -> tuple[int, Float64] | None:
    """By how many frames, found or not (None), enough agree on where their world is in the map; and T_map_world."""
    found = list[Sighting]()
    for number, one in enumerate(seen, 1):
        found += [] if one is None else [one]
        if not (consensus := find_consensus(found[-REMEMBERED:])).refusal:
            return number, agreed(consensus.agreeing)
    return None


def locked_in(rows: list[dict[str, Any]], frames: list[PosedFrame]) -> dict[str, Any]:
    """How far off a mapper would lock in the world of a camera that starts at any of these frames."""
    seen = [
        sighting(np.array(row["T_map_camera"]), frame.T_world_camera) if row["found"] else None
        for row, frame in zip(rows, frames, strict=True)
    ]
    ahead, errors = np.array([f.T_world_camera @ (0, 0, AHEAD_M, 1) for f in frames]), list[float]()
    for _, T_map_world in filter(None, (lock(seen[start:]) for start in range(len(seen)))):
        errors.append(float(np.median(np.linalg.norm((ahead @ T_map_world.T - ahead)[:, :3], axis=1))))
    p50, p95, worst = np.percentile(errors, (50, 95, 100)).round(4).tolist()
    return {"starts": len(errors), "ahead_m_p50": p50, "ahead_m_p95": p95, "ahead_m_worst": worst}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of queries that can be answered, or of those that cannot."""
    found = [r for r in rows if r["found"]]
    told = {
        "queries": len(rows),
        "found": len(found),
        "false": sum(r["false"] for r in rows),
        "cpu_s_median": float(np.median([r["cpu_s"] for r in rows])),
        "cpu_s_p95": float(np.percentile([r["cpu_s"] for r in rows], 95)),
        "refused": dict(Counter(r["reason"] for r in rows if not r["found"]).most_common()),
    }
    off = np.array([(r["off_m"], r["off_deg"]) for r in found if "off_m" in r]).reshape(-1, 2)
    if len(off):
        for name, of in (("median", 50), ("p95", 95)):
            told |= dict(zip((f"{name}_m", f"{name}_deg"), np.percentile(off, of, axis=0).tolist(), strict=True))
    return told


def kitchen(log_path: Path, places: int) -> dict[str, Any]:
    """Map the first half of a log and look for the second, among ``places`` that are there at least."""
    with open_log((log_path,)) as log:
        frames = [f for f in log.frames_or_errors(200) if isinstance(f, PosedFrame)]
    plain = [replace(f, label=None) for f in frames]
    mapped = map_frames(plain[:100])
    own, rng = mapped.places.places, np.random.default_rng(0)
    shuffled = [
        replace(own[n % len(own)], descriptors=rng.permuted(own[n % len(own)].descriptors, axis=1))
        for n in range(max(0, places - len(own)))
    ]
    relocalizer = Relocalizer((*own, *shuffled), mapped.voxel_map, ROOMS.ignore_id)
    mapped = replace(mapped, relocalizer=relocalizer)
    rows = [look_for(mapped, f, f.T_world_camera) for f in plain[100:]]
    return {"kitchen": summary(rows) | locked_in(rows, plain[100:])}


def beside(scene: Scene, pose: Float64, rng: np.random.Generator) -> Float64:
    """A pose 0.3 to 0.5 m beside one of the way, turned by 20 degrees, where there is room for a camera."""
    for _ in range(200):
        shift = rng.normal(size=3) * (1, 1, 0.3)
        moved = pose.copy()
        moved[:3, 3] += shift / np.linalg.norm(shift) * rng.uniform(0.3, 0.5)
        if clearance(scene, moved[None, :3, 3])[0] > 0.2:
            axis = rng.normal(size=3) * (0.3, 0.3, 1.0)  # mostly about the vertical
            turn = np.asarray(cv2.Rodrigues(axis / np.linalg.norm(axis) * np.deg2rad(20.0))[0], np.float64)
            moved[:3, :3] = turn @ pose[:3, :3]
            return moved
    return pose


def other_light(rgb: UInt8, rng: np.random.Generator) -> UInt8:
    """Another gamma, brightness and colour of light."""
    light = rng.uniform(0.6, 1.2) * rng.uniform(0.85, 1.15, 3)
    return np.clip(255 * (rgb / 255.0) ** rng.uniform(0.65, 1.5) * light, 0, 255).astype(np.uint8)


def queries(scene: Scene, seed: int, way: Float64, count: int) -> list[PosedFrame]:
    """Views beside the way in other light."""
    rng = np.random.default_rng(seed)
    views = []
    for number in range(count):
        pose = beside(scene, way[int(rng.integers(len(way)))], rng)
        view = render_view(scene, CAMERA, pose, noise=seed * 1009 + number, noise_config=OTHER_LIGHT)
        rgb = other_light(view.rgb, rng)
        views.append(PosedFrame(number + 1, number, "rooms", rgb, view.depth_m, None, CAMERA, pose))
    return views


def mirrored(frame: PosedFrame) -> PosedFrame:
    """What a camera would see in the mirrored room."""
    assert frame.depth_m is not None
    return replace(
        frame, rgb=np.ascontiguousarray(frame.rgb[:, ::-1]), depth_m=np.ascontiguousarray(frame.depth_m[:, ::-1])
    )


def rooms(seeds: range, out: Path | None) -> dict[str, Any]:
    """All rooms; a wrong room is the next one, furnished from the same template."""
    rows: dict[str, list[dict[str, Any]]] = {"same room": [], "other room": [], "mirrored": []}
    for seed in seeds:
        scene = make_room(seed, RoomConfig())
        mapped = map_frames(room_frames(seed, MAPPED, CAMERA, noise=NOISE))
        asked = queries(scene, seed, camera_path(scene, MAPPED, seed), PLACES)
        like_it = convert_config({"template": scene.template}, RoomConfig, "the other room")
        other = make_room(seed + 777, like_it)
        other_way = camera_path(other, MAPPED, seed + 777)
        rows["same room"] += [look_for(mapped, f, f.T_world_camera) for f in asked]
        rows["other room"] += [look_for(mapped, f, None) for f in queries(other, seed + 777, other_way, PLACES)]
        rows["mirrored"] += [look_for(mapped, mirrored(f), None) for f in asked]
        told = {name: f"{sum(r['found'] for r in some[-PLACES:])}/{PLACES}" for name, some in rows.items()}
        print(seed, len(mapped.places), told, flush=True)
        if out is not None:
            out.write_text(json.dumps(rows))
    return {name: summary(some) for name, some in rows.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of_kitchen = commands.add_parser("kitchen", help="frames 100 to 199 in a map of 0 to 99")
    of_kitchen.add_argument("log", type=Path)
    of_kitchen.add_argument("--places", type=int, default=0, help="fill the map up with shuffled ones to this number")
    of_rooms = commands.add_parser("rooms", help="test rooms in other light, other rooms, mirrored rooms")
    of_rooms.add_argument("--rooms", type=int, default=len(TEST_SEEDS))
    of_rooms.add_argument("--split", choices=tuple(SPLITS), default="test")
    of_rooms.add_argument("--out", type=Path, help="write every query there (JSON)")
    args = parser.parse_args()
    if args.command == "kitchen":
        print(json.dumps(kitchen(args.log, args.places), indent=1))
        return
    found = rooms(SPLITS[args.split][: args.rooms], args.out)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
