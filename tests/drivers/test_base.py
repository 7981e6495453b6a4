from __future__ import annotations

from pathlib import Path

from semantic_mapper.drivers.base import FrameSource
from semantic_mapper.replay.importers import import_recording
from semantic_mapper.replay.log.format import LogReader
from tests.replay import recordings


def test_anything_that_takes_a_frame_source_takes_a_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    import_recording(recordings.make_folder(tmp_path / "kitchen"), path)

    def consume(source: FrameSource) -> list[int]:
        with source as opened:
            assert list(opened.info.cameras) == ["camera"] and opened.info.label_set is not None
            return [frame.seq for frame in opened]

    assert consume(LogReader(path)) == list(range(6))
