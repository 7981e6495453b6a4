"""NeSF's arms: densities that are fitted once, and a network that learns from label images alone."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from research.scenes.klevr import BOX_HIGH_M, BOX_LOW_M
from research.suites.klevr import (
    POINTS,
    TEST_CAMERAS,
    TRAIN_CAMERAS,
    VIEW_ARMS,
    KlevrConfig,
    novel_seeds,
    scenes_of_arm,
    surface_points,
)
from research.suites.klevr_claims import CLAIMS
from research.suites.klevr_grids import KlevrGridConfig, scene_density
from research.suites.klevr_nesf import (
    NESF_ARMS,
    arm_network,
    arm_settings,
    exact_grid,
    nesf_arms,
    nesf_network,
    nesf_scores,
    network_path,
    training_of,
)
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import KLEVR

GRID = KlevrGridConfig(views=8, checked_views=2, checked_from=8, width=32, long_side=32, steps=60)
TINY = KlevrConfig(
    train_scenes=3,
    novel_scenes=2,
    width=40,
    views=30,
    train_views=26,
    label_maps=6,
    scored_views=3,
    grid_steps=150,
    nesf_steps=120,
)


def test_a_density_is_fitted_once_and_is_the_same_when_read(tmp_path: Path) -> None:
    first = scene_density(GRID, 3, tmp_path)
    (file,) = tmp_path.iterdir()
    before = file.stat().st_mtime_ns, file.read_bytes()
    again = scene_density(GRID, 3, tmp_path)
    assert (file.stat().st_mtime_ns, file.read_bytes()) == before
    assert again.grid == first.grid and np.array_equal(again.raw, first.raw) and again.psnr == first.psnr
    assert np.isfinite(first.psnr)
    for damaged in (before[1][:-100], before[1][:400] + bytes(200) + before[1][600:], b""):
        file.write_bytes(damaged)
        mended = scene_density(GRID, 3, tmp_path)
        assert np.array_equal(mended.raw, first.raw) and file.read_bytes() == before[1]


@pytest.mark.slow
def test_the_network_learns_more_than_the_background(tmp_path: Path) -> None:
    training = msgspec.structs.replace(training_of(TINY, size=32), first_rate=6e-3, last_rate=1e-3)
    torch.set_num_threads(1)
    arm = NESF_ARMS["nesf"]
    scores = nesf_scores(TINY, nesf_network(TINY, training, tmp_path, arm), tmp_path, arm)
    assert set(scores) == set(novel_seeds(TINY))
    background = KLEVR.names.index("background")
    for kind in (TRAIN_CAMERAS, TEST_CAMERAS, POINTS):
        found, plain = ConfusionMatrix(KLEVR), ConfusionMatrix(KLEVR)
        for kinds in scores.values():
            found += kinds[kind]
            plain.counts[:, background] += kinds[kind].counts.sum(1)
        assert (found.metrics().miou or 0) > (plain.metrics().miou or 0) + 0.03, kind
    again = nesf_scores(TINY, nesf_network(TINY, training, tmp_path, arm), tmp_path, arm)  # of what was kept
    assert all(np.array_equal(again[s][k].counts, scores[s][k].counts) for s in scores for k in scores[s])


def test_points_lie_on_the_surface_with_the_class_of_their_pixel() -> None:
    xyz, truth = surface_points(TINY, novel_seeds(TINY)[0])
    assert len(xyz) == len(truth) > 500 and len(np.unique(truth)) > 2
    assert (xyz >= np.array(BOX_LOW_M) - 1e-3).all() and (xyz <= np.array(BOX_HIGH_M) + 1e-3).all()
    floor = np.abs(xyz[:, 2]) < 1e-3
    assert (truth[floor & (truth != KLEVR.id_of("background"))].size) < 0.05 * len(truth)
    assert (truth[xyz[:, 2] > 0.05] != KLEVR.id_of("background")).all()


def test_every_arm_that_a_claim_names_exists_and_few_scenes_serve_those_of_few_views(tmp_path: Path) -> None:
    named = {arm for claim in CLAIMS for arm in claim.arms}
    assert named - {"color", "unet"} == nesf_arms(tmp_path).keys() - {"exact-points"} and VIEW_ARMS.keys() <= named
    few = scenes_of_arm(KlevrConfig(), "nesf-5-views")
    assert (few.train_scenes, few.novel_scenes) == (12, 6)
    assert scenes_of_arm(TINY, "nesf-5-views").novel_scenes == 2 and scenes_of_arm(TINY, "nesf") == TINY


@pytest.mark.parametrize("name", ["nesf", "exact-points"])
def test_a_curve_of_other_scenes_or_pictures_is_not_taken(name: str, tmp_path: Path) -> None:
    changes = {
        "novel_scenes": 3,
        "variant": "float",
        "width": 44,
        "train_views": 25,
        "scored_views": 4,
        "train_scenes": 2,
    }
    paths: set[Path] = set()
    for changed in ({}, *({k: v} for k, v in changes.items())):
        config, training = arm_settings(msgspec.structs.replace(TINY, **changed), name)
        paths.add(network_path(config, training, tmp_path, NESF_ARMS[name]))
    assert len(paths) == len(changes) + 1


def test_damaged_files_of_an_arm_are_made_again(tmp_path: Path) -> None:
    few = msgspec.structs.replace(
        TINY, train_scenes=2, views=12, train_views=8, label_maps=3, nesf_steps=20, doublings=0
    )
    torch.set_num_threads(1)
    first, curve = arm_network(few, "exact-points", tmp_path)
    kept = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert len(kept) == 2 and curve[-1].step == 20
    for path, content in kept.items():
        path.write_bytes(content[: len(content) // 2])
        again, same = arm_network(few, "exact-points", tmp_path)
        assert same == curve and {p: p.read_bytes() for p in tmp_path.iterdir()} == kept
        assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))


def test_exact_points_learn_from_the_surface_and_are_scored_at_points_alone(tmp_path: Path) -> None:
    few = msgspec.structs.replace(TINY, train_scenes=2, views=12, train_views=8, label_maps=3, nesf_steps=60)
    xyz, _ = surface_points(few, novel_seeds(few)[0])
    grid = exact_grid(few, novel_seeds(few)[0])
    place = ((xyz - np.array(grid.config.origin_m)) / grid.config.voxel_m).round().astype(int)
    alpha = grid.alpha()
    assert (alpha[tuple(torch.from_numpy(place).T)] == 1).all() and 0.01 < (alpha > 0.5).float().mean() < 0.2
    torch.set_num_threads(1)
    arm = NESF_ARMS["exact-points"]
    scores = nesf_scores(few, nesf_network(few, training_of(few, size=32), tmp_path, arm), tmp_path, arm)
    assert {kind for kinds in scores.values() for kind in kinds} == {POINTS}
    metrics = sum((kinds[POINTS] for kinds in scores.values()), ConfusionMatrix(KLEVR)).metrics()
    assert metrics.miou is not None and metrics.miou > 0.25
    assert [path.suffix for path in sorted(tmp_path.iterdir())] == [".json", ".safetensors"]  # no density is fitted
