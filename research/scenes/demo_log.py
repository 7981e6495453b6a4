"""A log of a procedural room, written the way a camera's would be; that of ``semantic-mapper demo``.

Example: python -m research.scenes.demo_log semantic_mapper/demo.mcap
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from research.scenes import VALIDATION_SEEDS, NoiseConfig, room_frames
from research.scenes.sequence import FRAME_NS
from semantic_mapper.labels import ROOMS
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(220.6, 220.6, 159.5, 119.5, 320, 240)
DEPTH_STEP_M = 0.008  # steps in which depth is stored: finer noise compresses badly
SMALL = CodecOptions(rgb="jpeg", jpeg_quality=85)


def write_room_log(path: Path, room: int, count: int) -> None:
    """Film validation room number ``room`` with a noisy depth camera; a log that is there is replaced.

    Raises LogError: it cannot be written.
    """
    seed = VALIDATION_SEEDS[room]
    info = StreamInfo(
        source=f"procedural room {seed}",
        cameras={"rooms": CAMERA},
        label_set=ROOMS,
        frame_count=count,
        frame_hz=round(1e9 / FRAME_NS, 1),
    )
    with LogWriter(path, info, options=SMALL, overwrite=True) as log:
        for frame in room_frames(seed, count, CAMERA, noise=NoiseConfig()):
            assert frame.depth_m is not None
            stored = np.round(frame.depth_m / DEPTH_STEP_M) * DEPTH_STEP_M
            millimetres = np.round(stored * 1000).astype(np.uint16)
            log.write_frame(replace(frame, depth_m=millimetres.astype(np.float32) / np.float32(1000)))


if __name__ == "__main__":
    write_room_log(Path(sys.argv[1]), room=0, count=24)
