"""``finetune`` and ``eval``."""

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
from tests.nodes.support import refused, run, run_ok, summary_of, write_grid
from tests.small import INTRINSICS, tiny_frames

GRID = "width = 96\n[grid]\nlong_side = 32\nrays = 256\n"


@pytest.fixture(scope="module")
def tuned(folder: Path, log: Path, weights: Path) -> Path:
    out = folder / "made" / "tuned.safetensors"
    arguments = ("--keyframes", "3", "--seconds", "0", "--steps", "2", "--weights", weights)
    assert "finetuned on frames" in run_ok("finetune", log, *arguments, "--out", out).stdout
    return out


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    """Of a small grid."""
    (tmp_path / "small.toml").write_text(GRID)
    return tmp_path / "small.toml"


def test_finetuned_weights_remember_their_keyframes_and_those_before(log: Path, tuned: Path, tmp_path: Path) -> None:
    checkpoint, out = load_checkpoint(tuned), tmp_path / "again.safetensors"
    assert len(checkpoint.train_stamps_ns) == len(checkpoint.anchors) == 3
    assert checkpoint.train_stamps_ns <= {f.stamp_ns for f in tiny_frames(6)}
    assert (checkpoint.recipe["source"], checkpoint.recipe["steps"]) == ("room.mcap", 2)
    assert json.loads(run_ok("info", tuned, "--json").stdout)["train_frames"] == 3
    arguments = ("--keyframes", "2", "--seed", "5", "--seconds", "0", "--steps", "1", "--weights", tuned)
    run_ok("finetune", log, *arguments, "--out", out)
    again = load_checkpoint(out)
    assert checkpoint.train_stamps_ns <= again.train_stamps_ns and len(again.anchors) == 2


def test_too_few_labels_and_weights_without_classes_are_refused(log: Path, weights: Path, tmp_path: Path) -> None:
    plain, out = tmp_path / "plain.mcap", tmp_path / "made"
    with LogWriter(plain, StreamInfo(source="test", cameras={"rooms": INTRINSICS})) as writer:
        writer.write_frame(tiny_frames(1)[0])
    grid = write_grid(tmp_path / "grid.safetensors")
    for said, words in (
        ("--keyframes 7", ("finetune", log, "--keyframes", "7", "--weights", weights, "--out", out)),
        ("plain.mcap: has no label images", ("finetune", plain, "--keyframes", "2", "--out", out)),
        ("plain.mcap: has no label images", ("eval", plain, "--weights", weights)),
        ("knows no classes, so that there is nothing to score", ("eval", log, "--weights", grid)),
        ("knows no classes", ("autolabel", log, "--weights", grid, "--out", out)),
    ):
        assert said in refused(*words)
    assert not out.exists()


def test_eval_shows_replays_side_by_side_and_writes_json(replayed: Path, tmp_path: Path) -> None:
    file = tmp_path / "figures" / "eval.json"
    said = run_ok("eval", replayed, "--out", file).stdout
    assert "mIoU" in said and "replayed" in said
    assert json.loads(file.read_text())["replays"][str(replayed)] == summary_of(replayed)


def test_eval_compares_on_frames_that_nobody_was_fitted_to(
    log: Path, tuned: Path, config: Path, tmp_path: Path
) -> None:
    file = tmp_path / "eval.json"
    options = ("--weights", tuned, "--baselines", "1", "--config", config, "--out", file)
    assert "per-image U-Net" in run_ok("eval", log, *options).stdout
    scores = json.loads(file.read_text())["logs"][str(log)]
    assert scores["scored"] == 3 and scores["excluded"] == 3
    assert {"sray", "per-image U-Net", "labels carried by depth"} <= set(scores["methods"])


