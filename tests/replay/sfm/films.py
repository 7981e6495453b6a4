"""Films for tests: walks through a drawn room, and mp4 files changed as phones write them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2

from semantic_mapper.types import CameraIntrinsics, PosedFrame, UInt8
from tests.drawn_room import walk_frames

W, H, HZ = 320, 240, 15.0
CAMERA = CameraIntrinsics(272.0, 272.0, (W - 1) / 2, (H - 1) / 2, W, H)
SEED = 3


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


def walk(count: int, seed: int = SEED, step_m: float = 0.05) -> tuple[PosedFrame, ...]:
    """Frames of a walk with their true poses and depth."""
    return walk_frames(seed, count, CAMERA, step_m=step_m)


def pictures(frames: Iterable[PosedFrame]) -> list[UInt8]:
    return [frame.rgb for frame in frames]


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
