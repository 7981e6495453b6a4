"""``map`` and ``demo``: what they write and say, and what they do about bad input and folders that others use."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.replay.run_folder import hold_folder
from tests.nodes.support import (
    REPLAY_LAUNCH,
    Running,
    is_alive,
    refused,
    repeated_frames,
    run,
    run_ok,
    summary_of,
    write_log,
)
from tests.small import tiny_frames


def test_missing_weights_unknown_settings_and_bad_corrections_are_named(log: Path, tmp_path: Path) -> None:
    wrong, corrections = tmp_path / "wrong.toml", tmp_path / "corrections.txt"
    wrong.write_text("[voxel_map]\nvoxel_sise_m = 0.05\n")
    corrections.write_text("no trajectory\n")
    for option, file, code, said in (
        ("--weights", "rooms.safetensor", 1, "rooms.safetensor: no such weights file"),
        ("--config", wrong, 2, "did you mean `voxel_size_m`?"),
        ("--corrections", corrections, 1, "corrections.txt: holds no pose"),
    ):
        assert said in refused("map", log, "--out", tmp_path / "out", option, file, code=code)


def test_bad_and_damaged_frames_are_named_and_the_rest_is_mapped(tmp_path: Path, weights: Path, config: Path) -> None:
    frames = list(tiny_frames(6))
    skewed = frames[1].T_world_camera.copy()
    skewed[:3, :3] *= 1.5
    frames[1] = replace(frames[1], T_world_camera=skewed)
    assert frames[3].label is not None
    strange = frames[3].label.copy()
    strange[0, 0] = 200
    frames[3] = replace(frames[3], label=strange)
    log = write_log(tmp_path / "mixed.mcap", frames)
    content = bytearray(log.read_bytes())
    content[len(content) * 11 // 12] ^= 0xFF  # in the last frame
    log.write_bytes(content)
    done = run_ok("map", log, "--out", tmp_path / "out", "--weights", weights, "--config", config, "--json")
    summary = json.loads(done.stdout)
    assert (summary["frames"]["published"], summary["frames"]["fused"]) == (6, 4)
    reasons = [r["reason"] for r in summary["refusals"]]
    assert "frame seq=1" in reasons[0] and "rotation" in reasons[0]
    assert "frame seq=3" in reasons[1] and "200" in reasons[1]  # mapped, not scored
    assert "mixed.mcap" in reasons[2] and "frame 5" in reasons[2]
    for reason in reasons:
        assert reason.removeprefix("mapped, but not scored: ")[:40] in done.stderr


@pytest.mark.slow
def test_interrupted_replay_still_writes_the_map_so_far(tmp_path: Path, weights: Path, config: Path) -> None:
    log, out = write_log(tmp_path / "long.mcap", repeated_frames(400)), tmp_path / "out"
    with Running("map", log, "--out", out, "--weights", weights, "--config", config) as running:
        running.wait_for_line(r"\bmapping\b")
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 130, running.text
    summary = summary_of(out)
    assert summary["stopped_by"] == "SIGINT" and 1 <= summary["frames"]["fused"] < 400
    assert (out / "map.ply").exists()


def test_poses_that_never_move_make_a_map_that_cannot_be_trusted(tmp_path: Path, weights: Path, config: Path) -> None:
    frames = [replace(f, T_world_camera=np.eye(4)) for f in tiny_frames(30)]
    log = write_log(tmp_path / "log.mcap", frames)
    done = run("map", log, "--out", tmp_path / "run", "--weights", weights, "--config", config)
    assert done.returncode == 3 and "warning: poses stand still" in done.stdout


@pytest.mark.slow
def test_a_map_that_cannot_be_trusted_has_an_exit_code_of_its_own(tmp_path: Path) -> None:
    """Poses of a body with x forward, published as the camera's."""
    T_body_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    T_camera_body = np.linalg.inv(T_body_camera)
    frames = [replace(f, T_world_camera=f.T_world_camera @ T_camera_body) for f in tiny_frames(30, seed=13)]
    write_log(tmp_path / "log.mcap", frames)
    command = ("map", tmp_path / "log.mcap", "--out", tmp_path / "run", "--quality", "fast")
    assert run(*command).returncode == 3
    run_ok(*command, "--accept-untrusted")
    assert "x forward" in summary_of(tmp_path / "run")["pose_check"]["warning"]


