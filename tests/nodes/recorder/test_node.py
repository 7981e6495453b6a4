"""The recorder node against real sockets: splits, full disk, packing, attachments; and ``record`` from outside."""

import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.nodes.cli.info import describe_log
from semantic_mapper.nodes.options import RecorderOptions
from semantic_mapper.nodes.recorder.node import Recorder, run_recorder
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.replay.log.sequence import open_log, parts_on_disk
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.launches import NOTE, LaunchedNode, LaunchNote, read_launch_note
from semantic_mapper.transport.messages import EndOfStream, Status
from semantic_mapper.transport.sockets import NewestSubscriber, Publisher
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import (
    NodeHere,
    Running,
    error_line,
    eventually,
    node_here,
    refused,
    repeated_frames,
    run_ok,
    write_log,
)
from tests.nodes.test_faults import alone
from tests.transport import samples

# A recorder beside the player of a log.
RECORDED = """
[[node]]
name = "eye"
kind = "camera"
[node.options]
log = "{log}"
mode = "realtime"
[[node]]
name = "recorder"
kind = "recorder"
{policy}
[node.options]
sources = ["eye"]
out = "{out}"
{option}
"""


@dataclass
class Stream:
    """A camera that publishes what a test says, and a recorder node that listens."""

    publisher: Publisher
    recorder: NodeHere
    status: NewestSubscriber

    def publish(self, *frames: int) -> None:
        for seq in frames:
            self.publisher.publish(encode_frame(samples.make_frame(seq)))

    def end(self) -> None:
        self.publisher.publish(encode(EndOfStream("camera", "end", 0)))
        self.recorder.wait(60)

    def wait_for_status(self, holds: Callable[[Status], bool]) -> Status:
        for _ in range(100):
            status = self.status.receive(1.0)
            if isinstance(status, Status) and holds(status):
                return status
        raise AssertionError("the recorder never said so")

    def last_counters(self) -> Mapping[str, int]:
        """What the recorder said when it had closed its log."""
        return self.wait_for_status(lambda status: status.state == "ended").counters


@contextmanager
def streaming(tmp_path: Path, sockets: Path, **options: Any) -> Iterator[Stream]:
    endpoints = {name: f"ipc://{sockets}/{name}" for name in ("camera", "recorder")}
    settings = convert_config({"out": str(tmp_path / "a.mcap"), "sources": ["camera"], **options}, RecorderOptions, "t")
    with (
        Publisher(endpoints["camera"], policy="block") as publisher,
        node_here(run_recorder, "recorder", endpoints, settings, folder=sockets) as recorder,
        NewestSubscriber(endpoints["recorder"], ("status",)) as status,
    ):
        publisher.wait_for_subscribers("frame", 1, 30)
        publisher.publish(encode(samples.make_info(), sender="camera"))
        yield Stream(publisher, recorder, status)


@pytest.fixture
def sockets() -> Iterator[Path]:
    with a_folder() as folder:
        yield folder


def test_recorder_splits_packs_and_keeps_what_belongs_to_the_log(tmp_path: Path, sockets: Path) -> None:
    note = LaunchNote("kitchen.toml", (LaunchedNode("camera", "camera", {"log": "x"}),))
    (sockets / NOTE).write_bytes(msgspec.json.encode(note))
    with streaming(tmp_path, sockets, split_mb=0.02, rgb="jpeg", jpeg_quality=90, reserve_mb=0) as stream:
        stream.publish(*range(10), *range(12, 30))
        topic = encode_frame(samples.make_frame(30))[0]
        stream.publisher.publish([topic, b"no header"])
        stream.end()
        told = stream.last_counters()
    parts = list(parts_on_disk(tmp_path / "a.mcap").values())
    assert len(parts) > 1
    assert (told["recorded"], told["missed"], told["rejected"], told["lost"]) == (28, 2, 1, 0)
    assert told["log_kb"] == sum(part.stat().st_size for part in parts) // 1024 > 20
    with open_log(parts) as log:
        frames = list(log)
        assert [f.seq for f in frames] == [*range(10), *range(12, 30)] and not log.errors
        for frame in frames:
            sent = samples.make_frame(frame.seq)
            assert frame.depth_m.tobytes() == sent.depth_m.tobytes() and np.array_equal(frame.label, sent.label)
            assert not np.array_equal(frame.rgb, sent.rgb)  # noise, the worst there is for JPEG
        _, wire = next(log.frame_parts())
        assert wire[2][:3] == b"\xff\xd8\xff"
        kept = log.attachments()
        assert json.loads(kept[NOTE].data)["launch"] == "kitchen.toml"
        assert json.loads(kept["calibration.json"].data)["cameras"]["front"]["fx"] == 20.5
    found = describe_log(parts[::-1], lambda: None)
    assert found["frames"] == 28 and found["finished"] and found["part"] is None and len(found["parts"]) == len(parts)
    assert found["attachments"].keys() >= {NOTE, "calibration.json"} and not found["damage"]
    alone = describe_log(parts[1:2], lambda: None)
    assert alone["part"] == 1 and 0 < alone["frames"] < 28


