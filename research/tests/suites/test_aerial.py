"""The suite AERIAL: which frames arms see, records that continue, arms that run, claims that are judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from research.suites.aerial import (
    AGREEMENT,
    DARK,
    DAY,
    LOW,
    AerialConfig,
    Episode,
    aerial_digest,
    aerial_table,
    episodes,
    labelled_frames,
    run_aerial,
    score_episode,
    scored_views,
    thin,
    thinned,
    training_frames,
)
from research.suites.aerial_claims import CLAIMS, DARK_DROP, MIOU
from research.suites.aerial_fields import field_arms
from research.suites.aerial_grids import town_grid
from research.suites.aerial_irt import irt_arms
from research.suites.claims import Claim, Counts, Unit, check_claim, check_claims, figure
from research.suites.scene_runs import ViewScores
from research.suites.store import RecordStore
from semantic_mapper.labels import CARLA
from semantic_mapper.types import PosedFrame, UInt8

TINY = AerialConfig(
    towns=1,
    choices=2,
    width=48,
    train_views=24,
    test_views=4,
    low_views=2,
    voxel_m=3.0,
    grid_steps=120,
    nerf_steps=60,
    unet_steps=2,
    trunk_steps=30,
    irt_steps=40,
    mlp_steps=120,
    score_every=1,
)
EPISODE = Episode(200_000, 0)
TERRAIN = CARLA.id_of("terrain")


def terrain(frame: PosedFrame, every: int) -> UInt8:
    """All is terrain."""
    return np.full(thinned(frame, every).rgb.shape[:2], TERRAIN, np.uint8)


def total(scores: ViewScores, kind: str) -> Counts:
    """All views together."""
    return np.sum(list(scores[kind].values()), axis=0)


def miou(scores: ViewScores, kind: str = DAY) -> float:
    """In points."""
    value = figure({("a", kind): {(0, v): c for v, c in scores[kind].items()}}, "a", replace(MIOU, kinds=(kind,)))
    assert value is not None
    return value


def test_four_training_views_have_labels_and_none_has_depth() -> None:
    frames = training_frames(TINY, EPISODE)
    assert len(frames) == 24 and all(f.depth_m is None for f in frames)
    assert [f.seq for f in frames if f.label is not None] == [f.seq for f in labelled_frames(TINY, EPISODE)]
    assert len(labelled_frames(TINY, EPISODE)) == 4
    scored = {v.frame.seq for kind in (DAY, DARK, LOW) for v in scored_views(TINY, EPISODE, kind)}
    assert not scored & {f.seq for f in frames}
    other = {f.seq for f in labelled_frames(TINY, Episode(200_000, 1))}
    assert other != {f.seq for f in labelled_frames(TINY, EPISODE)}


def test_the_truth_scores_100_and_one_class_little() -> None:
    truth = {}
    for kind in (DAY, DARK, LOW):
        truth |= {v.frame.rgb.tobytes(): v.rendered.label for v in scored_views(TINY, EPISODE, kind)}
    right = score_episode(TINY, EPISODE, lambda frame, every: thin(truth[frame.rgb.tobytes()], every))
    assert [round(miou(right, kind), 6) for kind in (DAY, DARK, LOW)] == [100.0] * 3
    agreeing, compared = total(right, AGREEMENT)[0]
    assert compared > 500 and agreeing / compared > 0.9
    plain = score_episode(TINY, EPISODE, terrain)
    assert miou(plain) < 5.0
    agreeing, compared = total(plain, AGREEMENT)[0]
    assert agreeing == compared > 500


def test_arms_are_not_shown_the_truth_they_are_scored_by() -> None:
    def predict(frame: PosedFrame, every: int) -> UInt8:
        assert frame.label is None and frame.depth_m is None
        return terrain(frame, every)

    assert set(score_episode(TINY, EPISODE, predict)) == {DAY, DARK, LOW, AGREEMENT}


def test_a_run_goes_on_where_it_was(tmp_path: Path) -> None:
    calls: list[Episode] = []

    def arm(config: AerialConfig, episode: Episode) -> ViewScores:
        calls.append(episode)
        return score_episode(config, episode, terrain)

    path = tmp_path / "aerial.jsonl"
    stop_after_one = iter([False, True])
    done = list(run_aerial(TINY, {"a": arm}, RecordStore(path), lambda: next(stop_after_one)))
    assert done == [("a", EPISODE)] and aerial_table(TINY, ["a"], RecordStore(path)) == {}
    assert list(run_aerial(TINY, {"a": arm}, RecordStore(path))) == [("a", Episode(200_000, 1))]
    assert list(run_aerial(TINY, {"a": arm}, RecordStore(path))) == [] and calls == episodes(TINY)
    table = aerial_table(TINY, ["a", "b"], RecordStore(path))
    assert set(table) == {("a", kind) for kind in (DAY, DARK, LOW, AGREEMENT)}
    assert len(table["a", DAY]) == 4 and sum(int(c.sum()) for c in table["a", DAY].values()) == 2 * 4 * 48 * 48
    assert aerial_digest(TINY) != aerial_digest(msgspec.structs.replace(TINY, grid_steps=7))
    assert aerial_digest(TINY) == aerial_digest(msgspec.structs.replace(TINY, towns=2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where grids are kept."""
    return tmp_path_factory.mktemp("grids")


