"""The suite STREETS: a perfect answer has perfect figures, records are kept, and boxes mean the same everywhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from research.suites.claims import figure
from research.suites.scene_runs import ViewScores
from research.suites.store import RecordStore
from research.suites.streets import (
    ARMS,
    CLAIMS,
    CONSISTENCY,
    MEASURES,
    MIOU,
    PQ,
    RMSE,
    Answer,
    StreetsConfig,
    drive,
    primitives_at,
    run_streets,
    score_street,
    street_seeds,
    streets_digest,
    streets_table,
)
from research.suites.streets_panoptic import panoptic_arms
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import PosedFrame

TINY = StreetsConfig(streets=1, width=88, pairs=8, scored_every=4)
SEED = street_seeds(TINY)[0]


def truth_arm(config: StreetsConfig, seed: int) -> ViewScores:
    street = drive(config, seed)

    def answer(frame: PosedFrame) -> Answer:
        assert frame.label is None
        view = street.left[frame.seq].rendered
        return Answer(view.label, view.instance, view.exact_depth_m)

    return score_street(config, street, answer)


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, float | None]]:
    arms = {"truth": truth_arm, **ARMS}
    store = RecordStore(tmp_path_factory.mktemp("streets") / "a.jsonl")
    assert list(run_streets(TINY, arms, store)) == [(name, SEED) for name in arms]
    assert list(run_streets(TINY, arms, store)) == []
    table = streets_table(TINY, list(arms), store)
    return lambda arm: {measure.name: figure(table, arm, measure) for measure in MEASURES}


def test_the_truth_has_perfect_figures(figures: Callable[[str], dict[str, float | None]]) -> None:
    found = figures("truth")
    assert found[MIOU.name] == found[PQ.name] == found["PQ+"] == pytest.approx(100)
    assert found["depth within 1.25"] == found["depth answered"] == 100 and found[RMSE.name] == 0
    consistency = found[CONSISTENCY.name]
    assert consistency is not None and consistency > 95, "points of two frames within 10 cm may be of two classes"


def test_boxes_help_the_predicted_labels(figures: Callable[[str], dict[str, float | None]]) -> None:
    miou = {arm: figures(arm)[MIOU.name] or 0.0 for arm in ARMS}
    assert 50 < miou["pseudo"] < 80 and miou["box-crf"] > miou["pseudo"] and miou["nearest"] > 40
    assert figures("pseudo")[PQ.name] is None and (figures("box-crf")[PQ.name] or 0) > 30


def test_boxes_hold_the_same_points_as_primitives() -> None:
    street, rng = drive(TINY, SEED), np.random.default_rng(0)
    boxes = [box for box in street.boxes if np.linalg.norm(box.T_world_box[:2, 3]) < 25][:40]
    points = rng.uniform((0, -10, -0.5), (25, 10, 6), (500, 3))
    inside = primitives_at(boxes, 0).inside(points)
    own = np.stack([box.contains(points) for box in boxes], axis=1)
    assert own.any() and (inside != own).mean() < 2e-3, "ellipsoids are meshes there"


def test_settings_that_score_one_image_are_refused(tmp_path: Path) -> None:
    config = msgspec.structs.replace(TINY, scored_every=8)
    with pytest.raises(ConfigError, match="lower scored_every"):
        list(run_streets(config, {}, RecordStore(tmp_path / "a.jsonl")))
    assert streets_digest(TINY) != streets_digest(config)
    assert streets_digest(TINY) == streets_digest(msgspec.structs.replace(TINY, streets=2))


def test_claims_name_arms_once() -> None:
    assert len({claim.name for claim in CLAIMS}) == len(CLAIMS)
    assert {claim.second for claim in CLAIMS} >= {"pseudo", "map", "box-crf"}


def test_a_field_is_fitted_once_and_rendered_in_two_ways(tmp_path: Path) -> None:
    config = msgspec.structs.replace(TINY, width=48, pairs=2, scored_every=1, voxel_m=2.5, field_steps=2)
    arms = panoptic_arms(tmp_path)
    learned = arms["panoptic"](config, SEED)
    (file,) = tmp_path.iterdir()
    made = file.stat().st_mtime_ns
    fixed = arms["panoptic-fixed"](config, SEED)
    assert [f.stat().st_mtime_ns for f in tmp_path.iterdir()] == [made]
    assert set(learned) == {"labels", "panoptic", "agreement", "depth"}
    assert not np.array_equal(learned["labels"][0], fixed["labels"][0])
    assert np.array_equal(learned["depth"][0], fixed["depth"][0])


def test_a_grid_without_boxes_names_classes_and_no_things(tmp_path: Path) -> None:
    config = msgspec.structs.replace(TINY, width=48, pairs=2, scored_every=1, voxel_m=2.5, field_steps=2)
    found = panoptic_arms(tmp_path)["grid-labels"](config, SEED)
    assert set(found) == {"labels", "agreement", "depth"}
    assert "panoptic" in panoptic_arms(tmp_path)["panoptic-uniform"](config, SEED)
