"""Numbers of frames that never came, whatever numbers a camera gives."""

from __future__ import annotations

from semantic_mapper.nodes.frame_gaps import MAX_MISSED, Gaps
from semantic_mapper.transport.messages import MAX_COUNT


def test_gaps_between_numbers_are_counted_camera_by_camera() -> None:
    gaps = Gaps()
    for camera, seq in (("left", 4), ("right", 0), ("left", 7), ("right", 1), ("left", 0), ("left", 1)):
        gaps.note(camera, seq)
    assert (gaps.missed, gaps.begun_anew) == (2, 1)


def test_numbers_that_jump_to_the_largest_one_and_back_do_not_overflow_the_count() -> None:
    gaps = Gaps()
    for seq in (0, 2**62, 0, MAX_COUNT, 0, 2**62, MAX_COUNT, MAX_COUNT, 0):
        gaps.note("eye", seq)
    assert (gaps.missed, gaps.begun_anew) == (MAX_MISSED, 4)
    assert gaps.missed + MAX_MISSED < MAX_COUNT  # sums of it can be sent, too
