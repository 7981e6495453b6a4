"""What a step costs beside another process: each frame is compared with itself."""

from __future__ import annotations

import pytest

from research.experiments.paired_steps import BLOCK, LAP, Turn, slowdown


def played(laps: int, loop: int = 0) -> list[Turn]:
    turns = [Turn(loop, 0, 0)]
    while len(turns) < laps * LAP:
        turns.append(turns[-1].after())
    return turns


def test_each_frame_is_mapped_in_both_ways_one_lap_apart() -> None:
    turns = played(4)
    assert [t.lap for t in turns] == [i // LAP for i in range(4 * LAP)]
    for turn, other in zip(turns[LAP : 2 * LAP], turns[2 * LAP : 3 * LAP], strict=True):
        assert turn.place == other.place and turn.frozen != other.frozen
    assert sum(t.frozen for t in turns[:LAP]) == LAP // 2
    changes = [i for i in range(1, len(turns)) if turns[i].frozen != turns[i - 1].frozen]
    assert all(turns[i].place % BLOCK == 0 and not turns[i].counts for i in changes)


def test_the_ratio_is_that_of_learning_alone_whatever_frames_cost() -> None:
    def cost(turn: Turn) -> float:
        own = 100.0 + 40 * turn.place  # frames differ by more than learning makes out
        warm = 500.0 if turn.lap == 0 or turn.place % BLOCK == 0 else 0.0
        return own * (1.0 if turn.frozen else 1.25) + warm

    steps = [(t, cost(t)) for loop in (1, 2) for t in played(6, loop)]
    steps += [(Turn(1, 6, place), 1e6) for place in range(LAP)]  # of a lap in which the learning may have ended
    found = slowdown(steps)
    assert found["pairs"] == 2 * (LAP - 4) * 2
    assert found["ratio_median"] == pytest.approx(1.25) and found["ratio_quartiles"] == pytest.approx([1.25, 1.25])
    assert found["ratio_of_medians"] == pytest.approx(1.25) and found["ratio_of_p95"] == pytest.approx(1.25)
    assert found["step_ms_without"]["median"] == pytest.approx(580.0)
    assert slowdown([]) == slowdown([(t, 1.0) for t in played(2)]) == {}
