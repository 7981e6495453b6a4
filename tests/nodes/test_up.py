"""``up``: real processes and sockets: the map of one process, orderly ends, clear errors, nothing left behind."""

import dataclasses
import json
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.replay.log.format import LogReader
from tests.contract.golden import form, undocumented
from tests.nodes.support import (
    REPLAY_LAUNCH,
    Running,
    eventually,
    is_alive,
    launch_settings,
    refused,
    repeated_frames,
    run_ok,
    summary_of,
    write_log,
)
from tests.small import tiny_frames

RECORD = "recorder.enabled=true"
Up = Callable[..., Sequence[str | Path]]


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "up"


@pytest.fixture
def up(weights: Path, config: Path, out: Path) -> Up:
    """Words that launch the replay of a log."""
    return lambda log, *more: ("up", REPLAY_LAUNCH, *launch_settings(log, weights, config, *more), "--out", out)


@pytest.fixture(scope="module")
def long_log(folder: Path) -> Path:
    """More frames than any test waits for."""
    return write_log(folder / "long.mcap", repeated_frames(600))


def test_recorder_keeps_every_frame_byte_for_byte_and_what_exists(log: Path, up: Up, out: Path) -> None:
    assert "6 of 6 frames of test room mapped" in run_ok(*up(log, RECORD)).stdout
    with LogReader(log) as before, LogReader(out / "recorded.mcap") as after:
        assert [p for _, p in after.frame_parts()] == [p for _, p in before.frame_parts()]
        assert after.info.label_set == before.info.label_set
        assert after.finished and not after.errors
        assert "status" in {envelope.topic for envelope, _ in after.messages()}
    made = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    assert "recorded.mcap: exists already" in refused(*up(log, RECORD))
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == made


@pytest.mark.slow
def test_ctrl_c_writes_the_map_and_no_process_stays(long_log: Path, up: Up, out: Path) -> None:
    with Running(*up(long_log, RECORD)) as running:
        running.wait_for_line("stream_begins")
        sockets = running.sockets()
        assert sockets.stat().st_mode & 0o777 == 0o700
        about = json.loads(run_ok("info", sockets, "--json").stdout)
        assert undocumented("info", form(about)) == [] and about["info"]["scale"] == "metres"
        assert about["nodes"]["mapper"]["state"] == "running" and about["weights"]["in_use"] == 0
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 0, running.text
        assert len(running.node_pids()) == 3 and not any(map(is_alive, running.node_pids()))
        assert not sockets.exists()
    summary = summary_of(out)
    assert summary["frames"]["fused"] < 600
    assert "stopped" in summary["stopped_by"] or summary["stopped_by"] == "the launcher"
    with LogReader(out / "recorded.mcap") as recorded:
        assert recorded.finished and len(recorded) < 600


@pytest.mark.slow
def test_nodes_of_a_killed_launcher_write_results(long_log: Path, up: Up, out: Path) -> None:
    with Running(*up(long_log)) as running:
        running.wait_for_line("stream_begins")
        pids, sockets = running.node_pids(), running.sockets()
        running.process.kill()
        assert eventually(lambda: not any(map(is_alive, pids)))
    assert summary_of(out)["stopped_by"]
    run_ok(*up(long_log, "camera.max_frames=1"))
    assert not sockets.exists(), "the next launch removes what the killed one could not"


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "delivery"), [("fast", "all"), ("realtime", "newest")])
def test_without_lockstep_frames_are_fused_or_dropped(mode: str, delivery: str, up: Up, out: Path) -> None:
    log = write_log(out.with_name("forty.mcap"), repeated_frames(40))
    run_ok(*up(log, f"camera.mode={mode}", f"mapper.delivery={delivery}"))
    frames = summary_of(out)["frames"]
    assert frames["published"] == 40
    assert frames["fused"] >= 1 and frames["fused"] + frames["dropped"] == 40
    assert delivery == "newest" or frames["dropped"] == 0


@pytest.mark.slow
def test_refused_frame_does_not_stop_the_lockstep(up: Up, out: Path) -> None:
    frames = list(tiny_frames(4))
    skewed = frames[1].T_world_camera.copy()
    skewed[:3, :3] *= 2
    frames[1] = dataclasses.replace(frames[1], T_world_camera=skewed)
    said = run_ok(*up(write_log(out.with_name("skewed.mcap"), frames), RECORD)).stdout
    summary = summary_of(out)
    assert summary["frames"]["published"] == 4 and summary["frames"]["fused"] == 3
    assert "frame seq=1" in summary["refusals"][0]["reason"] and "1 frame refused" in said
    with LogReader(out / "recorded.mcap") as recorded:
        assert "refused" in {envelope.topic for envelope, _ in recorded.messages()}


def test_without_a_query_endpoint_there_is_none_and_names_must_differ() -> None:
    for query, more in (("query", ("query",)), ("", ()), ("ipc:///a/b", ())):
        launch = load_launch(REPLAY_LAUNCH, ["camera.log=x", f"mapper.query={query}"])
        assert launch.sockets() == ("launch", "mapper", "camera", *more)
    for query, said in (("camera", "camera: names two endpoints"), ("../up", "query")):
        with pytest.raises(ConfigError, match=said):
            load_launch(REPLAY_LAUNCH, ["camera.log=x", f"mapper.query={query}"])
