"""A film without poses against the true ones: frames placed, error of the path, focal length found, CPU time.

The film is made here: of the pictures of a sequence folder (with its poses as truth), or of a rendered walk through a
ROOMS room, with auto exposure and, with ``--rolling-shutter``, rows that are read one after the other.

``aligned.mcap`` is the log of the film in the world and the metres of the true poses: what ``map`` makes of it can
be compared with a mesh.

Example: python -m research.experiments.video path/to/redkitchen --focal-error 0.1 --out runs/video
Example: python -m research.experiments.video rooms --seed 200003 --rolling-shutter 0.02 --out runs/video-room
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import msgspec
import numpy as np

from research.plots import draw_paths
from research.scenes.camera import camera_path
from research.scenes.config import CameraPathConfig, NoiseConfig
from research.scenes.render import render_view
from research.scenes.room import make_room
from research.scenes.shots import sequence_shots
from semantic_mapper.geometry import align_similar, interpolate_pose, transform
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.importers.base import ImportOptions
from semantic_mapper.replay.importers.folder import open_folder
from semantic_mapper.replay.log.format import atomic_log
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.reconstruct import PACKING, FilmOptions, import_film
from semantic_mapper.replay.sfm.scale import ScaleHint
from semantic_mapper.transport.messages import SCALE_KEY
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

ROOM_HZ = 15.0
ROW_BANDS = 8  # that a rolling shutter is made of


@dataclass(frozen=True, slots=True)
class Walk:
    """Pictures (H, W, 3) RGB with the true poses."""

    pictures: Iterator[UInt8]
    poses: Float64
    hz: float
    focal_px: float
    size: tuple[int, int]
    T_level_world: Float64  # (4, 4) to a world with z up, its floor at 0


def recorded_walk(folder: Path, first: int, count: int) -> Walk:
    """Some pictures of a sequence folder; ``mesh_labels.npz`` beside them says where its floor is."""
    recording = open_folder(folder, ImportOptions())
    frames = [recording.load(n).frame for n in range(first, min(first + count, len(recording)))]
    k = frames[0].intrinsics
    poses = np.stack([f.T_world_camera for f in frames])
    mesh = folder / "mesh_labels.npz"
    level = np.load(mesh)["T_gravity"] if mesh.exists() else np.eye(4)
    return Walk((f.rgb for f in frames), poses, recording.info.frame_hz, k.fx, (k.width, k.height), level)


def room_walk(seed: int, count: int, width: int, step_m: float, shutter: float) -> Walk:
    """A hand-held walk through the room of a seed.

    Args:
        seed: Of room, path and camera.
        count: Frames.
        width: Of the pictures, which are 4:3.
        step_m: Mean way between two frames.
        shutter: Fraction of the time between two frames that the rows take to be read; 0 = all at once.
    """
    height = 3 * width // 4
    k = CameraIntrinsics(0.85 * width, 0.85 * width, (width - 1) / 2, (height - 1) / 2, width, height)
    scene, config = make_room(seed), NoiseConfig(depth="none")
    poses = camera_path(scene, count, seed, CameraPathConfig(step_m=step_m))
    shots = sequence_shots(poses, seed, config)

    def take(n: int, fraction: float) -> UInt8:
        after = poses[min(n + 1, count - 1)]
        pose = interpolate_pose(poses[n], after, fraction)
        return render_view(scene, k, pose, noise=seed + n, noise_config=config, shot=shots[n]).rgb

    def pictures() -> Iterator[UInt8]:
        for n in range(count):
            if not shutter:
                yield take(n, 0.0)
                continue
            edges = np.linspace(0, height, ROW_BANDS + 1).astype(int)
            picture = np.empty((height, width, 3), np.uint8)
            for band, (top, bottom) in enumerate(pairwise(edges)):
                # The pose that counts is that of the middle row.
                picture[top:bottom] = take(n, shutter * (band + 0.5) / ROW_BANDS)[top:bottom]
            yield picture

    true = [interpolate_pose(poses[n], poses[min(n + 1, count - 1)], shutter / 2) for n in range(count)]
    return Walk(pictures(), np.stack(true), ROOM_HZ, k.fx, (width, height), np.eye(4))


def write_film(path: Path, walk: Walk) -> None:
    """Write an mp4 file."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), walk.hz, walk.size)
    for rgb in walk.pictures:
        writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    writer.release()


