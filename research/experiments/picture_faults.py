"""How reliably contradictions between pictures and poses are detected, and what it costs.

Walks through ROOMS test rooms as they are and with one fault each, from the 20th picture on; and any log without
faults.

Example: python -m research.experiments.picture_faults --rooms 4
Example: python -m research.experiments.picture_faults --log kitchen.mcap
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from research.scenes import TEST_SEEDS
from research.scenes.camera import camera_path
from research.scenes.config import CameraPathConfig, NoiseConfig
from research.scenes.render import render_view
from research.scenes.room import make_room
from research.scenes.shots import sequence_shots
from semantic_mapper.mapping.picture_check import SENTENCES, PictureCheck
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

BEGIN, LENGTH, COUNT = 20, 20, 80  # of the fault, and of the walk
WIDTH, HEIGHT, FOCAL = 320, 240, 272.0

FocalOf = Callable[[int], float]  # factor of the focal length at a picture


def room_walk(seed: int, focal_of: FocalOf | None = None, count: int = COUNT) -> list[PosedFrame]:
    """Frames 4 cm apart without depth, whose intrinsics tell nothing of ``focal_of``."""
    scene, noise = make_room(seed), NoiseConfig(depth="none")
    poses = camera_path(scene, count, seed, CameraPathConfig(step_m=0.04))
    shots = sequence_shots(poses, seed, noise)
    frames: list[PosedFrame] = []
    for n, pose in enumerate(poses):
        true = _camera(FOCAL * (1.0 if focal_of is None else focal_of(n)))
        rgb = render_view(scene, true, pose, noise=seed + n, noise_config=noise, shot=shots[n]).rgb
        frames.append(PosedFrame(n * 66_000_000, n, "camera", rgb, None, None, _camera(FOCAL), pose))
    return frames


def _camera(focal: float) -> CameraIntrinsics:
    return CameraIntrinsics(focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)


def zoom(n: int) -> float:
    """12 % more focal length within 20 pictures, which then stays."""
    return 1 + 0.12 * min(max((n - BEGIN) / LENGTH, 0.0), 1.0)


def autofocus(n: int) -> float:
    """4 % more focal length, and back."""
    return 1 + 0.04 * float(np.sin(np.pi * min(max((n - BEGIN) / LENGTH, 0.0), 1.0)))


def dim(rgb: UInt8) -> UInt8:
    """Hardly any light."""
    return (rgb // 16).astype(np.uint8)


def smear(rgb: UInt8) -> UInt8:
    """The camera moves by a tenth of the width while the shutter is open."""
    return np.asarray(cv2.blur(rgb, (WIDTH // 10 + 1, 1)), np.uint8)


def flicker(n: int, rgb: UInt8) -> UInt8:
    """Every second picture has half the light."""
    linear = (rgb / 255.0) ** 2.2 * (0.5 if n % 2 else 1.0)
    return np.asarray(np.rint(255 * linear ** (1 / 2.2)), np.uint8)


def late(poses: Sequence[Float64], n: int, by: int = 4) -> Float64:
    """The pose of some pictures before."""
    return poses[max(n - by, 0)]


def spoil(frames: Sequence[PosedFrame], fault: str) -> list[PosedFrame]:
    """Frames with a fault in the picture or in the pose."""
    poses = [f.T_world_camera for f in frames]
    changed: list[PosedFrame] = []
    for n, frame in enumerate(frames):
        if fault == "poses late by 4":
            changed.append(replace(frame, T_world_camera=late(poses, n)))
        elif not BEGIN <= n < BEGIN + LENGTH:
            changed.append(frame)
        elif fault == "frozen":
            changed.append(replace(frame, rgb=frames[BEGIN].rgb))
        elif fault == "flicker":
            changed.append(replace(frame, rgb=flicker(n, frame.rgb)))
        elif fault == "blur":
            changed.append(replace(frame, rgb=smear(frame.rgb) if n % 4 == 0 else frame.rgb))
        elif fault == "dark":
            changed.append(replace(frame, rgb=dim(frame.rgb)))
        else:
            changed.append(frame)
    return changed


# fault -> what should be said of it, and of how many pictures at most
FAULTS = {
    "dark": ("dark", LENGTH),
    "blur": ("blurred", LENGTH // 4),
    "flicker": ("exposure_jump", LENGTH),
    "frozen": ("still_pictures", LENGTH),
    "poses late by 4": ("misfit", COUNT),
    "zoom 12 %": ("focal_change", COUNT - BEGIN),
    "autofocus 4 %": ("focal_change", LENGTH),
}


def named(frames: Iterable[PosedFrame]) -> tuple[Counter[str], int]:
    """Pictures by what was said of them, and how many there were."""
    check = PictureCheck()
    for frame in frames:
        check.look(frame)
    return check.counters, check.checked


def _line(name: str, counters: Counter[str], count: int) -> None:
    print(f"{name:>18} {count:>8} " + " ".join(f"{counters[what]:>{max(6, len(what))}}" for what in SENTENCES))


def main() -> None:
    """Print a table: pictures, and those of each kind that were named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=0, help="test rooms")
    parser.add_argument("--log", type=Path, nargs="*", default=[], help="logs without faults")
    given = parser.parse_args()
    print(f"{'':>18} pictures " + " ".join(f"{what:>6}" for what in SENTENCES))
    for path in given.log:
        with LogReader(path) as log:
            _line(path.name, *named(log))
    totals: dict[str, Counter[str]] = {}
    detected: Counter[str] = Counter()
    cpu_s = 0.0
    for seed in list(TEST_SEEDS)[: given.rooms]:
        clean = room_walk(seed)
        for fault in ("none", *FAULTS):
            if fault == "none":
                frames = clean
            elif FAULTS[fault][0] == "focal_change":
                frames = room_walk(seed, zoom if fault.startswith("zoom") else autofocus)
            else:
                frames = spoil(clean, fault)
            began = time.process_time()
            counters, _ = named(frames)
            cpu_s += time.process_time() - began
            totals.setdefault(fault, Counter()).update(counters)
            detected[fault] += fault != "none" and counters[FAULTS[fault][0]] > 0
    for fault, counters in totals.items():
        _line(fault, counters, given.rooms * COUNT)
    for fault, (what, most) in FAULTS.items():
        if given.rooms:
            print(f"{fault}: {what} in {detected[fault]} of {given.rooms} walks; of {most} pictures a walk at most")
    if given.rooms:
        print(f"CPU time a picture: {1e3 * cpu_s / (given.rooms * COUNT * (1 + len(FAULTS))):.1f} ms")


if __name__ == "__main__":
    main()