def test_a_grid_is_fitted_once_and_knows_depth(folder: Path) -> None:
    made = town_grid(TINY, EPISODE.town, folder)
    assert made.psnr > 20.0 and made.depth_error < 0.05 and made.known > 0.5
    (path,) = folder.glob("aerial-*.npz")
    stamp = path.stat().st_mtime_ns
    again = town_grid(TINY, EPISODE.town, folder)
    assert torch.equal(again.grid.values, made.grid.values) and torch.equal(again.grid.occupied, made.grid.occupied)
    assert path.stat().st_mtime_ns == stamp and again.psnr == made.psnr
    path.write_bytes(b"no grid")
    assert torch.equal(town_grid(TINY, EPISODE.town, folder).grid.values, made.grid.values)


@pytest.mark.parametrize("name", ["warp", "semantic-nerf", "irt-b", "irt-carry"])
def test_arms_on_a_grid_beat_one_class(name: str, folder: Path) -> None:
    scores = (field_arms(folder) | irt_arms(folder))[name](TINY, EPISODE)
    assert miou(scores) > 5.0 > 3.0 * miou(score_episode(TINY, EPISODE, terrain))


def table_of(values: dict[str, list[int]], kind: str = DAY) -> dict[tuple[str, str], dict[Unit, Counts]]:
    """Arms that have that many of 100 pixels of each of two classes right, by view."""
    found: dict[tuple[str, str], dict[Unit, Counts]] = {}
    for arm, right in values.items():
        for view, n in enumerate(right):
            counts = np.zeros((len(CARLA), len(CARLA) + 1), np.int64)
            counts[:2, :2] = [[n, 100 - n], [100 - n, n]]
            found.setdefault((arm, kind), {})[view % 2, view] = counts
    return found


def test_claims_are_accepted_refused_and_not_run() -> None:
    table = table_of({"a": [90, 80, 85, 95], "b": [60, 50, 55, 65]})
    gain = check_claim(Claim("gain", "", MIOU, "a", "b", least=5.0), table)
    assert gain.result == "accepted" and gain.units == 4
    assert gain.low is not None and gain.difference is not None and gain.high is not None
    assert 0 < gain.low <= gain.difference <= gain.high
    assert check_claim(Claim("too much", "", MIOU, "a", "b", least=60.0), table).result == "refused"
    assert check_claim(Claim("reversed", "", MIOU, "b", "a", least=0.0), table).result == "refused"
    assert check_claim(Claim("a gate", "", MIOU, "a", most=15.0), table).result == "refused"
    missing = check_claim(Claim("none", "", MIOU, "a", "c", least=1.0), table)
    assert (missing.result, missing.difference) == ("not run", None)
    assert {r.result for r in check_claims(CLAIMS, table)} == {"not run"}


def test_drops_are_relative_and_compared_with_a_factor() -> None:
    table = table_of({"a": [90, 90], "b": [90, 90]}) | table_of({"a": [80, 80], "b": [50, 50]}, DARK)
    drop = {arm: figure(table, arm, DARK_DROP) for arm in ("a", "b")}
    iou = {n: 100 * n / (200 - n) for n in (90, 80, 50)}
    assert drop["a"] == pytest.approx(100 * (1 - iou[80] / iou[90]))
    claim = Claim("half", "", DARK_DROP, "a", "b", most=0.0, factor=0.5)
    found = check_claim(claim, table)
    assert drop["b"] is not None and drop["a"] is not None
    assert found.difference == pytest.approx(drop["a"] - 0.5 * drop["b"]) and found.result == "accepted"
    assert check_claim(replace(claim, first="b", second="a"), table).result == "refused"