def write_aligned(log: Path, T_true_film: Float64, scale: float) -> None:
    """Write ``aligned.mcap`` beside the log of a film: its world moved and scaled to that of the true poses."""
    with LogReader(log) as reader:
        metadata = {**reader.info.metadata, SCALE_KEY: "aligned with true poses"}
        info = msgspec.structs.replace(reader.info, metadata=metadata)
        with atomic_log(log.with_name("aligned.mcap"), info, options=PACKING, overwrite=True) as writer:
            for frame in reader:
                pose = frame.T_world_camera.copy()
                pose[:3, 3] *= scale
                writer.write_frame(replace(frame, T_world_camera=T_true_film @ pose))


def main() -> None:
    """Run one film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", help="sequence folder, or 'rooms'")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--focal-error", type=float, default=0.1, help="of the guess; nan = no guess")
    parser.add_argument("--seed", type=int, default=200_003)
    parser.add_argument("--first", type=int, default=0, help="frame of a sequence folder")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--camera-height", action="store_true", help="scale by the true height over the floor")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--step", type=float, default=0.03)
    parser.add_argument("--rolling-shutter", type=float, default=0.0)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.walk == "rooms":
        walk = room_walk(given.seed, given.frames, given.width, given.step, given.rolling_shutter)
    else:
        walk = recorded_walk(Path(given.walk), given.first, given.frames)
    film = given.out / "film.mp4"
    write_film(film, walk)
    prior = None if np.isnan(given.focal_error) else walk.focal_px * (1 + given.focal_error)
    began = time.process_time()
    height_m = float(np.median((walk.T_level_world @ walk.poses)[:, 2, 3]))
    hint = ScaleHint(camera_height_m=height_m) if given.camera_height else ScaleHint()
    options = FilmOptions(focal_prior_px=prior, scale=hint)
    report = import_film(film, given.out / "film.mcap", options, lambda *_: None, overwrite=True)
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    with LogReader(given.out / "film.mcap") as log:
        seqs = [frame.seq for frame in log]
    truth = walk.poses[seqs]
    found, true = report.T_world_camera[:, :3, 3], truth[:, :3, 3]
    T, scale = align_similar(found, true)
    aligned = transform(T, scale * found)
    write_aligned(given.out / "film.mcap", T, scale)
    off = np.linalg.norm(aligned - true, axis=1)
    up = walk.T_level_world[:3, :3] @ T[:3, 2]
    figures = {
        "frames": len(walk.poses),
        "in the log": len(report.T_world_camera),
        "fraction": round(len(report.T_world_camera) / len(walk.poses), 4),
        "placed by SfM": f"{report.note.registered} of {report.note.picked}",
        "left out": report.note.left_out,
        "ATE, cm": {n: round(100 * float(v), 2) for n, v in (("rmse", np.sqrt((off**2).mean())), ("max", off.max()))},
        "way, m": round(float(np.linalg.norm(np.diff(walk.poses[:, :3, 3], axis=0), axis=1).sum()), 2),
        "scale": report.scale or "unknown",
        "scale off, %": round(100 * (1 / scale - 1), 2) if report.scale else None,
        "focal, px": {"true": walk.focal_px, "guess": prior, "found": round(report.note.focal_px, 1)},
        "reprojection, px": round(report.note.error_px, 3),
        "up off the true one, deg": round(float(np.degrees(np.arccos(np.clip(up[2], -1, 1)))), 2),
        "CPU s": round(time.process_time() - began + child.ru_utime + child.ru_stime, 1),
        "notices": report.notices,
    }
    (given.out / "video.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    write_picture(given.out / "video.png", draw_paths(film.name, {"true": true, "found": aligned}, np.eye(3)[2]))
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
