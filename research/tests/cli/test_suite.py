"""``benchmark``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from research.tests.cli.support import run
from semantic_mapper.fields.checkpoint import Checkpoint, save_checkpoint
from semantic_mapper.fields.nesf import Nesf, NesfConfig, NesfWeights, save_nesf
from semantic_mapper.labels import ROOMS
from tests.nodes.support import error_line
from tests.small import tiny_field

CONFIG = """
split = "val"
views = 3
map_frames = 2
[tier]
width = 48
guided = { guided = 4, free_space = 0 }
[sequence]
frames = 14
query_pairs = 1
pair_gap = 2
[scene]
keyframes = 3
guard = 1
shares = [1.0]
[mapper]
render = { encode_width = 48, scale = 0.125 }
voxel_map = { voxel_size_m = 0.05, unknown_below = 0.0 }
"""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("suite") / "suite.toml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("two")
    paths = folder / "first.safetensors", folder / "second.safetensors"
    for seed, path in enumerate(paths):
        save_checkpoint(Checkpoint(tiny_field(seed=seed), (), {"width": 48}), path)
    return paths


def test_weights_side_by_side_with_maps_and_a_second_call_that_continues(
    suite: Path, two: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "runs" / "ab.json"
    common = ("suite", "rooms", "--config", suite, "--out", out)
    first = run(*common, "--weights", two[0], "--rooms", "1", "--map")
    assert first.returncode == 0, first.stderr
    records = out.with_suffix(".jsonl").read_text().splitlines()
    assert len(records) == 3 and "map: mIoU of its points" in first.stdout, "views, map, map of own images"
    found = json.loads(out.read_text())
    assert (
        list(found["rows"]) == ["sray", "own", "vote", "vote_exact", "oracle", "unet"] and found["rows"]["unet"] is None
    )
    keys = {"miou", "total_accuracy", "average_accuracy", "interior_miou", "ece"}
    assert all(set(row) == keys for row in found["rows"].values() if row is not None)
    against = [(d["first"], d["second"], d["low"], d["high"]) for d in found["differences"]]
    baselines = [("sray", name) for name in ("own", "vote", "vote_exact", "oracle")]
    assert against == [(*pair, None, None) for pair in [*baselines, ("sray map", "own image + votes")]]
    assert all(isinstance(d["observed"], float) and d["note"] for d in found["differences"])
    assert "sray minus own: " in first.stdout and "no interval" in first.stdout
    assert list(found["map_rows"]) == ["sray map", "own image + votes", "unet + votes"]
    assert found["map_rows"]["own image + votes"]["map_miou"] is not None
    assert "own image + votes" in first.stdout and "vote of the views" in first.stdout
    save_nesf(NesfWeights(Nesf(ROOMS, NesfConfig(width=1)).eval()), tmp_path / "nesf.safetensors")
    refined = run(*common, "--weights", two[0], "--rooms", "1", "--map", "--refine", tmp_path / "nesf.safetensors")
    assert refined.returncode == 0, refined.stderr
    found = json.loads(out.read_text())
    assert list(found["map_rows"]) == ["sray map", "own image + votes", "unet + votes", "refined", "smoothed"]
    plain, same, smoothed = (found["map_rows"][name]["map_miou"] for name in ("sray map", "refined", "smoothed"))
    assert same == pytest.approx(plain, abs=1e-3) and smoothed != plain, "an untrained network changes nothing"
    assert "refined, worst of 1 rooms" in refined.stdout
    lone = run(*common, "--weights", two[0], "--rooms", "1", "--refine", tmp_path / "nesf.safetensors")
    assert lone.returncode == 2 and "--map" in lone.stderr
    records = out.with_suffix(".jsonl").read_text().splitlines()
    assert len(records) == 6, "the map again, refined, smoothed"
    both = run(*common, "--weights", two[0], "--weights", two[1], "--rooms", "2")
    assert both.returncode == 0, both.stderr
    lines = out.with_suffix(".jsonl").read_text().splitlines()
    assert lines[:6] == records and len(lines) == 9
    assert "first minus second" in both.stdout and "95 % interval" in both.stdout
    found = json.loads(out.read_text())
    assert found["complete"] and list(found["weights"]) == ["first", "second"]
    assert found["weights"]["first"]["figures"]["rooms"] == 2 and found["weights"]["first"]["map"] is None
    assert found["differences"][0]["scenes"] == 2 and not found["map_rows"]
    pairs = [(d["first"], d["second"]) for d in found["differences"]]
    assert pairs == [("first", "second"), *baselines]
    assert all(d["low"] <= d["high"] and d["note"] is None for d in found["differences"])
    assert out.with_suffix(".png").stat().st_size > 1000


@pytest.mark.slow
def test_fitting_shows_its_curve(suite: Path, two: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "fit.json"
    options = ("--protocol", "scratch", "--steps", "2", "--rooms", "1", "--depth", "off")
    done = run("suite", "rooms", "--config", suite, "--weights", two[0], *options, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "mIoU before fitting" in done.stdout and "2 steps" in done.stdout
    assert out.with_suffix(".curves.png").stat().st_size > 1000
    written = json.loads(out.read_text())
    assert written["suite"]["scene"]["seconds"] == 0 and written["suite"]["depth"] == "off"
    assert written["title"].endswith("1 room, scratch: 3 keyframes, 2 steps, 3 views, without depth, 48x36")


def test_a_kind_without_a_file_is_fitted_to_each_room(suite: Path, tmp_path: Path) -> None:
    out = tmp_path / "kind.json"
    options = ("--config", suite, "--kind", "semantic_nerf", "--out", out)
    done = run("suite", "rooms", *options, "--protocol", "scratch", "--steps", "2", "--rooms", "1")
    assert done.returncode == 0, done.stderr
    (column,) = json.loads(out.read_text())["weights"].items()
    assert column[0] == "semantic_nerf" and column[1]["file"] is None
    refused = run("suite", "rooms", *options, "--protocol", "generalize")
    assert refused.returncode == 1 and "--protocol scratch" in refused.stderr


def test_an_unknown_setting_names_the_nearest_one(tmp_path: Path) -> None:
    path = tmp_path / "suite.toml"
    path.write_text("veiws = 3\n", encoding="utf-8")
    done = run("suite", "rooms", "--config", path)
    assert done.returncode == 1
    assert "did you mean `views`" in error_line(done.stderr)


KLEVR_CONFIG = """
train_scenes = 2
novel_scenes = 2
width = 48
views = 6
train_views = 4
label_maps = 2
scored_views = 1
mlp_steps = 5
unet_steps = 2
"""


def test_klevr_shows_arms_and_claims_and_continues(tmp_path: Path) -> None:
    config, out = tmp_path / "klevr.toml", tmp_path / "klevr.json"
    config.write_text(KLEVR_CONFIG, encoding="utf-8")
    common = ("suite", "klevr", "--config", config, "--claims", "--out", out)
    first = run(*common, "--arm", "color")
    assert first.returncode == 0, first.stderr
    records = out.with_suffix(".jsonl").read_text().splitlines()
    assert len(records) == 2 and "rotation augmentation" in first.stdout and "not run" in first.stdout
    found = json.loads(out.read_text())
    assert set(found["arms"]) == {"color"} and "mIoU, test cameras" in found["arms"]["color"]["figures"]
    assert [c["result"] for c in found["claims"]].count("not run") == len(found["claims"]) - 1
    assert found["claims"][0]["result"] in ("accepted", "refused") and found["claims"][0]["units"] == 2
    again = run(*common, "--arm", "color", "--arm", "unet")
    assert again.returncode == 0, again.stderr
    lines = out.with_suffix(".jsonl").read_text().splitlines()
    assert lines[:2] == records and len(lines) == 4
    assert set(json.loads(out.read_text())["arms"]) == {"color", "unet"}


AERIAL_CONFIG = """
towns = 1
choices = 1
width = 32
train_views = 8
test_views = 2
low_views = 2
mlp_steps = 5
"""


def test_aerial_shows_arms_and_claims_and_continues(tmp_path: Path) -> None:
    config, out = tmp_path / "aerial.toml", tmp_path / "aerial.json"
    config.write_text(AERIAL_CONFIG, encoding="utf-8")
    command = ("suite", "aerial", "--config", config, "--claims", "--out", out, "--arm", "color")
    first = run(*command)
    assert first.returncode == 0, first.stderr
    records = out.with_suffix(".jsonl").read_bytes()
    assert "above U-Net" in first.stdout and "not run" in first.stdout
    found = json.loads(out.read_text())
    assert set(found["arms"]) == {"color"} and found["arms"]["color"]["figures"]["mIoU"] > 0
    assert found["claims"][0]["result"] in ("accepted", "refused") and found["claims"][1]["result"] == "not run"
    again = run(*command)
    assert again.returncode == 0 and out.with_suffix(".jsonl").read_bytes() == records


def test_streets_shows_arms_and_claims(tmp_path: Path) -> None:
    config, out = tmp_path / "streets.toml", tmp_path / "streets.json"
    config.write_text("streets = 1\nwidth = 48\npairs = 3\nscored_every = 2\n", encoding="utf-8")
    arms = ("--arm", "nearest", "--arm", "map")
    done = run("suite", "streets", "--config", config, "--claims", "--out", out, *arms)
    assert done.returncode == 0, done.stderr
    assert "claims of Panoptic NeRF" in done.stdout and "not run" in done.stdout
    found = json.loads(out.read_text())
    assert set(found["arms"]) == {"nearest", "map"} and found["arms"]["nearest"]["figures"]["PQ"] > 0
    assert found["arms"]["map"]["figures"]["depth answered"] > 10
