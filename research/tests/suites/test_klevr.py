"""The suite KLEVR: which frames arms see, records that continue, and claims that are accepted and refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from research.suites.claims import Claim, Counts, Unit, check_claim
from research.suites.klevr import (
    POINTS,
    TEST_CAMERAS,
    TRAIN_CAMERAS,
    ArmScores,
    KlevrConfig,
    klevr_digest,
    klevr_scores,
    label_map_numbers,
    labelled_frames,
    novel_seeds,
    run_klevr,
    score_images,
    scored_numbers,
    train_seeds,
)
from research.suites.klevr_claims import CLAIMS, POINTS_MIOU, TRAIN_MIOU
from research.suites.plateau import PLATEAU, fit_to_plateau
from research.suites.store import RecordStore
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import KLEVR
from semantic_mapper.types import PosedFrame, UInt8

TINY = KlevrConfig(train_scenes=2, novel_scenes=3, width=32, views=10, train_views=7, label_maps=3, scored_views=2)


def right(frame: PosedFrame) -> UInt8:
    assert frame.label is not None
    return frame.label


def background(frame: PosedFrame) -> UInt8:
    return np.full(frame.rgb.shape[:2], KLEVR.id_of("background"), np.uint8)


def matrices(correct: list[int], wrong: int = 10) -> dict[Unit, Counts]:
    """Scenes of two classes: ``correct`` pixels of each are right, ``wrong`` are taken for the other."""
    found: dict[Unit, Counts] = {}
    for scene, count in enumerate(correct):
        counts = found[0, scene] = np.zeros((len(KLEVR), len(KLEVR) + 1), np.int64)
        counts[0, :2] = counts[1, 1::-1] = count, wrong
    return found


def test_frames_are_drawn_once_a_seed_and_scene() -> None:
    for scene in (*train_seeds(TINY), *novel_seeds(TINY)):
        maps, scored = label_map_numbers(TINY, scene), scored_numbers(TINY, scene)
        assert len(set(maps)) == 3 and max(maps) < 7
        assert len(set(scored[TRAIN_CAMERAS])) == len(set(scored[TEST_CAMERAS])) == 2
        assert max(scored[TRAIN_CAMERAS]) < 7 <= min(scored[TEST_CAMERAS])
    other = msgspec.structs.replace(TINY, seed=1)
    assert [label_map_numbers(TINY, s) for s in range(9)] != [label_map_numbers(other, s) for s in range(9)]
    assert not set(train_seeds(TINY)) & set(novel_seeds(TINY))
    assert len(labelled_frames(TINY)) == 6


def test_truth_scores_all_and_background_alone_a_sixth() -> None:
    total = {arm: ConfusionMatrix(KLEVR) for arm in (right, background)}
    for arm in total:
        for kinds in score_images(TINY, arm).values():
            total[arm] += kinds[TEST_CAMERAS]
    assert total[right].metrics().miou == 1.0
    miou = total[background].metrics().miou
    assert miou is not None and 0.1 < miou < 0.25


@pytest.mark.parametrize("gain", [0.004, 0.006, -0.006])
def test_records_are_kept_and_not_made_again(gain: float, tmp_path: Path) -> None:
    calls: list[str] = []

    def arm(config: KlevrConfig) -> ArmScores:
        calls.append("arm")
        return ArmScores(score_images(config, right), gain, 40)

    path = tmp_path / "klevr.jsonl"
    assert list(run_klevr(TINY, {"nesf": arm}, RecordStore(path))) == ["nesf"]
    store = RecordStore(path)
    assert list(run_klevr(TINY, {"nesf": arm}, store)) == [] and calls == ["arm"]
    assert list(run_klevr(msgspec.structs.replace(TINY, seed=1), {"nesf": arm}, store, lambda: True)) == []
    table, training = klevr_scores([TINY], ["nesf"], store)
    assert set(table) == {("nesf", TRAIN_CAMERAS), ("nesf", TEST_CAMERAS)}
    assert set(table["nesf", TEST_CAMERAS]) == {(0, scene) for scene in novel_seeds(TINY)}
    twice, _ = klevr_scores([TINY, TINY], ["nesf"], store)
    for unit, counts in table["nesf", TEST_CAMERAS].items():
        assert np.array_equal(twice["nesf", TEST_CAMERAS][unit], 2 * counts)
    same = next(c for c in CLAIMS if c.name == "the same at test cameras")
    assert training == ({"nesf"} if abs(gain) >= PLATEAU else set(), {"nesf": {40}})
    assert check_claim(same, table, training=training).result == "accepted"
    steps_matter = replace(same, at_plateau=("nesf",))
    expected = "not judged" if training.unfinished else "accepted"
    assert check_claim(steps_matter, table, training=training).result == expected
    assert klevr_digest(TINY) != klevr_digest(msgspec.structs.replace(TINY, mlp_steps=7))


def test_claims_compare_figures_of_one_arm_and_a_fraction() -> None:
    table = {("a", POINTS): matrices([90, 80, 85, 95]), ("a", TRAIN_CAMERAS): matrices([60, 50, 55, 65])}
    gain = check_claim(Claim("3D above 2D", "", POINTS_MIOU, "a", "a", TRAIN_MIOU, least=5.0), table)
    assert gain.result == "accepted" and gain.units == 4
    assert gain.low is not None and gain.difference is not None and gain.high is not None
    assert 0 < gain.low <= gain.difference <= gain.high
    less = Claim("95 %", "", TRAIN_MIOU, "a", "a", POINTS_MIOU, least=0.0, factor=0.95)
    assert check_claim(less, table).result == "refused"
    assert check_claim(replace(less, factor=0.8), table).result == "accepted"
    one = {score: {(0, 0): units[0, 0]} for score, units in table.items()}
    assert check_claim(less, one).result == "not run"


@pytest.mark.parametrize(
    ("reached", "steps", "gain"),
    [
        ((50, 60, 60.4), [10, 20], 0.004),
        ((50, 60, 59.6), [10, 20], -0.004),
        ((50, 60, 70, 80), [10, 20, 40], 0.1),
        ((50, 30, 30.1), [10, 20], 0.001),  # what loses is not at its plateau
    ],
)
def test_steps_are_doubled_until_the_plateau(reached: tuple[float, ...], steps: list[int], gain: float) -> None:
    asked: list[int] = []

    def fit(steps: int) -> tuple[int, float]:
        asked.append(steps)
        k = len(asked)
        return steps, (reached[k] - reached[k - 1]) / 100

    assert fit_to_plateau(fit, 10, doublings=2) == (steps[-1], pytest.approx(gain))
    assert asked == steps
    if reached[1] < reached[0] and gain > 0:
        asked.clear()
        assert fit_to_plateau(fit, 10, doublings=2, a_loss_ends_it=True)[0] == 10
