"""The suite KLEVR: which frames arms see, records that continue, and claims that are accepted and refused."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from semantic_mapper.benchmark.claims import Claim, check_claim
from semantic_mapper.benchmark.klevr import (
    CLAIMS,
    TEST_CAMERAS,
    TRAIN_CAMERAS,
    KlevrConfig,
    SceneScores,
    color_arm,
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
from semantic_mapper.benchmark.store import RecordStore
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import KLEVR
from semantic_mapper.types import PosedFrame, UInt8

TINY = KlevrConfig(train_scenes=2, novel_scenes=3, width=32, views=10, train_views=7, label_maps=3, scored_views=2)


def right(frame: PosedFrame) -> UInt8:
    assert frame.label is not None
    return frame.label


def background(frame: PosedFrame) -> UInt8:
    return np.full(frame.rgb.shape[:2], KLEVR.id_of("background"), np.uint8)


def matrices(correct: list[int], wrong: int = 10) -> dict[int, ConfusionMatrix]:
    """Scenes of two classes: ``correct`` pixels of each are right, ``wrong`` are taken for the other."""
    found: dict[int, ConfusionMatrix] = {}
    for scene, count in enumerate(correct):
        matrix = found[scene] = ConfusionMatrix(KLEVR)
        matrix.counts[0, :2] = matrix.counts[1, 1::-1] = count, wrong
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


def test_records_are_kept_and_not_made_again(tmp_path: Path) -> None:
    calls: list[str] = []

    def arm(config: KlevrConfig) -> SceneScores:
        calls.append("arm")
        return score_images(config, right)

    path = tmp_path / "klevr.jsonl"
    assert list(run_klevr(TINY, {"nesf": arm}, RecordStore(path))) == ["nesf"]
    store = RecordStore(path)
    assert list(run_klevr(TINY, {"nesf": arm}, store)) == [] and calls == ["arm"]
    assert list(run_klevr(msgspec.structs.replace(TINY, seed=1), {"nesf": arm}, store, lambda: True)) == []
    scores = klevr_scores([TINY], store)
    assert set(scores) == {("nesf", TRAIN_CAMERAS), ("nesf", TEST_CAMERAS)}
    assert set(scores["nesf", TEST_CAMERAS]) == set(novel_seeds(TINY))
    twice = klevr_scores([TINY, TINY], store)["nesf", TEST_CAMERAS]
    for scene, matrix in scores["nesf", TEST_CAMERAS].items():
        assert np.array_equal(twice[scene].counts, 2 * matrix.counts)
    same = next(c for c in CLAIMS if c.name == "the same at test cameras")
    assert check_claim(same, scores).result == "accepted"
    assert klevr_digest(TINY) != klevr_digest(msgspec.structs.replace(TINY, mlp_steps=7))


def test_the_colour_of_a_pixel_gives_the_background_and_little_more() -> None:
    config = msgspec.structs.replace(TINY, train_scenes=8, mlp_steps=150)
    total = ConfusionMatrix(KLEVR)
    for kinds in color_arm(config).values():
        total += kinds[TRAIN_CAMERAS]
    metrics = total.metrics()
    assert metrics.miou is not None and metrics.miou < 0.4
    assert metrics.per_class["background"] > 0.9


def test_claims_are_accepted_refused_and_not_run() -> None:
    a, b = ("a", TRAIN_CAMERAS), ("b", TRAIN_CAMERAS)
    scores = {a: matrices([90, 80, 85, 95]), b: matrices([60, 50, 55, 65])}
    gain = check_claim(Claim("gain", "", a, b, least=5.0), scores)
    assert gain.result == "accepted" and gain.scenes == 4
    assert gain.low is not None and gain.difference is not None and gain.high is not None
    assert 0 < gain.low <= gain.difference <= gain.high
    assert check_claim(Claim("too much", "", a, b, least=50.0), scores).result == "refused"
    assert check_claim(Claim("reversed", "", b, a, least=5.0), scores).result == "refused"
    assert check_claim(Claim("a gate", "", a, most=30.0), scores).result == "refused"
    assert check_claim(Claim("a gate", "", a, most=90.0), scores).result == "accepted"
    assert check_claim(Claim("95 %", "", b, a, least=0.0, factor=0.95), scores).result == "refused"
    assert check_claim(Claim("90 %", "", b, a, least=0.0, factor=0.9), scores).result == "accepted"
    missing = check_claim(Claim("none", "", a, ("c", TRAIN_CAMERAS), least=1.0), scores)
    assert (missing.result, missing.difference) == ("not run", None)
    one = {a: {0: scores[a][0]}, b: {0: scores[b][0]}}
    assert check_claim(Claim("one scene", "", a, b, least=1.0), one).result == "not run"


def test_a_gain_whose_interval_reaches_zero_is_refused() -> None:
    a, b = ("a", TRAIN_CAMERAS), ("b", TRAIN_CAMERAS)
    scores = {a: matrices([900, 20, 20]), b: matrices([20, 30, 30])}
    found = check_claim(Claim("one lucky scene", "", a, b, least=5.0), scores)
    assert found.difference is not None and found.low is not None
    assert found.difference > 5.0 and found.low <= 0.0 and found.result == "refused"


def test_settings_that_no_run_can_follow_are_refused(tmp_path: Path) -> None:
    for changes in ({"train_views": 9}, {"label_maps": 8}):
        config = msgspec.structs.replace(TINY, **changes)
        with pytest.raises(ConfigError, match="label maps"):
            list(run_klevr(config, {}, RecordStore(tmp_path / "a.jsonl")))
