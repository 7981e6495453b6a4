"""Films for tests: rendered walks, and mp4 files changed as phones write them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from research.scenes.camera import camera_path
from research.scenes.config import CameraPathConfig, NoiseConfig
from research.scenes.render import render_view
from research.scenes.room import make_room
from research.scenes.shots import sequence_shots
from semantic_mapper.geometry import interpolate_pose
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

W, H, HZ = 320, 240, 15.0
CAMERA = CameraIntrinsics(272.0, 272.0, (W - 1) / 2, (H - 1) / 2, W, H)
SEED = 100_003  # of a room and a path without people


def write_film(path: Path, pictures: Iterable[UInt8], hz: float = HZ) -> Path:
    """An mp4 file of RGB pictures."""
    writer = None
    for rgb in pictures:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), hz, rgb.shape[1::-1])
        writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    assert writer is not None
    writer.release()
    return path


def walk(count: int, seed: int = SEED, step_m: float = 0.05) -> Float64:
    """Poses (N, 4, 4) of a hand-held walk."""
    return camera_path(make_room(seed), count, seed, CameraPathConfig(step_m=step_m))


def take(poses: Float64, seed: int = SEED, shutter: float = 0.0, bands: int = 6) -> list[UInt8]:
    """Pictures at poses, with noise and auto exposure; with a rolling shutter rows follow the way to the next pose."""
    scene, config = make_room(seed), NoiseConfig(depth="none")
    shots = sequence_shots(poses, seed, config)

    def at(n: int, fraction: float) -> UInt8:
        pose = interpolate_pose(poses[n], poses[min(n + 1, len(poses) - 1)], fraction)
        return render_view(scene, CAMERA, pose, noise=seed + n, noise_config=config, shot=shots[n]).rgb

    if not shutter:
        return [at(n, 0.0) for n in range(len(poses))]
    edges = np.linspace(0, H, bands + 1).astype(int)
    pictures: list[UInt8] = []
    for n in range(len(poses)):
        rows = [at(n, shutter * (b + 0.5) / bands)[edges[b] : edges[b + 1]] for b in range(bands)]
        pictures.append(np.concatenate(rows))
    return pictures


def box(data: bytes, *path: bytes) -> tuple[int, int]:
    """Start and size of a box of an mp4 file; what is in it begins 8 bytes later."""
    start, end = 0, len(data)
    size = 0
    for name in path:
        at = start
        while at < end:
            size = struct.unpack(">I", data[at : at + 4])[0]
            if data[at + 4 : at + 8] == name:
                break
            at += size
        else:
            raise AssertionError(f"no box {name!r}")
        start, end = at + 8, at + size
    return start - 8, size


def set_frame_times(film: Path, durations: Sequence[int]) -> int:
    """Give each frame of a film a duration of its own, as phones do; returns the units a second."""
    data = bytearray(film.read_bytes())
    way = (b"moov", b"trak", b"mdia")
    header, _ = box(data, *way, b"mdhd")
    units = struct.unpack(">I", data[header + 20 : header + 24])[0]
    old, size = box(data, *way, b"minf", b"stbl", b"stts")
    table = struct.pack(">II", 0, len(durations)) + b"".join(struct.pack(">II", 1, d) for d in durations)
    new = struct.pack(">I4s", 8 + len(table), b"stts") + table
    grown = len(new) - size
    boxes = [box(data, *(*way, b"minf", b"stbl")[:n])[0] for n in range(1, 6)]
    assert all(at < old for at in boxes) and box(data, b"mdat")[0] < boxes[0]  # offsets of frames stay true
    for at in boxes:
        struct.pack_into(">I", data, at, struct.unpack_from(">I", data, at)[0] + grown)
    data[old : old + size] = new
    total = sum(durations)
    struct.pack_into(">I", data, header + 24, total)
    film.write_bytes(bytes(data))
    return units


def set_rotation(film: Path) -> None:
    """Mark a film as to be turned clockwise by a quarter for showing, as phones do that are held upright."""
    data = bytearray(film.read_bytes())
    header, _ = box(data, b"moov", b"trak", b"tkhd")
    one = 0x10000
    struct.pack_into(">9i", data, header + 8 + 40, 0, one, 0, -one, 0, 0, 0, 0, 0x40000000)
    film.write_bytes(bytes(data))
