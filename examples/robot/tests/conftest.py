"""The log that tests replay. A real robot has recordings of its own."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def room_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A furnished room, filmed by a hand-held depth camera: 12 labelled frames of 160x120."""
    from research.scenes import VALIDATION_SEEDS, room_frames
    from semantic_mapper.labels import ROOMS
    from semantic_mapper.replay.log.format import LogWriter
    from semantic_mapper.transport.messages import StreamInfo
    from semantic_mapper.types import CameraIntrinsics

    camera = CameraIntrinsics(110.3, 110.3, 79.5, 59.5, 160, 120)
    path = tmp_path_factory.mktemp("logs") / "room.mcap"
    with LogWriter(path, StreamInfo("a room", {"rooms": camera}, ROOMS)) as log:
        for frame in room_frames(VALIDATION_SEEDS[0], 12, camera):
            log.write_frame(frame)
    return path
