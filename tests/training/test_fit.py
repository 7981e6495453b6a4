"""The loop of every fit: its budget, the looks at what is held out, and the weights that it keeps."""

import math

import pytest
import torch

from semantic_mapper.errors import ConfigError
from semantic_mapper.training.fit import Budget, FitProgress, HeldOut, budget_fraction, fit


def held_out(losses: list[float], patience: int = 0) -> HeldOut:
    """Looks that find these losses one after the other; the state counts them."""
    left = iter(losses)
    looks: list[float] = []

    def look() -> tuple[float, float]:
        looks.append(next(left))
        return looks[-1], 0.5

    return HeldOut(look, lambda: {"look": torch.tensor(len(looks))}, patience, loss=9.0)


def test_whichever_budget_is_used_up_first_counts_and_zero_means_none() -> None:
    assert budget_fraction(5, 1.0, steps=10, seconds=100) == 0.5
    assert budget_fraction(1, 80.0, steps=10, seconds=100) == 0.8
    assert budget_fraction(9, 80.0, steps=0, seconds=0) == 0.0
    with pytest.raises(ConfigError, match="needs a budget"):
        Budget(0, 0)


def test_the_best_weights_of_all_looks_are_kept_and_reported() -> None:
    judge, seen = held_out([5.0, 3.0, 4.0]), list[FitProgress]()
    fractions: list[float] = []

    def learn(fraction: float) -> float | None:
        fractions.append(fraction)
        return None if len(fractions) == 2 else 1.0

    assert fit(learn, Budget(0, 6, 3, seen.append), judge) == 6
    assert (judge.loss, judge.step, int(judge.best["look"])) == (3.0, 4, 2)
    assert [p.step for p in seen] == [1, 3, 4, 5, 6], "there was nothing to learn from in the second"
    assert [p.step for p in seen if p.best] == [3, 4] and seen[-1].held_out_loss == 4.0
    assert fractions == [i / 6 for i in range(6)] and seen[-1].fraction == 1.0


def test_it_ends_early_without_a_better_loss_but_not_before_its_time() -> None:
    judge = held_out([9.5] * 10, patience=2)
    assert fit(lambda _: 1.0, Budget(0, 10, 10), judge) == 2
    judge = held_out([9.5] * 10, patience=2)
    judge.patient_until = 0.5
    assert fit(lambda _: 1.0, Budget(0, 10, 10), judge) == 6
    assert fit(lambda _: 1.0, Budget(0, 10, 10), held_out([9.5] * 10)) == 10


def test_a_stopped_fit_keeps_what_was_learned_since_the_last_look() -> None:
    judge, done = held_out([2.0]), list[FitProgress]()
    assert fit(lambda _: 1.0, Budget(0, 100, 1, done.append, lambda: len(done) >= 5), judge) == 5
    assert judge.step == 5 and judge.loss == 2.0


def test_where_nothing_is_held_out_the_last_weights_are_kept() -> None:
    judge = held_out([math.inf] * 3)
    judge.loss = math.inf
    fit(lambda _: 1.0, Budget(0, 3, 3), judge)
    assert judge.step == 3


def test_a_time_budget_holds_all_of_it_the_last_look_included(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("semantic_mapper.training.fit.time.monotonic", lambda: now[0])

    def spend(seconds: float) -> float:
        now[0] += seconds
        return 1.0

    budget, looks = Budget(20.0, 0, 2), list[float]()
    judge = HeldOut(lambda: (looks.append(now[0]) or spend(2.0), 0.5), dict, loss=9.0)
    with budget.looking():
        spend(2.0)
    assert fit(lambda _: spend(1.0), budget, judge) == 14 and len(looks) == 2
    assert budget.elapsed_s == 20.0


def test_parts_share_the_time_and_the_progress_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    now, seen = [0.0], list[FitProgress]()
    monkeypatch.setattr("semantic_mapper.training.fit.time.monotonic", lambda: now[0])
    whole = Budget(10.0, 0, on_progress=seen.append)
    for until, steps in ((0.4, 4), (1.0, 6)):

        def learn(_: float) -> float:
            now[0] += 1.0
            return 1.0

        assert fit(learn, whole.part(until)) == steps
    assert [round(p.fraction, 1) for p in seen] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    assert whole.part(1.0).seconds == 0.5, "a late part has a little, too"
