"""A long recording at the price of a short one: the frames of a room seen on a walk to and fro, with new stamps.

As a program, one of many gigabytes in few frames, and what it takes to read it, to begin near its end, and to recover
it with its end cut off, which is done to the file itself; each in a process of its own:
python -m research.experiments.long_log big.mcap --gb 15
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import re
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from research.scenes import TRAIN_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.cli.info import describe_log
from semantic_mapper.replay.log.format import LogReader, LogWriter, recover
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import depth_from_uint16, encode_rgb
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, PosedFrame

INTRINSICS = CameraIntrinsics(110.0, 110.0, 79.5, 59.5, 160, 120)
DISTINCT = 24
STEP_M = 0.04


def distinct_frames(count: int = DISTINCT) -> list[PosedFrame]:
    """A walk through one room, 160 x 120, unlabelled."""
    path = CameraPathConfig(step_m=STEP_M)
    return [_plain(frame) for frame in room_frames(TRAIN_SEEDS[7], count, INTRINSICS, path=path)]


def _plain(frame: PosedFrame) -> PosedFrame:
    """Without labels, depth in whole millimetres."""
    assert frame.depth_m is not None
    depth_m = depth_from_uint16(np.rint(frame.depth_m * 1000).astype(np.uint16), 1000)
    return dataclasses.replace(frame, label=None, depth_m=depth_m)


def write_long_log(path: Path, seconds: float, hz: float) -> Path:
    """The walk forward and backward, again and again."""
    walk = distinct_frames()
    walk += walk[-2:0:-1]
    images = [EncodedImage("jpeg", encode_rgb(frame.rgb, "jpeg", 92)) for frame in walk]
    info = StreamInfo("walk to and fro", {"rooms": INTRINSICS}, ROOMS, round(seconds * hz), hz)
    with LogWriter(path, info) as log:
        for seq in range(round(seconds * hz)):
            stamp_ns = round((seq + 1) * 1e9 / hz)
            frame = dataclasses.replace(walk[seq % len(walk)], seq=seq, stamp_ns=stamp_ns)
            log.write_frame(frame, encoded_rgb=images[seq % len(walk)])
    return path


def write_big_log(path: Path, size_gb: float) -> Path:
    """Frames of noise in colour, which no format packs: 6 MB each at 1920 x 1080, with a wall 2 m off as depth."""
    rng = np.random.default_rng(0)
    k = CameraIntrinsics(1400.0, 1400.0, 959.5, 539.5, 1920, 1080)
    wall, pose = np.full((k.height, k.width), 2.0, np.float32), np.eye(4)
    frames = [
        PosedFrame(0, 0, "noise", rng.integers(0, 256, (k.height, k.width, 3), np.uint8), wall, None, k, pose)
        for _ in range(4)
    ]
    images = [EncodedImage("png", encode_rgb(frame.rgb, "png", 0)) for frame in frames]
    count = round(size_gb * 1e9 / len(images[0].data))
    with LogWriter(path, StreamInfo("noise", {"noise": k}, ROOMS, count, 10.0)) as log:
        for seq in range(count):
            frame = dataclasses.replace(frames[seq % len(frames)], seq=seq, stamp_ns=(seq + 1) * 100_000_000)
            log.write_frame(frame, encoded_rgb=images[seq % len(images)])
    return path


STEPS = {
    "info": lambda path: describe_log([path], lambda: None)["frames"],
    "open, first of the last ten frames": lambda path: (
        next((log := LogReader(path)).frame_parts(log.frame(len(log) - 10).stamp_ns))[0].seq
    ),
    "info, end cut off": lambda path: describe_log([path], lambda: None)["frames"],
    "recover, end cut off": lambda path: recover(path, path.with_stem(path.stem + "-recovered")).frames,
}


def measure(step: str, path: Path) -> None:
    """Do it, and print a row."""
    began, worked = time.perf_counter(), time.process_time()
    given = STEPS[step](path)
    spent = time.perf_counter() - began, time.process_time() - worked
    peak_kb = re.findall(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[0]
    print(f"| {step} | {given:,} | {spent[0]:.1f} | {spent[1]:.1f} | {int(peak_kb) / 1000:,.0f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--gb", type=float, default=50.0)
    options = parser.parse_args()
    write_big_log(options.log, options.gb)
    print("| step | frames, or number of the frame | seconds | CPU s | largest memory, MB |\n|---|---|---|---|---|")
    for number, name in enumerate(STEPS):
        if number == 2:
            os.truncate(options.log, options.log.stat().st_size - 20_000_000)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            pool.submit(measure, name, options.log).result()
