"""``finetune`` and ``eval``."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.nodes.console import FrameProgress
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.messages import StreamInfo
from tests.nodes.support import error_line, run, write_grid
from tests.small import INTRINSICS, tiny_frames


@pytest.fixture(scope="module")
def tuned(folder: Path, log: Path, weights: Path) -> Path:
    out = folder / "made" / "tuned.safetensors"
    arguments = ("--keyframes", "3", "--seconds", "0", "--steps", "2", "--weights", weights)
    done = run("finetune", log, *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "finetuned on frames" in done.stdout
    return out


def test_finetuned_weights_remember_their_keyframes(tuned: Path) -> None:
    checkpoint = load_checkpoint(tuned)
    assert len(checkpoint.train_stamps_ns) == len(checkpoint.anchors) == 3
    assert checkpoint.train_stamps_ns <= {f.stamp_ns for f in tiny_frames(6)}
    assert checkpoint.recipe["source"] == "room.mcap"
    assert checkpoint.recipe["steps"] == 2


def test_more_keyframes_than_labelled_frames_are_refused(log: Path, weights: Path, tmp_path: Path) -> None:
    done = run("finetune", log, "--keyframes", "7", "--weights", weights, "--out", tmp_path / "w.safetensors")
    assert done.returncode == 1
    assert "--keyframes 7" in error_line(done.stderr)


def test_log_without_labels_is_refused(weights: Path, tmp_path: Path) -> None:
    log = tmp_path / "plain.mcap"
    with LogWriter(log, StreamInfo(source="test", cameras={"rooms": INTRINSICS})) as writer:
        writer.write_frame(tiny_frames(1)[0])
    for verb in (("finetune", log, "--keyframes", "2", "--out", tmp_path / "w.safetensors"), ("eval", log)):
        done = run(*verb, "--weights", weights)
        assert done.returncode == 1
        assert "plain.mcap: has no label images" in error_line(done.stderr)


def test_eval_shows_replays_side_by_side_and_writes_json(replayed: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures" / "eval.json"
    done = run("eval", replayed, "--out", file)
    assert done.returncode == 0, done.stderr
    assert "mIoU" in done.stdout and "replayed" in done.stdout
    written = json.loads(file.read_text())
    assert written["replays"]["replayed"] == json.loads((replayed / "summary.json").read_text())


def test_eval_of_a_log_compares_with_baselines_on_frames_that_nobody_was_fitted_to(
    log: Path, tuned: Path, config: Path, tmp_path: Path
) -> None:
    file = tmp_path / "eval.json"
    done = run("eval", log, "--weights", tuned, "--baselines", "--seconds", "1", "--config", config, "--out", file)
    assert done.returncode == 0, done.stderr
    scores = json.loads(file.read_text())["logs"][str(log)]
    assert scores["scored"] == 3 and scores["excluded"] == 3
    assert {"sray", "per-image U-Net", "labels carried by depth"} <= set(scores["methods"])
    assert "per-image U-Net" in done.stdout


def test_eval_scores_the_map_with_its_things_where_objects_are_known(
    log: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    for number, frame in enumerate(tiny_frames(6)[:2]):
        cv2.imwrite(str(tmp_path / f"{number:06d}.png"), (frame.label // 3).astype(np.uint16))
    file, options = tmp_path / "eval.json", ("--weights", weights, "--config", config, "--max-frames", "2")
    done = run("eval", log, *options, "--instances", tmp_path, "--out", file)
    assert done.returncode == 0, done.stderr
    seen = json.loads(file.read_text())["logs"][str(log)]["methods"]["map seen from frames"]
    assert 0 <= seen["pq"] <= seen["pq_plus"] <= 1 and seen["panoptic_frames"] == 2
    assert "PQ of things" in done.stdout and "PQ wall" in done.stdout
    assert run("eval", tmp_path, "--instances", tmp_path).returncode == 2


def test_finetuning_on_top_remembers_the_keyframes_of_both(log: Path, tuned: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.safetensors"
    arguments = ("--keyframes", "2", "--seed", "5", "--seconds", "0", "--steps", "1", "--weights", tuned)
    assert run("finetune", log, *arguments, "--out", out).returncode == 0
    assert load_checkpoint(tuned).train_stamps_ns <= load_checkpoint(out).train_stamps_ns
    assert len(load_checkpoint(out).anchors) == 2


def test_a_grid_of_a_scene_needs_no_labels_and_claims_none_in_a_replay(log: Path, tmp_path: Path) -> None:
    out, settings = tmp_path / "grid.safetensors", tmp_path / "small.toml"
    settings.write_text("width = 96\n[grid]\nlong_side = 32\nrays = 256\n")
    arguments = ("--kind", "grid", "--steps", "20", "--seconds", "0", "--config", settings)
    done = run("finetune", log, *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "grid: 20 steps" in done.stdout
    checkpoint = load_checkpoint(out)
    assert checkpoint.model.kind == "grid" and not checkpoint.train_stamps_ns
    done = run("replay", log, "--weights", out, "--out", tmp_path / "replayed")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "replayed" / "summary.json").read_text())
    assert summary["frames"]["fused"] == 6
    assert summary["metrics"]["coverage"] == 0.0 and summary["map"]["unknown"] == 1.0  # no class is claimed


def test_eval_and_autolabel_say_that_a_grid_knows_no_classes(log: Path, tmp_path: Path) -> None:
    weights = write_grid(tmp_path / "grid.safetensors")
    done = run("eval", log, "--weights", weights)
    assert done.returncode == 1 and "knows no classes, so that there is nothing to score" in error_line(done.stderr)
    done = run("autolabel", log, "--weights", weights, "--out", tmp_path / "new.mcap")
    assert done.returncode == 1 and "knows no classes" in error_line(done.stderr)
    assert not (tmp_path / "new.mcap").exists()


def test_ctrl_c_keeps_the_grid_so_far(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, settings = tmp_path / "early.safetensors", tmp_path / "small.toml"
    settings.write_text("width = 96\n[grid]\nlong_side = 32\nrays = 256\nsteps = 1_000_000\n")
    notes, show = [], FrameProgress.set

    def show_and_interrupt(progress: FrameProgress, done: int, note: str = "") -> None:
        show(progress, done, note)
        notes.append(note)
        if len(notes) == 20:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(FrameProgress, "set", show_and_interrupt)
    done = run("finetune", log, "--kind", "grid", "--seconds", "600", "--config", settings, "--out", out)
    assert done.returncode == 130, done.stderr
    checkpoint = load_checkpoint(out)
    assert isinstance(checkpoint.model, GridField) and checkpoint.model.fitted
    assert 0 < checkpoint.recipe["steps"] < 1000 and checkpoint.recipe["seconds"] < 500
    assert "the best weights so far" in done.stdout + done.stderr


def test_a_field_of_one_scene_labels_its_log_and_maps_it(log: Path, config: Path, tmp_path: Path) -> None:
    out, settings = tmp_path / "irt.safetensors", tmp_path / "small.toml"
    settings.write_text("width = 96\n[grid]\nlong_side = 32\nrays = 256\n")
    arguments = ("--kind", "irt", "--steps", "16", "--seconds", "0", "--config", settings)
    more = ("--set", "irt.variant=RTTC", "--keyframes", "2")
    done = run("finetune", log, *arguments, *more, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "finetuned on frames" in done.stdout
    assert "grid: 16 steps" in done.stdout and "accuracy" in done.stdout
    checkpoint = load_checkpoint(out)
    assert checkpoint.model.kind == "irt" and len(checkpoint.train_stamps_ns) == 2
    done = run("autolabel", log, "--weights", out, "--overwrite-labels", "--out", tmp_path / "labelled.mcap")
    assert done.returncode == 0, done.stderr
    with open_log(tmp_path / "labelled.mcap") as labelled:
        assert all(f.label is not None and f.label_is_pseudo for f in labelled)
    done = run("replay", log, "--weights", out, "--config", config, "--out", tmp_path / "replayed")
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "replayed" / "summary.json").read_text())
    assert summary["frames"]["excluded_from_scores"] == 2 and summary["frames"]["scored"] == 4  # never on its keyframes
    assert summary["scene"]["known"] > 0.9 and summary["scene"]["frames_outside"] == 0
    assert summary["metrics"]["total_accuracy"] > 0.5
    assert "known to the weights" in done.stdout
    again = ("--weights", out, "--keyframes", "3", "--set", "irt.variant=B", "--steps", "2")
    done = run("finetune", log, *again, "--seconds", "0", "--config", settings, "--out", tmp_path / "again.safetensors")
    assert done.returncode == 0, done.stderr
    model = load_checkpoint(tmp_path / "again.safetensors").model
    assert isinstance(model, IRT) and model.shape.variant == "B" and model.shape.carried == 3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--kind", "irt"), "how many labelled frames?"),
        (("--kind", "grid", "--keyframes", "2"), "learns from no keyframes"),
        (("--kind", "sray", "--keyframes", "2"), "is not one of 'irt', 'panoptic', 'grid'"),
        (("--kind", "grid", "--weights", "x"), "starts from nothing"),
        (("--kind", "grid", "--strokes"), "learns from no keyframes and strokes"),
    ],
)
def test_options_that_do_not_go_with_a_kind_are_refused(arguments, said, log: Path, tmp_path: Path) -> None:
    done = run("finetune", log, *arguments, "--out", tmp_path / "w.safetensors")
    assert done.returncode == 2 and said in " ".join(done.stderr.split())


def test_weights_never_replace_a_log_or_another_file(log: Path, tmp_path: Path) -> None:
    before = log.read_bytes()
    done = run("finetune", log, "--keyframes", "2", "--steps", "1", "--out", log)
    assert done.returncode == 1 and "is the log itself" in error_line(done.stderr)
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    done = run("finetune", log, "--keyframes", "2", "--steps", "1", "--out", notes)
    assert done.returncode == 1 and "no weights file" in error_line(done.stderr)
    assert log.read_bytes() == before and notes.read_text() == "mine"
