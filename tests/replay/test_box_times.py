"""Boxes whose poses are by frame take the times of a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.primitives import Primitive
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.box_times import with_times
from semantic_mapper.replay.boxes import BoxFile
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import StreamInfo
from tests.small import tiny_frames


def pose(*center: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = center
    return T


def test_poses_by_frame_take_the_times_of_a_log_of_their_drive(tmp_path: Path) -> None:
    far = tuple((number, pose(number, 0, 1)) for number in (5, 7, 8))
    boxes = BoxFile(
        (
            Primitive(3, "chair", "box", pose(1, 2, 0.5), np.array([0.5, 0.4, 1]), True),
            Primitive(7, "car", "box", far[0][1], np.array([4, 2, 1.5]), True, frames=far),
            Primitive(9, "car", "box", pose(0, 0, 0), np.array([4, 2, 1.5]), True, frames=((90, pose(0, 0, 0)),)),
        )
    )
    frames = [replace(f, seq=5 + i) for i, f in enumerate(tiny_frames(3))]
    for name, source in (("drive", "kitti360 2013_05_28_drive_0000_sync"), ("robot", "my robot")):
        info = StreamInfo(source, {f.camera_id: f.intrinsics for f in frames}, ROOMS)
        with LogWriter(tmp_path / f"{name}.mcap", info) as writer:
            for frame in frames:
                writer.write_frame(frame)
    path = tmp_path / "boxes.json"
    with open_log(tmp_path / "drive.mcap") as log:
        timed, dropped = with_times(boxes, path, log)
    with (
        open_log(tmp_path / "robot.mcap") as log,
        pytest.raises(ConfigError, match=r"boxes\.json: boxes have poses by frame.*'my robot'"),
    ):
        with_times(boxes, path, log)
    still, car = timed.primitives
    assert dropped == [9] and not still.moves and car.frames is None
    assert [(t, T[0, 3]) for t, T in car.stamps or ()] == [(frames[0].stamp_ns, 5), (frames[2].stamp_ns, 7)]
