"""A log of a procedural room, written the way a camera's would be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from semantic_mapper.labels import ROOMS
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.scenes import VALIDATION_SEEDS, NoiseConfig, room_frames
from semantic_mapper.scenes.sequence import FRAME_NS
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(220.6, 220.6, 159.5, 119.5, 320, 240)


def write_room_log(path: Path, room: int, count: int, stop: StopRequest, on_frame: Callable[[], None]) -> None:
    """Film validation room number ``room`` with a noisy depth camera; a log that is there is replaced.

    Raises:
        LogError: it cannot be written.
    """
    seed = VALIDATION_SEEDS[room]
    info = StreamInfo(
        source=f"procedural room {seed}",
        cameras={"rooms": CAMERA},
        label_set=ROOMS,
        frame_count=count,
        frame_hz=round(1e9 / FRAME_NS, 1),
    )
    with LogWriter(path, info, overwrite=True) as log:
        for frame in room_frames(seed, count, CAMERA, noise=NoiseConfig()):
            log.write_frame(frame)
            on_frame()
            if stop:
                return