def test_an_empty_map_has_an_exit_code_of_its_own(tmp_path: Path, weights: Path, config: Path) -> None:
    far = [replace(f, depth_m=None if f.depth_m is None else 10 * f.depth_m) for f in tiny_frames(3)]
    log, out = write_log(tmp_path / "far.mcap", far), tmp_path / "out"
    said = refused("map", log, "--out", out, "--weights", weights, "--config", config, code=4)
    assert "none of 3 frames could be mapped" in said and "beyond the range of the map" in said
    summary = summary_of(out)
    assert "depth_scale" in summary["depth"]["range_warning"] and not summary["map"]["surface_points"]
    assert {"overview.png", "map.npz", "report.html"} <= {path.name for path in out.iterdir()}


@pytest.mark.slow  # 24 frames
def test_demo_ends_with_a_map_a_picture_and_a_summary(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    said = run_ok("demo", "--out", out, "--voxel-size", "0.05", "--quality", "fast").stdout
    summary = summary_of(out)
    assert summary["frames"]["fused"] == summary["frames"]["published"] > 10
    assert summary["metrics"]["miou"] is not None and "demo.mcap" in said
    for name in ("map.ply", "map.npz", "overview.png"):
        assert (out / name).stat().st_size > 0 and name in said


@pytest.mark.slow  # three processes and a viewer
def test_live_demo_runs_until_ctrl_c_while_another_terminal_asks(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    with Running("demo", "--live", "--out", out) as running:
        query = running.wait_for_line("query .* nearest chair").split()[1:]
        running.wait_for_line("watch at http://127.0.0.1:")
        running.wait_for_line(r"map_saved.*frames=(2[5-9]|[3-9]\d|\d{3})\b")  # in the second loop
        thing = json.loads(run_ok(*query, "--json").stdout)["thing"]
        listed = json.loads(run_ok(*query[:2], "instances", "--json").stdout)["instances"]
        assert (thing["id"], "chair") in {(other["id"], other["class"]) for other in listed}
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 0, running.text
        assert not any(map(is_alive, running.node_pids())) and not running.sockets().exists()
    summary = summary_of(out)
    assert summary["frames"]["scored"] <= 24 < summary["frames"]["fused"] and summary["metrics"]["miou"] > 0.7


def test_two_runs_do_not_write_their_results_into_one_folder(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with hold_folder(out):
        for words in (("up", REPLAY_LAUNCH, "--set", f"camera.log={log}"), ("map", log)):
            assert "another run writes its results there" in refused(*words, "--out", out)
        with hold_folder(tmp_path / "other"):
            pass
    assert not any(out.iterdir())


def test_without_out_no_map_is_replaced(
    log: Path, weights: Path, config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = tmp_path / "runs" / log.stem / "map.npz"
    before.parent.mkdir(parents=True)
    before.touch()
    done = run_ok("map", log, "--weights", weights, "--config", config, "--max-frames", "2")
    assert f"runs/{log.stem} holds a map" in done.stderr and f"runs/{log.stem}-1/map.npz" in done.stdout
    assert not before.stat().st_size and [p.name for p in before.parent.iterdir()] == ["map.npz"]


def test_a_refused_run_leaves_no_folder_and_a_stopped_one_what_it_has_written(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    (tmp_path / "pictures").mkdir()
    for name in ("bad.mcap", "pictures"):
        assert name in refused("map", tmp_path / name, "--out", tmp_path / "runs" / "out")
        assert not (tmp_path / "runs").exists()
    with pytest.raises(FileExistsError), hold_folder(tmp_path / "out"):  # noqa: PT012
        (tmp_path / "out" / "map.npz").touch()
        (tmp_path / "out" / "map.npz").touch(exist_ok=False)
    assert (tmp_path / "out" / "map.npz").exists()
