from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from scripts.ship_weights import figures_of, ship
from semantic_mapper.benchmark.contestants import load_contestants
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from tests.small import tiny_field


def weights(folder: Path, revision: str | None = "a" * 40) -> Path:
    path = folder / "w.safetensors"
    save_checkpoint(Checkpoint(tiny_field(), (), {"git_revision": revision, "width": 160}), path)
    return path


def table(folder: Path, digest: str, **changes: Any) -> Path:
    suite = {"split": "test", "protocol": "generalize", "views": 8, "baseline": "narrow", "depth": True, "rooms": 0}
    figures = {"rooms": 20, "data_set": {"miou": 0.7}}
    found = {"suite": suite, "complete": True, "weights": {"w": {"digest": digest, "figures": figures}}} | changes
    path = folder / "on.json"
    path.write_text(json.dumps(found), encoding="utf-8")
    return path


def test_weights_are_shipped_with_their_figures(tmp_path: Path) -> None:
    path = weights(tmp_path)
    on = table(tmp_path, load_contestants([path])[0].digest)
    ship(path, [on], tmp_path / "rooms.safetensors")
    shipped = load_checkpoint(tmp_path / "rooms.safetensors")
    assert shipped.recipe["figures"] == [figures_of(path, on)]
    assert shipped.recipe["figures"][0]["data_set"] == {"miou": 0.7} and shipped.recipe["figures"][0]["depth"] is True
    assert shipped.width == 160


def test_figures_of_other_weights_or_of_half_a_run_are_refused(tmp_path: Path) -> None:
    path = weights(tmp_path)
    with pytest.raises(ConfigError, match="no figures of"):
        figures_of(path, table(tmp_path, "0123"))
    with pytest.raises(ConfigError, match="all rooms"):
        figures_of(path, table(tmp_path, load_contestants([path])[0].digest, complete=False))
    with pytest.raises(ConfigError, match="not a table"):
        figures_of(path, path)


@pytest.mark.parametrize("revision", [None, "abc-dirty"])
def test_weights_that_no_commit_can_make_again_are_refused(tmp_path: Path, revision: str | None) -> None:
    path = weights(tmp_path, revision)
    with pytest.raises(WeightsError, match="commit first"):
        ship(path, [], tmp_path / "rooms.safetensors")
