"""What a film cannot be mapped from is refused with what to do, and what it tells badly is noted."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.colmap import FocalCheck, Outcome, Pair
from semantic_mapper.replay.sfm.film import FilmLook
from semantic_mapper.replay.sfm.refusals import baseline_notes, focal_note, refuse_look, refuse_outcome


def look_of(motion: float, count: int = 60, dark: float = 0.0) -> FilmLook:
    same = np.full(count, motion)
    stamps_ns = np.arange(count) * 100_000_000
    return FilmLook(np.arange(count), stamps_ns, same, same, np.ones(count), np.arange(count) < dark * count)


@pytest.mark.parametrize(
    ("look", "picks", "says"),
    [
        (look_of(0.02, dark=0.9), 20, "^film.mp4: 90 % of its frames are black"),
        (look_of(0.0005), 1, "does not move"),
        (look_of(0.02, count=10), 5, "too short"),
    ],
)
def test_the_first_look_refuses(look: FilmLook, picks: int, says: str) -> None:
    with pytest.raises(ImportSourceError, match=says):
        refuse_look("film.mp4", look, picks)


TIMES = [0.5 * n for n in range(20)]


def outcome(linked: int, flat: float = 0.5, turn: float = 0.2) -> Outcome:
    near = [Pair(n, n + 1, 100, flat, turn) for n in range(linked)]
    return Outcome([], near + [Pair(n, n + 3, 60, flat, turn) for n in range(linked)])


@pytest.mark.parametrize(
    ("found", "spans", "says"),
    [
        (outcome(19), [range(18)], ""),
        (outcome(3), [], "do not match each other: 3 of 19"),
        (outcome(19, flat=0.99), [range(4)], "turns on the spot"),
        (outcome(19, flat=0.9, turn=0.9), [], "turns on the spot"),
        (outcome(19, flat=0.9, turn=0.9), [range(20)], "turns on the spot"),
        (outcome(19), [], "from two sides"),
        (outcome(19), [range(9), range(11, 19)], r"0.0 to 4.0 s \(9 of 20 views\); 5.5 to 9.0 s .*cut it"),
    ],
)
def test_what_does_not_hang_together_is_refused(found: Outcome, spans: list[range], says: str) -> None:
    with pytest.raises(ImportSourceError, match=says) if says else nullcontext():
        refuse_outcome("film.mp4", found, TIMES, spans)


def test_a_calibration_is_doubted_where_the_pictures_are_sure() -> None:
    def note(factor: float, sigmas: float) -> list[str]:
        return focal_note("film.mp4", "camera.toml", 500.0, FocalCheck(factor, sigmas))

    assert note(1.02, 40.0) == note(1.5, 3.0) == []
    assert "camera.toml is 500 px" in note(1.08, 20.0)[0] and "460 px" in note(0.92, 20.0)[0]
    with pytest.raises(ImportSourceError, match=r"500 px .* 1000 px"):
        note(2.0, 50.0)


def test_what_a_straight_way_tells_badly_is_noted() -> None:
    assert baseline_notes(False, 12.0, 0.003) == []
    (ahead,) = baseline_notes(True, 6.3, None)
    assert "straight ahead" in ahead and "6.3 degrees" in ahead
    (lens,) = baseline_notes(False, 12.0, 0.047)
    assert "exact to 4.7 % only" in lens and "--calibration" in lens
    assert "57 %" in baseline_notes(True, 6.3, 0.57)[1]
