"""Frames that a log is missing."""

from semantic_mapper.replay.log.missing_frames import find_missing_frames, missing_frames_text

TENTH = 10**8


def test_a_log_without_missing_frames_has_none() -> None:
    for seqs in ([], [5], range(20)):
        missing = find_missing_frames(list(seqs), [s * TENTH for s in seqs])
        assert missing_frames_text(missing) == "none" and missing["frames_missing"] == 0


def test_missing_frames_are_counted_and_restarts_and_pauses_are_none() -> None:
    missing = find_missing_frames([0, 10, 20, 40, 50], range(5))  # every tenth frame is no gap
    assert (missing["frames_missing"], missing["largest_sequence_gap_after_seq"]) == (1, 20)
    largest = 2**63 - 1
    missing = find_missing_frames([0, 1, largest, 0, 1, largest], [0, 1, largest, 0, 1, largest])
    assert missing["frames_missing"] == 2 * (largest - 2) and missing["counter_restarts"] == 1
    missing = find_missing_frames(range(5), [0, TENTH, 2 * TENTH, 40 * TENTH, 41 * TENTH])
    assert (missing["frames_missing"], missing["time_gap_count"], missing["longest_time_gap_s"]) == (0, 1, 3.8)
    assert "longest 3.8 s, after seq 2" in missing_frames_text(missing)
    missing = find_missing_frames([7, 8, 0, 1, 2], [0, TENTH, 2 * TENTH, 2 * TENTH, TENTH])
    assert (missing["frames_missing"], missing["counter_restarts"], missing["stamps_not_increasing"]) == (0, 1, 2)
    assert "begin again 1 time;" in missing_frames_text(missing)
