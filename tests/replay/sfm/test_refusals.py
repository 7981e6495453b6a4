"""What a film cannot be mapped from is refused with what to do, and what it tells badly is noted."""

from contextlib import nullcontext

import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.colmap import FocalCheck, Outcome, Pair
from semantic_mapper.replay.sfm.refusals import focal_note, refuse_outcome

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
