from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from research.suites.entries import load_entries
from research.train.mean_weights import mean
from research.train.ship_weights import BEGIN, END, convert, figures_of, metadata_block, ship
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.labels import ROOMS, make_label_set
from tests.small import tiny_field

COMMIT = "a" * 40


def run(revision: str | None = COMMIT, **more: Any) -> dict[str, Any]:
    """The recipe of a run."""
    return {"git_revision": revision, "width": 160, "steps": 1500, **more}


def origin(recipe: dict[str, Any]) -> dict[str, Any]:
    return {"file": "weights.safetensors", "sha256": "0" * 64, "recipe": recipe}


def weights(folder: Path, recipe: dict[str, Any] | None = None) -> Path:
    path = folder / "w.safetensors"
    save_checkpoint(Checkpoint(tiny_field(), (), recipe or run()), path)
    return path


def table(path: Path, digest: str, *, depth: str = "on", views: int = 8, **changes: Any) -> Path:
    suite = {
        "split": "test",
        "protocol": "generalize",
        "views": views,
        "sources": "near",
        "own_image": True,
        "depth": depth,
    }
    figures = {"rooms": 20, "images": 80, "data_set": {"miou": 0.7 if depth == "on" else 0.5}, "ece": 0.02}
    entry = {"digest": digest, "figures": figures}
    found = {"suite": suite | {"rooms": 0}, "complete": True, "weights": {"w": entry}} | changes
    path.write_text(json.dumps(found), encoding="utf-8")
    return path


def tables(folder: Path, weights: Path, **changes: Any) -> list[Path]:
    """With depth and without."""
    digest = load_entries([weights])[0].digest
    return [
        table(folder / "off.json", digest, depth="off"),
        table(folder / "on.json", digest, **changes),
    ]


def card(folder: Path) -> Path:
    path = folder / "card.md"
    path.write_text(f"# Card\n\n{BEGIN}\nold\n{END}\n\nProse.\n", encoding="utf-8")
    return path


def test_what_was_measured_is_shipped_bit_by_bit_with_its_figures(tmp_path: Path) -> None:
    half, out, page = tmp_path / "half.safetensors", tmp_path / "rooms.safetensors", card(tmp_path)
    convert(weights(tmp_path), half)
    ship(half, tables(tmp_path, half), out, page)
    measured, shipped = load_checkpoint(half), load_checkpoint(out)
    state = shipped.model.state_dict()
    assert all(torch.equal(state[name], tensor) for name, tensor in measured.model.state_dict().items())
    assert [figure["depth"] for figure in shipped.recipe["figures"]] == ["on", "off"]
    assert [figure["data_set"]["miou"] for figure in shipped.recipe["figures"]] == [0.7, 0.5]
    assert shipped.recipe["figures"][0] == figures_of(half, tmp_path / "on.json")
    assert shipped.recipe["figures"][0]["measured"] == load_entries([half])[0].digest
    assert shipped.width == 160
    assert page.read_text(encoding="utf-8") == f"# Card\n\n{BEGIN}\n{metadata_block(out)}{END}\n\nProse.\n"


def test_weights_that_were_measured_before_they_were_converted_are_refused(tmp_path: Path) -> None:
    full, out = weights(tmp_path), tmp_path / "rooms.safetensors"
    with pytest.raises(WeightsError, match="--half-only"):
        ship(full, tables(tmp_path, full), out, card(tmp_path))
    half = tmp_path / "half.safetensors"
    convert(full, half)
    with pytest.raises(ConfigError, match="no figures of"):
        ship(half, tables(tmp_path, full), out, card(tmp_path))
    assert not out.exists()


def test_figures_of_other_weights_or_of_half_a_run_are_refused(tmp_path: Path) -> None:
    path = weights(tmp_path)
    with pytest.raises(ConfigError, match="no figures of"):
        figures_of(path, table(tmp_path / "on.json", "0123"))
    with pytest.raises(ConfigError, match="all rooms"):
        figures_of(path, table(tmp_path / "on.json", load_entries([path])[0].digest, complete=False))
    with pytest.raises(ConfigError, match="not a table"):
        figures_of(path, path)


@pytest.mark.parametrize("revision", [None, "abc", f"{COMMIT}-dirty"])
def test_weights_that_no_commit_can_make_again_are_refused_however_far_back(
    tmp_path: Path, revision: str | None
) -> None:
    first = run(revision)
    second = run(origins=[origin(first)])
    for recipe in (first, second, run(origins=[origin(second)])):
        with pytest.raises(WeightsError, match="commit first"):
            convert(weights(tmp_path, recipe), tmp_path / "half.safetensors")


def test_the_card_lists_the_runs_from_the_first_to_the_last(tmp_path: Path) -> None:
    images = {"kind": "unet", "images": {"share": 1.0}, "keep": "best", "validation": {"times": 8}}
    rays = {"kind": "sray", "images": {"share": 0.0}, "keep": "last", "field": {"encoder": {"depth": True}}}
    first = run("b" * 40, config=images, steps=4800, best_step=4200, rooms=3216, seed=3, seconds=61.4, device="cpu")
    path = weights(tmp_path, run(config=rays, origins=[origin(first)]))
    lines = metadata_block(path).splitlines()
    start = next(i for i, line in enumerate(lines) if "| steps |" in line)
    assert lines[start + 2].startswith("| 1 | - | images | as by default | 4,800 | best of 8: step 4200 | 3,216 | 3 |")
    assert lines[start + 2].endswith("| `bbbbbbb` | 61 |")
    assert lines[start + 3].startswith("| 2 | 1 | rays | colours and depth | 1,500 | last |")
    assert "Nothing was measured." in lines


def test_a_mean_is_of_each_class_in_the_files_that_know_it_and_names_them_all(tmp_path: Path) -> None:
    fewer = make_label_set("rooms", ROOMS.names[:-1])
    paths, first = [tmp_path / "new.safetensors", tmp_path / "old.safetensors"], run(seed=1)
    fields = tiny_field(seed=1), tiny_field(fewer, seed=2)
    for path, field, recipe in zip(paths, fields, (run(seed=2, origins=[origin(first)]), first), strict=True):
        save_checkpoint(Checkpoint(field, (), recipe), path)
    made = mean(paths)
    new, old, both = (f.state_dict() for f in (*fields, made.model))
    name = next(n for n in new if n.startswith("encoder.") and n.endswith("weight"))
    torch.testing.assert_close(both[name], (new[name] + old[name]) / 2)
    rows = "classifier.weight"
    torch.testing.assert_close(both[rows][:-1], (new[rows][:-1] + old[rows]) / 2)
    torch.testing.assert_close(both[rows][-1], new[rows][-1])
    save_checkpoint(made, tmp_path / "mean.safetensors")
    lines = metadata_block(tmp_path / "mean.safetensors").splitlines()
    table = [line[:9] for line in lines if line.startswith("| ") and line[2].isdigit()]
    assert table == ["| 1 | - |", "| 2 | 1 |", "| 3 | 2, "]  # each run once, the mean behind those that it is of
    with pytest.raises(ConfigError, match=f"knows {ROOMS.names[-1]}.*name this file first"):
        mean(paths[::-1])
