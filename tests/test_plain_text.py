from __future__ import annotations

from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.missing_frames import find_missing_frames, missing_frames_text


def test_one_thing_is_singular() -> None:
    assert counted(1, "frame") == "1 frame" and counted(0, "frame") == "0 frames"
    assert counted(2, "stretch", "stretches") == "2 stretches"


def test_one_gap_of_a_log_is_singular() -> None:
    text = missing_frames_text(find_missing_frames([0, 1, 2, 3, 5], [0, 1_000, 2_000, 3_000, 9_000]))
    assert "1 frame missing in 1 gap of" in text and "1 time gap (" in text
