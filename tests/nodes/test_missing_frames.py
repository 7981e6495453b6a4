"""Numbers of frames that never came, whatever numbers a camera gives."""

from __future__ import annotations

from semantic_mapper.nodes.streams import MAX_MISSED, MissingFrames
from semantic_mapper.transport.messages import MAX_COUNT


def test_missing_numbers_are_counted_camera_by_camera() -> None:
    missing = MissingFrames()
    for camera, seq in (("left", 4), ("right", 0), ("left", 7), ("right", 1), ("left", 0), ("left", 1)):
        missing.note(camera, seq)
    assert (missing.missed, missing.restarts) == (2, 1)


def test_numbers_that_jump_to_the_largest_one_and_back_do_not_overflow_the_count() -> None:
    missing = MissingFrames()
    for seq in (0, 2**62, 0, MAX_COUNT, 0, 2**62, MAX_COUNT, MAX_COUNT, 0):
        missing.note("eye", seq)
    assert (missing.missed, missing.restarts) == (MAX_MISSED, 4)
    assert missing.missed + MAX_MISSED < MAX_COUNT  # sums of it can be sent, too
