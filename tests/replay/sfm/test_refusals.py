from __future__ import annotations

import numpy as np
import pytest

from semantic_mapper.replay.sfm.colmap_process import FocalCheck, Outcome, Pair, Sigmas
from semantic_mapper.replay.sfm.film import FilmLook
from semantic_mapper.replay.sfm.refusals import (
    FilmError,
    baseline_notes,
    focal_note,
    refuse_features,
    refuse_look,
    refuse_outcome,
)


def look_of(motion: float, count: int = 60, dark: float = 0.0) -> FilmLook:
    return FilmLook(
        np.arange(count),
        np.arange(count) * 100_000_000,
        np.full(count, motion),
        np.full(count, motion),
        np.ones(count),
        np.arange(count) < dark * count,
    )


@pytest.mark.parametrize(
    ("look", "picks", "reason", "says"),
    [
        (look_of(0.02, dark=0.9), 20, "dark", "90 % of its frames are black"),
        (look_of(0.0005), 1, "still", "does not move"),
        (look_of(0.02, count=10), 5, "short", "too short"),
        (look_of(0.0, count=0), 0, "short", "no frame"),
    ],
)
def test_the_first_look_refuses(look: FilmLook, picks: int, reason: str, says: str) -> None:
    with pytest.raises(FilmError, match=says) as caught:
        refuse_look("film.mp4", look, picks)
    assert caught.value.reason == reason and str(caught.value).startswith("film.mp4: ")


def test_frames_without_features_are_refused() -> None:
    refuse_features("film.mp4", [500] * 9)
    with pytest.raises(FilmError, match="blurred") as caught:
        refuse_features("film.mp4", [10] * 9)
    assert caught.value.reason == "blurred"


TIMES = [0.5 * n for n in range(20)]


def outcome(linked: int, flat: float = 0.5, turn: float = 0.2) -> Outcome:
    near = [Pair(n, n + 1, 100, flat, turn) for n in range(linked)]
    return Outcome([], near + [Pair(n, n + 3, 60, flat, turn) for n in range(linked)], [500] * 20)


def test_a_film_that_hangs_together_passes() -> None:
    assert refuse_outcome("film.mp4", outcome(19), TIMES, [range(18)]) is None  # a FilmError otherwise


@pytest.mark.parametrize(
    ("found", "spans", "reason", "says"),
    [
        (outcome(3), [], "no-matches", "do not match each other: 3 of 19"),
        (outcome(19, flat=0.99), [], "turning", "turns on the spot"),
        (outcome(19, flat=0.99), [range(4)], "turning", "turns on the spot"),
        (outcome(19, flat=0.99), [range(5), range(8, 12)], "turning", "turns on the spot"),
        (outcome(19, flat=0.9, turn=0.9), [], "turning", "turns on the spot"),
        (outcome(19, flat=0.9, turn=0.9), [range(20)], "turning", "turns on the spot"),
        (outcome(19), [], "no-matches", "from two sides"),
        (outcome(19), [range(9), range(11, 19)], "several-scenes", r"0.0 to 4.0 s \(9 of 20 views\); 5.5 to 9.0 s"),
    ],
)
def test_what_does_not_hang_together_is_refused(found: Outcome, spans: list[range], reason: str, says: str) -> None:
    with pytest.raises(FilmError, match=says) as caught:
        refuse_outcome("film.mp4", found, TIMES, spans)
    assert caught.value.reason == reason


def test_a_calibration_is_doubted_where_the_pictures_are_sure() -> None:
    def doubt(factor: float, sigmas: float) -> str:
        return focal_note("film.mp4", "camera.toml", 500.0, FocalCheck(factor, sigmas))

    assert doubt(1.02, 40.0) == doubt(1.5, 3.0) == ""
    assert "camera.toml is 500 px" in doubt(1.08, 20.0) and "460 px" in doubt(0.92, 20.0)
    with pytest.raises(FilmError, match=r"500 px .* 1000 px") as caught:
        doubt(2.0, 50.0)
    assert caught.value.reason == "calibration"


def test_what_a_straight_way_tells_badly_is_noted() -> None:
    assert baseline_notes(False, 12.0, Sigmas(0.003, 0.004, 0.01)) == []
    (ahead,) = baseline_notes(True, 6.3, Sigmas(None, 0.0074, 0.011))
    assert "straight ahead" in ahead and "6.3 degrees" in ahead and "1.1 % (median)" in ahead and "0.74 %" in ahead
    assert "is unknown" in baseline_notes(False, 6.3, None)[0]
    (lens,) = baseline_notes(False, 12.0, Sigmas(0.047, 0.004, 0.01))
    assert "exact to 4.7 % only" in lens and "--calibration" in lens
    assert "57 %" in baseline_notes(True, 6.3, Sigmas(0.57, 0.01, 0.01))[1]
