"""A launch whose camera comes back in another world, as after it was unplugged: does it go on in the old map?"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import KDTree

from research.experiments.fault_table import Outcome
from research.experiments.relocalization import CAMERA, mirrored
from research.scenes import TEST_SEEDS, NoiseConfig, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float64, PosedFrame

FRAMES = 40  # every other one before the camera goes, the others after it has come back
WRONG_M = 0.06  # a point so far from the map of all frames in one world is in the wrong place
WRONG = 0.01  # fraction of the points that may be: rims of surfaces
_LINE = re.compile(r"world_(sought|found)")


def other_worlds(folder: Path, rounds: int) -> Iterator[Outcome]:
    """Every third round the camera comes back in the mirrored room instead, where nothing may be mapped."""
    for number in range(rounds):
        seed = TEST_SEEDS[number % len(TEST_SEEDS)]
        frames = list(room_frames(seed, FRAMES, CAMERA, noise=NoiseConfig()))
        before, after = frames[::2], frames[1::2]
        elsewhere = number % 3 == 2
        moved = [_moved(mirrored(f) if elsewhere else f, _transform(number)) for f in after]
        place = folder / f"world-{number}"
        place.mkdir(parents=True)
        expected, _ = _map(place / "one", before if elsewhere else before + after)
        found, told = _map(place / "two", before + moved)
        summary = json.loads((place / "two" / "summary.json").read_text(encoding="utf-8"))
        search = summary["relocalization"]
        lost = FRAMES - summary["frames"]["fused"] - (len(after) if elsewhere else 0)
        wrong = int(search["sessions_found"] != (0 if elsewhere else 1)) + int(_wrong(found, expected) > WRONG)
        yield Outcome(
            f"camera comes back in {'another room (mirrored)' if elsewhere else 'another world'}",
            0.0 if elsewhere else told["found"] - told["sought"],
            lost_frames=max(0, lost),
            others=wrong,
            counts={
                "frames refused as not found": summary["frames"]["refused"],
                "worlds found": search["sessions_found"],
            },
        )


def _transform(number: int) -> Float64:
    rng = np.random.default_rng(number)
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
    T[:3, 3] = rng.uniform(-3, 3, 3)
    return T


def _moved(frame: PosedFrame, T_other_map: Float64) -> PosedFrame:
    return replace(frame, T_world_camera=T_other_map @ frame.T_world_camera, world=2)


def _map(out: Path, frames: list[PosedFrame]) -> tuple[VoxelMap, dict[str, float]]:
    """The map of a launch that plays these frames, and when it told of the other world."""
    log_path = out.with_suffix(".mcap")
    info = StreamInfo("two worlds", {"rooms": CAMERA}, ROOMS, len(frames), 15.0)
    with LogWriter(log_path, info) as log:
        for seq, frame in enumerate(frames):
            log.write_frame(replace(frame, seq=seq, stamp_ns=(seq + 1) * 66_666_667, label=None))
    command = [str(Path(sys.executable).with_name("semantic-mapper")), "up", "replay"]
    command += ["--set", f"camera.log={log_path}", "--set", "mapper.voxel_size_m=0.03", "--out", str(out)]
    told: dict[str, float] = {}
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as launch:
        assert launch.stdout is not None
        lines = []
        for line in launch.stdout:
            lines.append(line)
            if (event := _LINE.search(line)) is not None:
                told.setdefault(event[1], time.monotonic())
    if launch.returncode:
        raise RuntimeError(f"the launch has failed: {''.join(lines[-20:])}")
    return VoxelMap.load(out / "map.npz"), told


def _wrong(found: VoxelMap, expected: VoxelMap) -> float:
    distance, _ = KDTree(expected.points().xyz).query(found.points().xyz)
    return float((distance > WRONG_M).mean())
