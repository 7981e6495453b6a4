"""Nodes that are killed or frozen come back and go on; launches end when that is no use; nothing is left behind."""

import json
import os
import re
import signal
import socket
from pathlib import Path

import pytest

from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.log.format import LogReader, recover
from tests.contract.golden import form, undocumented
from tests.nodes.support import (
    REPLAY_LAUNCH,
    Running,
    error_line,
    eventually,
    is_alive,
    launch_settings,
    repeated_frames,
    run,
    run_ok,
    summary_of,
    write_log,
)

LIVE_LAUNCH = REPLAY_LAUNCH.with_name("camera.toml")
# A camera that nobody listens to starts in a second, and shows all that the launcher does.
ALONE = """
heartbeat_s = 1.0
restart = "on-failure"
[[node]]
name = "eye"
kind = "camera"
[node.options]
log = "{log}"
mode = "realtime"
"""


@pytest.fixture(scope="module")
def long_log(folder: Path) -> Path:
    """More frames than any test waits for: over a minute of them."""
    return write_log(folder / "minute.mcap", repeated_frames(1200))


def live_settings(log: Path, weights: Path, config: Path) -> list[str]:
    """A log in the place of a live camera, and a recorder."""
    return launch_settings(log, weights, config, "mapper.save_every_s=1", "recorder.enabled=true", "heartbeat_s=0.8")


def alone(folder: Path, log: Path) -> Path:
    path = folder / "alone.toml"
    path.write_text(ALONE.format(log=log))
    return path


def wait_for_start(running: Running, name: str, restarts: int) -> int:
    line = running.wait_for_line(rf"node_started .*node={name} .*restarts={restarts}\b")
    return int(re.findall(r"pid=(\d+)", line)[0])


def frame_numbers(log: Path) -> list[int]:
    with LogReader(log) as reader:
        return [envelope.seq for envelope, _ in reader.frame_parts()]


@pytest.mark.gate
@pytest.mark.slow
def test_every_node_that_is_killed_or_frozen_comes_back_and_the_others_go_on(
    long_log: Path, weights: Path, config: Path, tmp_path: Path
) -> None:
    out = tmp_path / "up"
    with Running("up", LIVE_LAUNCH, *live_settings(long_log, weights, config), "--out", out) as running:
        running.wait_for_line("all_ready")
        running.wait_for_line("map_saved")
        back = {
            "camera": r"\[camera\].* playing ",
            "recorder": r"\[recorder\].* recording ",
            "mapper": r"stream_begins",
        }
        for restarts, signum in enumerate((signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM), start=1):
            for node, sign in back.items():
                before = len(re.findall(sign, running.text))
                pid = wait_for_start(running, node, restarts - 1)
                os.kill(pid, signum)
                assert wait_for_start(running, node, restarts) != pid
                assert eventually(lambda n=before, s=sign: len(re.findall(s, running.text)) > n), running.text
                assert eventually(lambda p=pid: not is_alive(p))
                assert not any(len(re.findall(rf"node_started .*node={n} ", running.text)) > restarts + 1 for n in back)
        saves = running.text.count("map_saved")
        assert eventually(lambda: running.text.count("map_saved") > saves), running.text  # it maps on
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 1, running.text  # frames that were sent while there was no recorder are lost
        assert "the recorder was restarted, and what was sent meanwhile is missing" in error_line(running.text)
        assert not any(map(is_alive, running.node_pids()))
    summary = summary_of(out)
    taken_up = [int(n) for n in re.findall(r"map_resumed .*frames=(\d+)", running.text)]
    assert len(taken_up) == 3 and f"saved after {taken_up[-1]} frames" in summary["restarted"]
    assert VoxelMap.load(out / "map.npz").frames == taken_up[-1] + summary["frames"]["fused"]
    numbers: list[int] = []
    for part in ("recorded", "recorded-1", "recorded-2", "recorded-3"):
        recover(out / f"{part}.mcap", whole := out / f"{part}.whole.mcap")
        numbers += frame_numbers(whole)
    assert numbers == sorted(set(numbers))  # the camera went on, and no frame is in two logs


