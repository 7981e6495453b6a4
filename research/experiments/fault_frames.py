"""Cameras that go away, and frames that come late, twice, out of order or with poses that cannot be true."""

from __future__ import annotations

import dataclasses
import random
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from research.experiments.fault_table import Outcome
from research.experiments.long_log import INTRINSICS, distinct_frames
from semantic_mapper.config import load_mapper_config
from semantic_mapper.drivers.base import Camera, CameraImage, PoseEstimate
from semantic_mapper.drivers.poses.config import DevicePoses, FixedPose
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import make_poses
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapper import Mapper
from semantic_mapper.replay.session import MapSession
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame
from tests.drivers.fake_v4l2 import Sensor, make_machine
from tests.drivers.support import write_calibration

AWAY_S = 0.7
FRAME_NS = 66_666_667
STREAM = 10  # good frames of a scrambled stream


def unplugged_cameras(rounds: int) -> Iterator[Outcome]:
    """A V4L2 camera (the kernel is a fake, the driver is not) goes away and comes back under another index."""
    with tempfile.TemporaryDirectory(prefix="v4l2-") as folder, pytest.MonkeyPatch.context() as patch:
        machine = make_machine(Path(folder), patch)
        sensor = Sensor()
        device = machine.plug(sensor, 0)
        config = {"device": str(device), "calibration": write_calibration(Path(folder) / "webcam.toml"), "stall_s": 0.5}
        camera = PosedCamera(open_camera("v4l2", config, "front", "fault"), make_poses(FixedPose()))
        with camera:
            frames = iter(camera)
            last = next(frames)
            for count in range(rounds):
                for _ in range(20):
                    last = next(frames)
                machine.unplug(sensor)
                time.sleep(AWAY_S)
                machine.plug(sensor, 1 + count % 3)
                back_s, back_ns = time.monotonic(), time.monotonic_ns()
                while (frame := next(frames)).stamp_ns < back_ns - 20_000_000:  # the fake stamps so long ago
                    last = frame
                yield Outcome(
                    "camera unplugged, back under another index",
                    time.monotonic() - back_s,
                    lost_frames=max(0, round((frame.stamp_ns - back_ns) / 5_000_000)),  # one comes every 5 ms
                    others=int(frame.seq <= last.seq or frame.stamp_ns <= last.stamp_ns),
                )


class _ListCamera(Camera):
    """Gives images of a list; its device tracks itself."""

    def __init__(self, images: Iterable[CameraImage]) -> None:
        super().__init__("rooms")
        self._images = list(images)
        self._info = StreamInfo("scrambled", {"rooms": INTRINSICS}, ROOMS)

    def __enter__(self) -> Self:
        return self

    def __iter__(self) -> Iterator[CameraImage]:
        return iter(self._images)


def scrambled_streams(weights: str, config: str, rounds: int) -> Iterator[Outcome]:
    """The map of a stream with bad frames in it must be, bit for bit, that of the good frames alone."""
    distinct = distinct_frames(STREAM)
    good = [dataclasses.replace(f, seq=i, stamp_ns=(i + 1) * FRAME_NS) for i, f in enumerate(distinct)]
    expected = _map_of(weights, config, [_image(f) for f in good])
    for seed in range(rounds):
        images, bad = _scramble(good, random.Random(seed))
        began_s = time.monotonic()
        found = _map_of(weights, config, images)
        refused = {name: found[1][name] for name in ("stale", "outliers", "not_rotation")}
        wrong = int(
            refused != {"stale": bad["late"] + bad["twice"], "outliers": bad["outliers"], "not_rotation": bad["NaN"]}
        )
        yield Outcome(
            "frames late, twice, out of order, outliers, NaN (map compared)",
            (time.monotonic() - began_s) / len(images),
            lost_frames=STREAM - found[1]["frames"],
            others=wrong + int(found[0] != expected[0]),
            counts={**bad, "refused and counted": sum(refused.values())},
        )


def _scramble(good: list[PosedFrame], rng: random.Random) -> tuple[list[CameraImage], dict[str, int]]:
    """All good frames in their order; between them, ones that have to be refused, and how many of each."""
    images: list[CameraImage] = []
    bad: dict[str, int] = {"late": 0, "twice": 0, "outliers": 0, "NaN": 0}
    for number, frame in enumerate(good):
        images.append(_image(frame))
        kind = rng.choice(("late", "twice", "outliers", "NaN", "none"))
        if kind == "none" or (kind == "late" and number == 0):
            continue
        bad[kind] += 1
        between = frame.stamp_ns + FRAME_NS // 2
        T = frame.T_world_camera.copy()
        if kind == "late":  # also: out of order
            images.append(_image(good[rng.randrange(number)]))
        elif kind == "twice":
            images.append(_image(frame))
        elif kind == "outliers":
            T[:3, 3] += (rng.choice((-1, 1)) * rng.uniform(1, 9), 0, 0)
            images.append(_image(dataclasses.replace(frame, stamp_ns=between, T_world_camera=T)))
        else:
            T[rng.randrange(3), rng.randrange(4)] = np.nan
            images.append(_image(dataclasses.replace(frame, stamp_ns=between, T_world_camera=T)))
    return images, bad


def _image(frame: PosedFrame) -> CameraImage:
    pose = PoseEstimate(frame.T_world_camera, "vio", 0.01)
    return CameraImage(frame.stamp_ns, frame.seq, frame.camera_id, frame.rgb, frame.depth_m, frame.intrinsics, pose)


def _map_of(weights: str, config: str, images: Iterable[CameraImage]) -> tuple[list[bytes], dict[str, int]]:
    """The map's surface points as bytes, and what the posed camera has counted."""
    bundle = Mapper.load(Path(weights) if weights else None, load_mapper_config(Path(config) if config else None))
    session = MapSession(bundle, stream_labels=None)
    camera = PosedCamera(_ListCamera(images), make_poses(DevicePoses()))
    with camera:
        for frame in camera:
            session.process(frame)
    points = bundle.pipeline.voxel_map.points()
    arrays = (points.xyz, points.rgb, points.label, points.confidence)
    return [np.ascontiguousarray(array).tobytes() for array in arrays], camera.counters
