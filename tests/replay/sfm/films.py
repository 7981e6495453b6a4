"""Films for tests: walks through a drawn room, and mp4 files changed as phones write them."""

import struct
from collections.abc import Iterable
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
