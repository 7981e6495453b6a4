"""Which frames to label, and which next."""

import numpy as np
import pytest

from semantic_mapper.training.select import Candidate, candidate_from_frame, choose_keyframes, suggest_frames
from tests.small import tiny_frames


def candidate(*cells: int, stamp_ns: int = 0) -> Candidate:
    """A frame whose pixels fall in these cells of a line."""
    return Candidate(stamp_ns, np.array([[c, 0, 0] for c in cells], np.int64).reshape(-1, 3))


def test_each_suggestion_counts_what_labelled_and_earlier_ones_show():
    frames = [candidate(1, 2, 3, 4), candidate(1, 2, 3), candidate(8, 9), candidate(4, 5)]
    found = suggest_frames(frames, 4)
    assert [s.index for s in found] == [0, 2, 3], "the second frame shows nothing that the first does not"
    # Of 11 pixels of the log, 8 fall in what the first one shows.
    assert [s.gain for s in found] == pytest.approx([8 / 11, 2 / 11, 1 / 11])
    assert [s.shown for s in found] == pytest.approx([8 / 11, 10 / 11, 1])
    left = suggest_frames(frames, 2, [0])
    assert [s.index for s in left] == [2, 3] and left[0].shown == pytest.approx(10 / 11)
    assert suggest_frames(frames, 2, [0, 2, 3]) == []


def test_suggestions_without_depth_are_spread_over_time():
    frames = [candidate(stamp_ns=stamp) for stamp in (0, 10, 20, 30, 40, 50, 60, 70, 80)]
    found = suggest_frames(frames, 3)
    assert [s.index for s in found] == [4, 0, 8] and {(s.gain, s.shown) for s in found} == {(None, None)}
    assert [s.index for s in suggest_frames(frames, 1, [0, 1])] == [8]
    assert [s.index for s in suggest_frames(frames, 2, [8])] == [0, 4]
    assert len(suggest_frames(frames, 99)) == 9


def test_choice_is_decided_by_the_seed_and_gives_as_many_as_asked():
    candidates = [candidate_from_frame(f) for f in tiny_frames(6)]
    assert choose_keyframes(candidates, 4, 3) == choose_keyframes(candidates, 4, 3)
    assert len(choose_keyframes(candidates, 4, 3)) == 4
    assert choose_keyframes(candidates, 99, 0) == list(range(6))
