"""How long upkeep holds the mapper's thread: the history, its journal, and handing changes to those who ask.

A room is mapped geometry and random votes alone (no field), so that nothing else takes time. Times are those of the
thread's processor, since other work on the machine does not count there.

Example: python -m research.experiments.stalls --frames 120 --voxel-size 0.02
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from research.scenes import TRAIN_SEEDS, room_frames
from semantic_mapper.client import MapClient
from semantic_mapper.config import HistoryConfig, KeyframeConfig, MapperConfig, VoxelMapConfig
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.correction.corrected_map import MapCorrector
from semantic_mapper.mapping.correction.history import FusedFrame
from semantic_mapper.mapping.keyframes import KeyframeStore
from semantic_mapper.mapping.moving_filter import MovingFilter
from semantic_mapper.mapping.views.upsample import upsample
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.query_service import QueryService
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
COARSE = (60, 80)


class Stopwatch:
    """Times of calls, milliseconds of the thread's processor and of the clock."""

    def __init__(self) -> None:
        self.cpu: list[float] = []
        self.wall: list[float] = []

    def time(self, call: Callable[[], object]) -> None:
        """Run it."""
        wall, cpu = time.perf_counter(), time.thread_time()
        call()
        self.cpu.append((time.thread_time() - cpu) * 1e3)
        self.wall.append((time.perf_counter() - wall) * 1e3)

    def __str__(self) -> str:
        if not self.cpu:
            return "never"
        cpu, wall = np.array(self.cpu), np.array(self.wall)
        return (
            f"{len(cpu)} calls; processor ms: p50 {np.median(cpu):.1f}, p95 {np.percentile(cpu, 95):.1f}, "
            f"max {cpu.max():.1f}, all {cpu.sum():.0f}; clock ms: p50 {np.median(wall):.1f}, max {wall.max():.1f}"
        )


def fused(frame: PosedFrame, rng: np.random.Generator) -> FusedFrame:
    """A frame with random class probabilities."""
    probabilities = rng.dirichlet(np.ones(len(ROOMS)), COARSE).astype(np.float32)
    known = np.ones(COARSE, np.bool_)
    return FusedFrame(frame, probabilities, known, np.zeros(COARSE, np.float32))


def fuse(voxel_map: VoxelMap, item: FusedFrame) -> None:
    """As the pipeline does."""
    frame = item.frame
    assert frame.depth_m is not None
    low = (COARSE[1], COARSE[0])

    rgb_low = np.asarray(cv2.resize(frame.rgb, low, interpolation=cv2.INTER_AREA), np.uint8)
    depth_low = np.asarray(cv2.resize(frame.depth_m, low, interpolation=cv2.INTER_NEAREST), np.float32)
    rows = upsample(item.probabilities, item.known, rgb_low, depth_low, frame.rgb, frame.depth_m)
    voxel_map.integrate(frame, frame.depth_m, item.probabilities.reshape(-1, len(ROOMS)), rows=rows)


def ask_on(endpoint: str, ended: threading.Event) -> None:
    """A client that asks five times a second."""
    with MapClient(endpoint, timeout_s=60) as client:
        while not ended.wait(0.2):
            client.info()


def main() -> None:
    """Map, and print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--history", type=int, default=40, help="history.max_frames")
    parser.add_argument("--voxel-size", type=float, default=0.02)
    parser.add_argument("--pause", type=float, default=0.05, help="seconds between two frames")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    voxel_map = VoxelMap(VoxelMapConfig(voxel_size_m=given.voxel_size), ROOMS)
    corrector = MapCorrector(
        HistoryConfig(max_frames=given.history),
        voxel_map,
        KeyframeStore(KeyframeConfig()),
        lambda into, item, _: fuse(into, item),
        MovingFilter(MapperConfig(), ROOMS),
    )
    room, record, upkeep, hand_over = Stopwatch(), Stopwatch(), Stopwatch(), Stopwatch()
    ended = threading.Event()
    with tempfile.TemporaryDirectory() as folder, QueryService(f"ipc://{Path(folder) / 'q'}", voxel_map) as service:
        asking = threading.Thread(target=ask_on, args=(service.endpoint, ended))
        asking.start()
        for number, frame in enumerate(room_frames(TRAIN_SEEDS[7], given.frames, CAMERA)):
            item = fused(frame, rng)
            watches = (upkeep, room, record, hand_over) if number > 2 else (Stopwatch(),) * 4  # kernels compile
            watches[0].time(corrector.make_room)
            watches[1].time(lambda item=item: fuse(voxel_map, item))
            watches[2].time(lambda item=item: corrector.record(item))
            before = service._copied_version
            watch = Stopwatch()
            watch.time(service.follow)
            if service._copied_version != before and number > 2:
                hand_over.cpu += watch.cpu
                hand_over.wall += watch.wall
            time.sleep(given.pause)
        ended.set()
        asking.join()
    print(f"{voxel_map.block_count} blocks, {len(ROOMS)} classes, {given.frames} frames")
    for name, watch in (("fuse", room), ("record", record), ("make room", upkeep), ("hand over", hand_over)):
        print(f"{name:10} {watch}")


if __name__ == "__main__":
    main()
