"""When a node is restarted, and when no more: the counting, and what a launch file may ask for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.frame_gaps import Gaps
from semantic_mapper.nodes.supervisor import heartbeat
from semantic_mapper.nodes.supervisor.backoff import RestartBackoff
from semantic_mapper.nodes.supervisor.hang_detector import HangDetector, is_active
from semantic_mapper.nodes.supervisor.heartbeat import ENDING, FRAME, RUNNING, STARTING, TURN, HeartbeatMonitor
from semantic_mapper.nodes.supervisor.launch_config import NodeEntry, load_launch
from tests.nodes.support import REPLAY_LAUNCH, eventually

LIVE_LAUNCH = REPLAY_LAUNCH.with_name("replay-live.toml")


def entry(**changes: object) -> NodeEntry:
    return NodeEntry(name="eye", kind="camera", restart="on-failure", **changes)  # pyright: ignore[reportArgumentType]


def test_pauses_double_up_to_their_limit_and_the_number_is_limited() -> None:
    restarts = RestartBackoff(entry(backoff_s=0.5, backoff_max_s=3.0, max_restarts=4, window_s=60.0))
    assert [restarts.delay_s(float(t)) for t in range(5)] == [0.5, 1.0, 2.0, 3.0, None]
    assert restarts.count == 4


def test_what_is_older_than_the_window_counts_no_more() -> None:
    restarts = RestartBackoff(entry(backoff_s=0.5, max_restarts=2, window_s=10.0))
    assert [restarts.delay_s(t) for t in (0.0, 1.0, 5.0)] == [0.5, 1.0, None]
    assert restarts.lately(9.9) == 2 and restarts.lately(10.5) == 1
    assert restarts.delay_s(12.0) == 0.5
    assert restarts.count == 3


def test_no_restart_at_all_where_none_is_allowed() -> None:
    assert RestartBackoff(entry(max_restarts=0)).delay_s(1.0) is None


def test_replay_launches_end_with_the_first_failure_as_ever() -> None:
    for name in ("replay.toml", "record.toml"):
        launch = load_launch(REPLAY_LAUNCH.with_name(name), ["log=room.mcap"])
        assert {node.restart for node in launch.nodes} == {"never"}
    live = load_launch(LIVE_LAUNCH, ["log=room.mcap"])
    assert {node.restart for node in live.nodes} == {"on-failure"} and live.heartbeat_s == 0.8


@pytest.mark.parametrize("mode", ["lockstep", "fast"])
def test_restart_is_refused_where_frames_wait_for_their_readers(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "launch.toml"
    path.write_text(LIVE_LAUNCH.read_text().replace('"realtime"', f'"{mode}"'))
    with pytest.raises(ConfigError, match=r"'mapper' is to be restarted, but camera 'camera' waits.*realtime"):
        load_launch(path, ["log=room.mcap"])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('restart = "on-failure"', 'restart = "always"', "always"),
        ('restart = "on-failure"', "backoff_s = 0", "backoff_s"),
        ("heartbeat_s = 0.8", "heartbeat_s = 0.2", "heartbeat_s"),
        ('name = "recorder"', 'name = "launch"', "the launcher's own"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = tmp_path / "launch.toml"
    path.write_text(LIVE_LAUNCH.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=says):
        load_launch(path, ["log=room.mcap"])


def test_launcher_knows_from_the_pipe_how_far_a_node_is() -> None:
    read, write = os.pipe()
    monitor = HeartbeatMonitor(read)
    monitor.poll()
    assert not monitor.ready and monitor.stalled_s is None
    os.write(write, STARTING)
    monitor.poll()
    assert not monitor.ready
    os.write(write, RUNNING + TURN + RUNNING)
    monitor.poll()
    assert monitor.ready and not monitor.ending and monitor.stalled_s is not None
    time.sleep(0.02)
    os.write(write, RUNNING)  # lives, but its main loop does not come round
    monitor.poll()
    assert monitor.silent_s < monitor.stalled_s
    os.write(write, ENDING)
    monitor.poll()
    assert monitor.ready and monitor.ending and monitor.stalled_s is None
    assert monitor.frames == 0 and monitor.frame_age_s is None
    os.write(write, FRAME + RUNNING + FRAME + FRAME)  # of a player of logs
    monitor.poll()
    assert monitor.frames == 3 and monitor.frame_age_s is not None and not monitor.ending
    os.close(write)
    monitor.poll()  # has ended: no sign of life
    os.close(read)


def test_gaps_are_counted_camera_by_camera_and_a_new_beginning_is_none() -> None:
    gaps = Gaps()
    for camera, seq in (("a", 5), ("b", 100), ("a", 6), ("a", 9), ("b", 101), ("a", 0), ("a", 2)):
        gaps.note(camera, seq)
    assert (gaps.missed, gaps.begun_anew) == (2 + 1, 1)


SLEEPS = "import time; print(flush=True); time.sleep(600)"
BUSY = "print(flush=True)\nwhile True: pass"


@pytest.mark.parametrize(
    ("program", "stopped", "hangs"), [(SLEEPS, False, True), (BUSY, False, False), (BUSY, True, True)]
)
def test_a_frozen_process_is_told_from_a_busy_one(
    program: str, stopped: bool, hangs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(heartbeat, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"\n"
    if stopped:
        process.send_signal(signal.SIGSTOP)
    if hangs:
        assert eventually(lambda: not is_active(process.pid), 30)
    launch = msgspec.structs.replace(load_launch(LIVE_LAUNCH, ["log=room.mcap"]), heartbeat_s=0.2)
    read, write = os.pipe()
    monitor = HeartbeatMonitor(read)
    os.write(write, RUNNING)
    detector = HangDetector(process.pid, monitor, launch)
    assert not detector.find_hang(stopping=False)
    now_s[0] += 0.15
    assert not detector.find_hang(stopping=False), "it is not silent for long enough"
    now_s[0] += 0.2
    assert bool(detector.find_hang(stopping=False)) == hangs
    os.write(write, RUNNING)
    assert not detector.find_hang(stopping=False), "it lives"
    process.kill()
    process.wait()
    os.close(write)
    os.close(read)
