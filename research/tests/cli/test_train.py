"""``train``."""

from __future__ import annotations

import dataclasses
import hashlib
import signal
from pathlib import Path

import pytest

from research.tests.cli.support import run
from research.train.map_grids import made_of_room, training_map
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.nesf import load_nesf
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.labels import ROOMS
from tests.mapping.test_refine import UP, make_map
from tests.nodes.support import COMMAND as PRODUCT
from tests.nodes.support import Running, error_line, eventually
from tests.small import tiny_frames

ROOT = Path(__file__).resolve().parents[3]
COMMAND = PRODUCT.with_name("semantic-mapper-research")
CONFIG = """
seconds = 0
steps = 4
log_steps = 2
device = "cpu"
[field]
feature_dim = 16
heads = 2
[field.encoder]
channels = [8, 16]
blocks = [1, 1]
[images]
rooms = 1
[pool]
width = 48
views = 4
rooms = 3
rooms_at_start = 1
[step]
rays = 64
views_max = 4
[validation]
times = 1
rooms = 1
queries = 1
rays = 64
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


def test_training_into_a_folder_leaves_weights_state_history_and_curves(recipe: Path, tmp_path: Path) -> None:
    out = tmp_path / "made" / "run"
    done = run("train", "--config", recipe, "--out", out, "--seed", "3", "--half")
    assert done.returncode == 0, done.stderr
    assert "weights.safetensors: 4 steps on 1 rooms" in done.stdout
    assert "the best weights so far, of step 4: mIoU" in done.stdout
    names = {p.name for p in out.iterdir()}
    assert names >= {"weights.safetensors", "state.safetensors", "history.jsonl", "curves.png"}
    assert "after-images.safetensors" in names
    checkpoint = load_checkpoint(out / "weights.safetensors")
    assert checkpoint.recipe["seed"] == 3 and checkpoint.recipe["steps"] == 4 and checkpoint.width == 48


@pytest.mark.slow
def test_ctrl_c_saves_what_resume_goes_on_with(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text(f'keep = "last"\n{CONFIG}', encoding="utf-8")
    out = tmp_path / "rooms.safetensors"
    history = tmp_path / "rooms-training" / "history.jsonl"
    with Running("train", "--config", recipe, "--out", out, "--steps", "100000", command=COMMAND) as running:
        assert eventually(lambda: history.is_file() and len(history.read_text().splitlines()) >= 2), running.text
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 130, running.text
    assert "the state and the latest weights are saved, --resume goes on" in running.text
    stopped_at = load_checkpoint(out).recipe["steps"]
    assert stopped_at >= 4
    done = run("train", "--config", recipe, "--out", out, "--steps", str(stopped_at + 2), "--resume")
    assert done.returncode == 0, done.stderr
    assert f"the weights of the last validation, of step {stopped_at + 2}: mIoU" in done.stdout
    assert load_checkpoint(out).recipe["steps"] == stopped_at + 2


def test_training_on_maps_goes_on_where_it_stopped(tmp_path: Path) -> None:
    frames = tiny_frames()
    field = hashlib.sha256(default_checkpoint_path().read_bytes()).hexdigest()
    for name, seed, rendered in (("100000", 100_000, 1), ("50000", 50_000, 1), ("50000-every-4", 50_000, 4)):
        found = training_map(make_map(), frames, ROOMS, UP)
        made_of = made_of_room(seed, field, rendered=rendered)
        dataclasses.replace(found, made_of=made_of).save(tmp_path / "maps" / f"room-{name}.npz")
    recipe = tmp_path / "tiny.toml"
    recipe.write_text(
        f'kind = "nesf"\nrooms = 1\nvalidation_rooms = 1\nsteps = 4\nmaps = "{tmp_path / "maps"}"\n'
        "labelled_voxels = 500\nvalidate_every = 2\n[field]\nwidth = 2\n",
        encoding="utf-8",
    )
    out = tmp_path / "run"
    done = run("train", "--config", recipe, "--out", out, "--steps", "2")
    assert done.returncode == 0, done.stderr
    assert "weights.safetensors: 2 steps on 2 maps" in done.stdout
    done = run("train", "--config", recipe, "--out", out, "--resume")
    assert done.returncode == 0, done.stderr
    recipe_of = load_nesf(out / "weights.safetensors").recipe
    assert recipe_of["steps"] == 4 and [line["step"] for line in recipe_of["history"]] == [0, 2, 4]
    again = run("train", "--config", recipe, "--out", out)
    assert again.returncode == 1 and "a run has finished here" in error_line(again.stderr)
    done = run("train", "--config", recipe, "--out", tmp_path / "other", "--workers", "2")
    assert done.returncode == 1 and "--workers" in error_line(done.stderr)