@pytest.mark.slow
def test_a_mapper_that_is_given_up_leaves_results(long_log: Path, weights: Path, config: Path, tmp_path: Path) -> None:
    out = tmp_path / "up"
    with Running("up", LIVE_LAUNCH, *live_settings(long_log, weights, config), "--out", out) as running:
        running.wait_for_line("map_saved")
        restarts = 0
        while not re.search(r"node_restarts .*in_s=[1-9].*node=mapper", running.text):  # so long that it is away
            os.kill(wait_for_start(running, "mapper", restarts), signal.SIGKILL)
            restarts += 1
            running.wait_for_line(rf"node_restarts .*node=mapper .*restarts={restarts}\b")
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 1, running.text
        assert not any(map(is_alive, running.node_pids()))
    assert (out / "summary.json").exists(), running.text
    assert "it had not been restarted yet when the launch ended" in error_line(running.text)
    saved = VoxelMap.load(out / "map.npz")
    summary = summary_of(out)
    assert summary["map"]["blocks"] == saved.block_count > 0
    assert summary["stopped_by"] and f"saved after {saved.frames} frames" in summary["restarted"]
    assert {"map.ply", "overview.png", "report.html"} <= {path.name for path in out.iterdir()}


def test_a_node_that_must_not_restart_ends_the_launch_with_the_reason(long_log: Path, tmp_path: Path) -> None:
    launch = alone(tmp_path, long_log)
    launch.write_text(launch.read_text().replace('restart = "on-failure"', 'restart = "never"'))
    with Running("up", launch) as running:
        running.wait_for_line(r"\beye\].* playing ")
        os.kill(wait_for_start(running, "eye", 0), signal.SIGTERM)
        assert running.wait() == 1, running.text
    assert "'eye' (camera) ended: sent away by SIGTERM from outside the launch" in error_line(running.text)
    assert re.search(r"\beye\].* played .*stopped=True", running.text)  # in order all the same


@pytest.mark.slow
def test_log_that_is_at_its_end_ends_a_live_launch_in_order(log: Path, tmp_path: Path) -> None:
    done = run_ok("up", alone(tmp_path, log))
    assert done.stderr.count("node_started") == 1 and "node_ended" not in done.stderr


@pytest.mark.slow
def test_node_that_never_was_ready_and_says_why_is_not_tried_again(tmp_path: Path) -> None:
    (tmp_path / "no-log.mcap").touch()
    done = run("up", alone(tmp_path, tmp_path / "no-log.mcap"))
    assert done.returncode == 1 and "no-log.mcap" in error_line(done.stderr)
    assert done.stderr.count("node_started") == 1


def test_killed_launcher_leaves_no_process_even_where_one_is_frozen(long_log: Path, tmp_path: Path) -> None:
    with Running("up", alone(tmp_path, long_log)) as running:
        running.wait_for_line("all_ready")
        os.kill(wait_for_start(running, "eye", 0), signal.SIGSTOP)
        running.process.kill()
        assert eventually(lambda: not any(map(is_alive, running.node_pids())))


@pytest.mark.slow
def test_top_shows_a_running_launch(long_log: Path, tmp_path: Path) -> None:
    with Running("up", alone(tmp_path, long_log)) as running:
        running.wait_for_line("all_ready")
        sockets = running.sockets()
        os.kill(wait_for_start(running, "eye", 0), signal.SIGKILL)
        pid = wait_for_start(running, "eye", 1)
        for _ in range(20):  # the new process first has to publish
            shown = json.loads(run_ok("view", "--status", sockets, "--once", "--json").stdout)
            eye = shown["nodes"]["eye"]
            if eye["counters"].get("published"):
                break
        table = run("view", "--status", f"ipc://{sockets}/launch", "--once").stdout
    assert (eye["pid"], eye["restarts"]) == (pid, 1) and eye["memory_mb"] > 5
    assert eye["counters"]["published"] > 0 and eye["rates_hz"]["published"] > 0 and eye["ages_s"]["frame"] >= 0
    assert "killed by SIGKILL" in eye["degraded"][0] and 0 <= eye["ages_s"]["beat"] < eye["ages_s"]["start"]
    assert shown["launch"]["pid"] == running.process.pid and shown["launch"]["counters"]["restarts"] == 1
    assert re.search(rf"eye +\w+ +{pid} ", table)
    assert undocumented("view", form(shown)) == []


def test_systemd_hears_of_start_life_and_end(long_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.settimeout(60)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    heard: list[str] = []

    def hear(until: str) -> None:
        while until not in heard:
            heard.extend(manager.recv(4096).decode().split("\n"))

    with Running("up", alone(tmp_path, long_log)) as running:
        hear("READY=1")
        hear("WATCHDOG=1")
        assert "STOPPING=1" not in heard
        eye = Path(f"/proc/{wait_for_start(running, 'eye', 0)}/environ").read_bytes()
        assert b"NOTIFY_SOCKET" not in eye and b"WATCHDOG" not in eye
        running.process.send_signal(signal.SIGTERM)
        hear("STOPPING=1")
        assert running.wait() == 0, running.text
    assert heard.index("READY=1") < heard.index("STOPPING=1")
    assert any(line.startswith("STATUS=eye running") for line in heard)
