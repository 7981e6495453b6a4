"""``replay``: what it writes, what it says, and what it does about bad input."""

from __future__ import annotations

import dataclasses
import json
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.nodes.support import Running, error_line, repeated_frames, run, write_log, write_weights
from tests.small import tiny_frames


def test_replay_writes_map_picture_and_summary(replayed: Path) -> None:
    summary = json.loads((replayed / "summary.json").read_text())
    assert summary["frames"]["published"] == summary["frames"]["fused"] == 6
    assert summary["frames"]["dropped"] == 0
    assert summary["stopped_by"] is None
    assert summary["map"]["voxel_size_m"] == 0.05
    assert summary["map"]["surface_points"] > 0
    for name in ("map.ply", "map.npz", "overview.png"):
        assert (replayed / name).stat().st_size > 0


def test_json_stands_alone_on_stdout_and_equals_the_file(replayed: Path) -> None:
    assert json.loads((replayed / "stdout.txt").read_text()) == json.loads((replayed / "summary.json").read_text())


def test_missing_weights_are_named(log: Path, tmp_path: Path) -> None:
    done = run("replay", log, "--out", tmp_path / "out", "--weights", tmp_path / "none.safetensors")
    assert done.returncode == 1
    assert "none.safetensors: no such weights file" in error_line(done.stderr)
    assert done.stdout == ""


def test_unknown_setting_is_named_with_the_nearest(log: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[voxel_map]\nvoxel_sise_m = 0.05\n")
    done = run("replay", log, "--out", tmp_path / "out", "--config", wrong)
    assert done.returncode == 1
    assert "did you mean `voxel_size_m`?" in error_line(done.stderr)


def test_impossible_and_damaged_frames_are_named_and_the_rest_is_mapped(
    tmp_path: Path, weights: Path, config: Path
) -> None:
    frames = list(tiny_frames(6))
    skewed = frames[1].T_world_camera.copy()
    skewed[:3, :3] *= 1.5
    frames[1] = dataclasses.replace(frames[1], T_world_camera=skewed)
    assert frames[3].label is not None
    strange = frames[3].label.copy()
    strange[0, 0] = 200
    frames[3] = dataclasses.replace(frames[3], label=strange)
    log = write_log(tmp_path / "mixed.mcap", frames)
    content = bytearray(log.read_bytes())
    content[len(content) * 11 // 12] ^= 0xFF  # in the last frame
    log.write_bytes(content)
    done = run("replay", log, "--out", tmp_path / "out", "--weights", weights, "--config", config, "--json")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["frames"]["published"] == 6
    assert summary["frames"]["fused"] == 4
    reasons = [r["reason"] for r in summary["refusals"]]
    assert "frame seq=1" in reasons[0] and "rotation" in reasons[0]
    assert "frame seq=3" in reasons[1] and "200" in reasons[1]  # mapped, not scored
    assert "mixed.mcap" in reasons[2] and "frame 5" in reasons[2]
    for reason in reasons:
        assert reason.removeprefix("mapped, but not scored: ")[:40] in done.stderr


@pytest.mark.slow
def test_interrupted_replay_still_writes_the_map_so_far(tmp_path: Path, weights: Path, config: Path) -> None:
    log = write_log(tmp_path / "long.mcap", repeated_frames(400))
    out = tmp_path / "out"
    with Running("replay", log, "--out", out, "--weights", weights, "--config", config) as running:
        running.wait_for_line(r"\bmapping\b")
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 130, running.text
    summary = json.loads((out / "summary.json").read_text())
    assert summary["stopped_by"] == "SIGINT"
    assert 1 <= summary["frames"]["fused"] < 400
    assert (out / "map.ply").exists()


def test_frames_that_weights_were_finetuned_on_are_never_scored(log: Path, config: Path, tmp_path: Path) -> None:
    stamps = [f.stamp_ns for f in tiny_frames(6)[:2]]
    tuned = write_weights(tmp_path / "tuned.safetensors", stamps)
    options = ("--weights", tuned, "--config", config, "--max-frames", "3")
    done = run("replay", log, "--out", tmp_path / "out", *options)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["frames"]["fused"] == 3
    assert summary["frames"]["scored"] == 1
    assert summary["frames"]["excluded_from_scores"] == 2
    assert "2 frames left out of the scores" in done.stdout


def test_corrections_move_the_map_at_the_end_and_bad_ones_are_named_before_it_begins(
    log: Path, weights: Path, tmp_path: Path
) -> None:
    file = tmp_path / "corrected.txt"
    file.write_text("".join(f"{f.stamp_ns / 1e9:.9f} 1 2 3 0 0 0 1\n" for f in tiny_frames()[:2]))
    done = run("replay", log, "--out", tmp_path / "out", "--weights", weights, "--corrections", file)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out/summary.json").read_text())["map"]["corrected_poses"] == 2
    file.write_text("no trajectory\n")
    done = run("replay", log, "--out", tmp_path / "out", "--weights", weights, "--corrections", file)
    assert done.returncode == 1 and "corrected.txt: holds no pose" in error_line(done.stderr)


@pytest.mark.slow
def test_a_map_that_cannot_be_trusted_has_an_exit_code_of_its_own(tmp_path: Path) -> None:
    """Poses of a body with x forward, published as the camera's."""
    T_body_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    frames = [
        dataclasses.replace(frame, T_world_camera=frame.T_world_camera @ np.linalg.inv(T_body_camera))
        for frame in tiny_frames(30, seed=13)
    ]
    write_log(tmp_path / "log.mcap", frames)
    command = ("replay", tmp_path / "log.mcap", "--out", tmp_path / "run", "--quality", "fast")
    assert run(*command).returncode == 3
    assert run(*command, "--accept-contradictions").returncode == 0
    assert "x forward" in json.loads((tmp_path / "run" / "summary.json").read_text())["pose_check"]["warning"]