@pytest.mark.parametrize(
    ("kill", "extra", "reason"),
    [
        (True, "", r"'recorder' \(recorder\) ended: killed by SIGKILL"),
        (True, 'restart = "on-failure"', r"the recorder was restarted, and what was sent meanwhile is missing"),
        (False, "reserve_mb = 1e12", r"messages? not written: .*the disk is full"),
    ],
)
def test_a_launch_whose_recorder_lost_frames_ends_badly(tmp_path: Path, kill: bool, extra: str, reason: str) -> None:
    log = write_log(tmp_path / "long.mcap", repeated_frames(600 if kill else 20))
    policy, option = (extra, "") if "restart" in extra else ("", extra)
    launch = tmp_path / "recorded.toml"
    launch.write_text(RECORDED.format(log=log, out=tmp_path / "a.mcap", policy=policy, option=option))
    with Running("up", launch) as running:
        if kill:
            running.wait_for_line(r"\brecorder\].* recording ")
            assert eventually(lambda: (tmp_path / "a.mcap").stat().st_size > 100_000, 60)
            os.kill(running.node_pid("recorder"), signal.SIGKILL)
        if policy:
            running.wait_for_line(r"node_started .*node=recorder .*restarts=1")
            second = tmp_path / "a-1.mcap"
            assert eventually(lambda: second.exists() and second.stat().st_size > 100_000, 60)
            running.process.send_signal(signal.SIGINT)
        assert running.wait() == 1, running.text
    assert re.search(reason, error_line(running.text)), running.text


def test_full_disk_is_told_and_the_stream_goes_on(tmp_path: Path, sockets: Path) -> None:
    with streaming(tmp_path, sockets, reserve_mb=1e12) as stream:
        stream.publish(*range(100))  # would block if nobody read on
        status = stream.wait_for_status(lambda status: "the disk is full" in " ".join(status.degraded))
        assert "recording has stopped" in status.degraded[0] and status.counters["recorded"] == 0
        stream.end()
    with LogReader(tmp_path / "a.mcap", allow_empty=True) as log:
        assert log.finished and len(log) == 0


def test_what_waits_at_a_stop_is_written(tmp_path: Path, sockets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taking, go_on, take = threading.Event(), threading.Event(), Recorder.take

    def slowly(recorder: Recorder, parts: list[bytes]) -> bool:
        if recorder.recording is not None:
            taking.set()
            assert go_on.wait(30)
        return take(recorder, parts)

    monkeypatch.setattr(Recorder, "take", slowly)
    with streaming(tmp_path, sockets, reserve_mb=0) as stream:
        assert eventually(lambda: isinstance(stream.status.receive(0.1), Status), 30)
        stream.publish(0)
        assert taking.wait(30)
        stream.publish(*range(1, 40))
        stream.recorder.stop.signum = signal.SIGTERM
        time.sleep(0.3)  # until all have come
        go_on.set()
        stream.recorder.wait(60)
        told = stream.last_counters()
    with LogReader(tmp_path / "a.mcap") as log:
        assert [envelope.seq for envelope, _ in log.frame_parts()] == list(range(40))
    assert (told["recorded"], told["lost"]) == (40, 0)


def test_running_launch_is_recorded_from_outside(tmp_path: Path) -> None:
    long_log = write_log(tmp_path / "long.mcap", repeated_frames(600))
    with Running("up", alone(tmp_path, long_log)) as running:
        running.wait_for_line("all_ready")
        sockets, out = running.sockets(), tmp_path / "out" / "a.mcap"
        assert read_launch_note(sockets).names("camera") == ("eye",)
        said = refused("record", out, "--launch", sockets, "--source", "ear")
        assert "--source ear: no node of alone.toml; there are eye" in said
        done = run_ok("record", out, "--launch", sockets, "--duration", "1.5", "--split-s", "0.5", "--jpeg", "80")
        running.process.send_signal(signal.SIGINT)
        assert running.wait() == 0
    with open_log(out.parent) as found:
        seqs = [envelope.seq for envelope, _ in found.frame_parts()]
        assert len(seqs) > 5 and seqs == list(range(seqs[0], seqs[0] + len(seqs)))
        assert f"{out}: {len(seqs)} frames" in done.stdout and "parts" in done.stdout
        assert json.loads(found.attachments()[NOTE].data)["nodes"][0]["name"] == "eye"
