"""``up``: real processes and sockets: the map of one process, orderly ends, clear errors, nothing left behind."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.replay.log.format import LogReader
from tests.nodes.support import (
    REPLAY_LAUNCH,
    Running,
    eventually,
    is_alive,
    launch_settings,
    refused,
    repeated_frames,
    run,
    run_ok,
    summary_of,
    write_log,
)
from tests.small import tiny_frames

RECORD_LAUNCH = (REPLAY_LAUNCH, "--set", "recorder.enabled=true")


@pytest.fixture(scope="module")
def long_log(folder: Path) -> Path:
    """More frames than any test waits for."""
    return write_log(folder / "long.mcap", repeated_frames(600))


@pytest.fixture(scope="module")
def recorded(folder: Path, log: Path, weights: Path, config: Path) -> Path:
    """Results of all three nodes in lockstep."""
    out = folder / "up"
    done = run_ok("up", *RECORD_LAUNCH, *launch_settings(log, weights, config), "--out", out)
    assert "frames fused" in done.stdout
    return out


def test_recorder_keeps_every_frame_byte_for_byte(recorded: Path, log: Path) -> None:
    with LogReader(log) as before, LogReader(recorded / "recorded.mcap") as after:
        assert [p for _, p in after.frame_parts()] == [p for _, p in before.frame_parts()]
        assert after.info.label_set == before.info.label_set
        assert after.finished and not after.errors
        assert "status" in {envelope.topic for envelope, _ in after.messages()}


@pytest.mark.slow
def test_ctrl_c_writes_the_map_and_no_process_stays(
    long_log: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    with Running(
        "up", *RECORD_LAUNCH, *launch_settings(long_log, weights, config), "--out", tmp_path / "up"
    ) as running:
        running.wait_for_line("stream_begins")
        sockets = Path(running.wait_for_line(r"sockets=").split("sockets=")[1].split()[0])
        assert sockets.stat().st_mode & 0o777 == 0o700
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 0, running.text
        assert not any(is_alive(pid) for pid in running.node_pids())
        assert len(running.node_pids()) == 3
        assert not sockets.exists()
    summary = summary_of(tmp_path / "up")
    assert summary["frames"]["fused"] < 600
    assert "stopped" in summary["stopped_by"] or summary["stopped_by"] == "the launcher"
    with LogReader(tmp_path / "up" / "recorded.mcap") as recorded:
        assert recorded.finished and len(recorded) < 600


@pytest.mark.slow
def test_nodes_of_a_killed_launcher_write_results(long_log: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    with Running("up", REPLAY_LAUNCH, *launch_settings(long_log, weights, config), "--out", tmp_path / "up") as running:
        running.wait_for_line("stream_begins")
        pids = running.node_pids()
        sockets = Path(running.wait_for_line(r"sockets=").split("sockets=")[1].split()[0])
        running.process.kill()
        assert eventually(lambda: not any(is_alive(pid) for pid in pids))
    assert sockets.exists()  # who could have removed it?
    (tmp_path / "no-log.mcap").touch()
    again = run(
        "up", REPLAY_LAUNCH, *launch_settings(tmp_path / "no-log.mcap", weights, config), "--out", tmp_path / "again"
    )
    assert again.returncode == 1 and not sockets.exists()  # the next launch
    summary = summary_of(tmp_path / "up")
    assert summary["stopped_by"]


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "delivery"), [("fast", "all"), ("realtime", "newest")])
def test_without_lockstep_frames_are_fused_or_dropped(
    mode: str, delivery: str, weights: Path, config: Path, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "forty.mcap", repeated_frames(40))
    settings = launch_settings(log, weights, config, f"camera.mode={mode}", f"mapper.delivery={delivery}")
    run_ok("up", REPLAY_LAUNCH, *settings, "--out", tmp_path / "up")
    frames = summary_of(tmp_path / "up")["frames"]
    assert frames["published"] == 40
    assert frames["fused"] >= 1 and frames["fused"] + frames["dropped"] == 40
    assert delivery == "newest" or frames["dropped"] == 0


@pytest.mark.slow
def test_refused_frame_does_not_stop_the_lockstep(weights: Path, config: Path, tmp_path: Path) -> None:
    frames = list(tiny_frames(4))
    skewed = frames[1].T_world_camera.copy()
    skewed[:3, :3] *= 2
    frames[1] = dataclasses.replace(frames[1], T_world_camera=skewed)
    log = write_log(tmp_path / "skewed.mcap", frames)
    done = run_ok("up", *RECORD_LAUNCH, *launch_settings(log, weights, config), "--out", tmp_path / "up")
    summary = summary_of(tmp_path / "up")
    assert summary["frames"]["published"] == 4 and summary["frames"]["fused"] == 3
    assert "frame seq=1" in summary["refusals"][0]["reason"]
    assert "1 frame refused" in done.stdout
    with LogReader(tmp_path / "up" / "recorded.mcap") as recorded:
        assert "refused" in {envelope.topic for envelope, _ in recorded.messages()}


@pytest.mark.slow
def test_a_recording_that_exists_keeps_it_and_the_map(log: Path, weights: Path, config: Path, recorded: Path) -> None:
    before = {path.name: path.read_bytes() for path in recorded.iterdir() if path.is_file()}
    said = refused("up", *RECORD_LAUNCH, *launch_settings(log, weights, config), "--out", recorded)
    assert "recorded.mcap: exists already" in said
    assert {path.name: path.read_bytes() for path in recorded.iterdir() if path.is_file()} == before


def test_without_a_query_endpoint_there_is_none_and_names_must_differ(tmp_path: Path) -> None:
    launch = load_launch(REPLAY_LAUNCH, ["camera.log=x"], tmp_path)
    assert launch.sockets() == ("launch", "mapper", "camera", "query")
    for query in ("", "ipc:///a/b"):
        launch = load_launch(REPLAY_LAUNCH, ["camera.log=x", f"mapper.query={query}"], tmp_path)
        assert launch.sockets() == ("launch", "mapper", "camera")
    with pytest.raises(ConfigError, match="camera: names two endpoints"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=camera"], tmp_path)
    with pytest.raises(ConfigError, match="query"):
        load_launch(REPLAY_LAUNCH, ["camera.log=x", "mapper.query=../up"], tmp_path)
