"""Gaps between the frames of a log."""

from __future__ import annotations

from semantic_mapper.replay.log.gaps import find_gaps, gaps_text

TENTH = 10**8


def test_a_log_without_gaps_has_none() -> None:
    for seqs in ([], [5], range(20)):
        gaps = find_gaps(list(seqs), [s * TENTH for s in seqs])
        assert gaps_text(gaps) == "none" and gaps["frames_missing"] == 0


def test_every_tenth_frame_is_no_gap_and_one_missing_of_them_is() -> None:
    seqs = [0, 10, 20, 40, 50]
    gaps = find_gaps(seqs, [s * TENTH for s in seqs])
    assert (gaps["frames_missing"], gaps["largest_sequence_gap_after_seq"]) == (1, 20)


def test_the_largest_numbers_that_a_log_can_hold_are_counted() -> None:
    largest = 2**63 - 1
    gaps = find_gaps([0, 1, largest, 0, 1, largest], [0, 1, largest, 0, 1, largest])
    assert gaps["frames_missing"] == 2 * (largest - 2) and gaps["counter_restarts"] == 1


def test_time_may_stand_still_while_numbers_go_on() -> None:
    gaps = find_gaps(range(5), [0, TENTH, 2 * TENTH, 40 * TENTH, 41 * TENTH])
    assert (gaps["frames_missing"], gaps["time_gaps"], gaps["longest_time_gap_s"]) == (0, 1, 3.8)
    assert "longest 3.8 s, after seq 2" in gaps_text(gaps)


def test_a_restarted_camera_and_stamps_that_go_back_are_no_missing_frames() -> None:
    gaps = find_gaps([7, 8, 0, 1, 2], [0, TENTH, 2 * TENTH, 2 * TENTH, TENTH])
    assert (gaps["frames_missing"], gaps["counter_restarts"], gaps["stamps_not_increasing"]) == (0, 1, 2)
    assert "begin again 1 time;" in gaps_text(gaps)
