"""A long recording at the price of a short one: the frames of a room seen on a walk to and fro, with new stamps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from research.scenes import TRAIN_SEEDS, CameraPathConfig, room_frames
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
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