def test_eval_scores_things_where_objects_are_known(log: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    for number, frame in enumerate(tiny_frames(6)[:2]):
        cv2.imwrite(str(tmp_path / f"{number:06d}.png"), (frame.label // 3).astype(np.uint16))
    file, options = tmp_path / "eval.json", ("--weights", weights, "--config", config, "--max-frames", "2")
    said = run_ok("eval", log, *options, "--instances", tmp_path, "--out", file).stdout
    seen = json.loads(file.read_text())["logs"][str(log)]["methods"]["map seen from frames"]
    assert 0 <= seen["pq"] <= seen["pq_plus"] <= 1 and seen["panoptic_frames"] == 2
    assert "PQ of things" in said and "PQ wall" in said
    assert run("eval", tmp_path, "--instances", tmp_path).returncode == 2


def test_a_grid_needs_no_labels_and_claims_none_in_a_replay(log: Path, settings: Path, tmp_path: Path) -> None:
    out = tmp_path / "grid.safetensors"
    arguments = ("--kind", "grid", "--steps", "20", "--seconds", "0", "--config", settings)
    assert "grid: 20 steps" in run_ok("finetune", log, *arguments, "--out", out).stdout
    checkpoint = load_checkpoint(out)
    assert checkpoint.model.kind == "grid" and not checkpoint.train_stamps_ns
    run_ok("map", log, "--weights", out, "--out", tmp_path / "replayed")
    summary = summary_of(tmp_path / "replayed")
    assert summary["frames"]["fused"] == 6
    assert summary["metrics"]["coverage"] == 0.0 and summary["map"]["unknown"] == 1.0  # no class is claimed


def test_ctrl_c_keeps_the_best_grid(log: Path, settings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, notes, show = tmp_path / "early.safetensors", [], FrameProgress.set
    settings.write_text(GRID + "steps = 1_000_000\n")

    def show_and_interrupt(progress: FrameProgress, done: int, note: str = "") -> None:
        show(progress, done, note)
        notes.append(note)
        if len(notes) == 20:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(FrameProgress, "set", show_and_interrupt)
    done = run("finetune", log, "--kind", "grid", "--seconds", "600", "--config", settings, "--out", out)
    assert done.returncode == 130 and "the best weights so far" in done.stdout + done.stderr, done.stderr
    checkpoint = load_checkpoint(out)
    assert isinstance(checkpoint.model, GridField) and checkpoint.model.fitted
    assert 0 < checkpoint.recipe["steps"] < 1000 and checkpoint.recipe["seconds"] < 500


def test_a_field_of_a_scene_labels_its_log_and_maps_it(log: Path, config: Path, settings: Path, tmp_path: Path) -> None:
    out, again = tmp_path / "irt.safetensors", tmp_path / "again.safetensors"
    arguments = ("--kind", "irt", "--steps", "16", "--seconds", "0", "--config", settings)
    said = run_ok("finetune", log, *arguments, "--set", "irt.variant=RTTC", "--keyframes", "2", "--out", out).stdout
    assert "finetuned on frames" in said and "grid: 16 steps" in said and "accuracy" in said
    checkpoint = load_checkpoint(out)
    assert checkpoint.model.kind == "irt" and len(checkpoint.train_stamps_ns) == 2
    run_ok("autolabel", log, "--weights", out, "--overwrite-labels", "--out", tmp_path / "labelled.mcap")
    with open_log(tmp_path / "labelled.mcap") as labelled:
        assert all(f.label is not None and f.label_is_pseudo for f in labelled)
    done = run_ok("map", log, "--weights", out, "--config", config, "--out", tmp_path / "replayed")
    assert "known to the weights" in done.stdout
    summary = summary_of(tmp_path / "replayed")
    assert summary["frames"]["excluded_from_scores"] == 2 and summary["frames"]["scored"] == 4  # never on its keyframes
    assert summary["scene"]["known"] > 0.9 and summary["scene"]["frames_outside"] == 0
    assert summary["metrics"]["total_accuracy"] > 0.5
    options = ("--keyframes", "3", "--set", "irt.variant=B", "--steps", "2", "--seconds", "0", "--config", settings)
    run_ok("finetune", log, "--weights", out, *options, "--out", again)
    model = load_checkpoint(again).model
    assert isinstance(model, IRT) and model.shape.variant == "B" and model.shape.carried == 3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--kind irt", "how many labelled frames?"),
        ("--kind grid --keyframes 2", "learns from no keyframes"),
        ("--kind sray --keyframes 2", "'sray' is not valid; there are irt, panoptic, grid"),
        ("--kind grid --weights x", "starts from nothing"),
        ("--kind panoptic", "--kind panoptic and --boxes FILE go together"),
        ("--boxes x.json --keyframes 2", "--kind panoptic and --boxes FILE go together"),
        ("--kind panoptic --boxes x.json --keyframes 2", "panoptic learns from no keyframes"),
        ("--keyframes 2 --pseudo rooms", "goes with --kind panoptic only"),
    ],
)
def test_options_that_do_not_go_with_a_kind_are_refused(arguments: str, said: str, log: Path, tmp_path: Path) -> None:
    assert said in refused("finetune", log, *arguments.split(), "--out", tmp_path / "w.safetensors", code=2)


def test_weights_never_replace_a_log_or_another_file(log: Path, tmp_path: Path) -> None:
    before, notes = log.read_bytes(), tmp_path / "notes.txt"
    notes.write_text("mine")
    for out, said in ((log, "is the log itself"), (notes, "no weights file")):
        assert said in refused("finetune", log, "--keyframes", "2", "--steps", "1", "--out", out)
    assert log.read_bytes() == before and notes.read_text() == "mine"
