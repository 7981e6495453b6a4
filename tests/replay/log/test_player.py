from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from semantic_mapper.errors import NodeError, TransportError
from semantic_mapper.replay.log.format import LogReader, LogWriter
from semantic_mapper.replay.log.player import ACK_TOPICS, PlayOptions, PlayReport, play
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream, FrameRefused, Message, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber, NewestSubscriber, Publisher
from semantic_mapper.types import PosedFrame
from tests.replay.conftest import FRAMES
from tests.transport import samples

WAIT_S = 30.0


class Mapper:
    """Stands at the other end in a thread of its own: answers each frame, and remembers what it got."""

    def __init__(self, endpoint: str, answer: Callable[[PosedFrame], list[bytes] | None]) -> None:
        self.received: list[Message] = []
        self.publisher = Publisher(endpoint + "-map")
        self.subscriber = NewestSubscriber(endpoint, ["info", "frame", "end"])
        self._answer = answer
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while (message := self.subscriber.receive(WAIT_S)) is not None:
            self.received.append(message)
            if isinstance(message, EndOfStream):
                return
            if isinstance(message, PosedFrame) and (parts := self._answer(message)) is not None:
                self.publisher.publish(parts)

    @property
    def seqs(self) -> list[int]:
        return [m.seq for m in self.received if isinstance(m, PosedFrame)]

    def __enter__(self) -> Mapper:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.join()
        self.subscriber.close()
        self.publisher.close()


def fuse(frame: PosedFrame) -> list[bytes]:
    return encode(samples.make_update(frame.seq, frame.camera_id))


def play_to(
    log: Path, endpoint: str, answer: Callable[[PosedFrame], list[bytes] | None], **how
) -> tuple[PlayReport, Mapper]:
    with (
        LogReader(log) as reader,
        Publisher(endpoint, policy="block") as publisher,
        Mapper(endpoint, answer) as mapper,
        LosslessSubscriber(endpoint + "-map", ACK_TOPICS) as acks,
    ):
        report = play(reader, publisher, acks, **how)
    return report, mapper


def test_lockstep_drops_nothing_however_slow_the_mapper_is_and_a_refusal_is_an_answer_too(
    small_log: Path, endpoint: str
) -> None:
    pause = threading.Event()

    def slowly(frame: PosedFrame) -> list[bytes]:
        pause.wait(0.02)
        if frame.seq == 3:
            return encode(FrameRefused(frame.stamp_ns, 3, frame.camera_id, "pose holds NaN"))
        return fuse(frame)

    report, mapper = play_to(small_log, endpoint, slowly)
    assert (report.published, report.errors) == (FRAMES, ())
    assert mapper.seqs == list(range(FRAMES)) and mapper.subscriber.overwritten == 0
    info, end = mapper.received[0], mapper.received[-1]
    assert isinstance(info, StreamInfo) and info.frame_count == FRAMES
    assert end == EndOfStream("player", "end", FRAMES)


def test_a_mapper_that_does_not_answer_ends_the_playing_with_a_clear_error(small_log: Path, endpoint: str) -> None:
    with pytest.raises(NodeError, match=r"has not answered frame seq=2 of camera .front. within 0\.3 s"):
        play_to(small_log, endpoint, lambda f: fuse(f) if f.seq < 2 else None, options=PlayOptions(ack_timeout_s=0.3))


DYING_MAPPER = """
import os, sys
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.sockets import NewestSubscriber, Publisher
from semantic_mapper.types import PosedFrame
from tests.transport import samples
endpoint = sys.argv[1]
publisher, frames = Publisher(endpoint + "-map"), NewestSubscriber(endpoint, ["frame"])
while True:
    frame = frames.receive()
    if frame.seq == 3:
        os.kill(os.getpid(), 9)
    publisher.publish(encode(samples.make_update(frame.seq, frame.camera_id)))
"""


def test_a_mapper_that_is_killed_is_noticed_long_before_the_timeout(small_log: Path, endpoint: str) -> None:
    root = Path(__file__).parents[3]
    child = subprocess.Popen([sys.executable, "-c", DYING_MAPPER, endpoint], cwd=root)
    with (
        LogReader(small_log) as reader,
        Publisher(endpoint, policy="block", linger_ms=0) as publisher,
        NewestSubscriber(endpoint, ["frame"]),  # a viewer: the mapper is not the only one to listen
        LosslessSubscriber(endpoint + "-map", ACK_TOPICS) as acks,
        pytest.raises(NodeError, match="the mapper has gone while it worked on frame seq=3"),
    ):
        play(reader, publisher, acks, PlayOptions(subscribers=2, ack_timeout_s=1000.0))
    assert child.wait() == -9


def test_damaged_frames_are_passed_over_and_reported(tmp_path: Path, endpoint: str) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, StreamInfo("test")) as writer:
        for seq in range(5):
            parts = encode_frame(samples.make_frame(seq))
            if seq == 1:
                parts[2] = bytes(len(parts[2]))
            writer.write_parts(parts)
    report, mapper = play_to(path, endpoint, fuse)
    assert mapper.seqs == [0, 2, 3, 4] and report.published == 4
    assert len(report.errors) == 1 and "seq=1" in str(report.errors[0])
    with LogReader(path) as reader:
        assert [frame.seq for frame in reader] == [0, 2, 3, 4]
        assert "frame 1 at byte" in str(reader.errors[0]) and "PNG" in str(reader.errors[0])
    end = mapper.received[-1]
    assert isinstance(end, EndOfStream) and end.unreadable == 1 and "seq=1" in end.damages[0]


def test_what_ends_before_the_start_is_not_read(small_log: Path, endpoint: str) -> None:
    data = bytearray(small_log.read_bytes())
    with LogReader(small_log) as reader:
        at = reader._frames[1].chunk.offset + 1000
    data[at] ^= 1  # seen only where the frame is read
    small_log.write_bytes(data)
    for start, seqs in ((0, [0, *range(2, FRAMES)]), (3, [*range(3, FRAMES)])):
        options = PlayOptions(from_stamp_ns=samples.make_frame(start).stamp_ns)
        report, mapper = play_to(small_log, endpoint, fuse, options=options)
        assert mapper.seqs == seqs and len(report.errors) == (start == 0)


@pytest.mark.parametrize(
    "options",
    [
        PlayOptions("fast", max_frames=7),
        PlayOptions("realtime", 1e3, max_frames=7),
        PlayOptions("realtime", 1e3, loop=True, max_frames=30),
        PlayOptions("fast", loop=True, max_frames=30, from_stamp_ns=samples.make_frame(500).stamp_ns),
    ],
)
def test_playing_to_a_lossless_subscriber_loses_nothing(small_log: Path, endpoint: str, options: PlayOptions) -> None:
    frames: list[PosedFrame] = []
    with (
        LogReader(small_log) as reader,
        Publisher(endpoint, policy="block", hwm=1) as publisher,
        LosslessSubscriber(endpoint, ["frame", "end"], hwm=1) as subscriber,
    ):
        thread = threading.Thread(target=lambda: play(reader, publisher, None, options))
        thread.start()
        while isinstance(message := subscriber.receive(WAIT_S), PosedFrame):
            frames.append(message)
        thread.join()
    first = 500 if options.from_stamp_ns else 0
    assert [f.seq for f in frames] == list(range(first, first + (options.max_frames or 0)))
    assert isinstance(message, EndOfStream)
    assert [f.stamp_ns for f in frames] == [samples.make_frame(f.seq).stamp_ns for f in frames], "time never goes back"
    assert [f.label is not None for f in frames] == [f.seq < FRAMES for f in frames]


def test_playing_can_be_stopped(small_log: Path, endpoint: str) -> None:
    stop = threading.Event()
    how = {"stop": stop, "on_frame": lambda envelope: stop.set() if envelope.seq == 4 else None}
    report, mapper = play_to(small_log, endpoint, fuse, **how)
    assert report.stopped and report.published == 5
    assert mapper.received[-1] == EndOfStream("player", "stopped", 5)


def test_playing_to_nobody_fails_clearly(small_log: Path, endpoint: str) -> None:
    with LogReader(small_log) as reader, Publisher(endpoint) as publisher:
        with pytest.raises(TransportError, match="0 of 1 subscribers of 'frame'"):
            play(reader, publisher, None, PlayOptions(mode="fast", subscriber_timeout_s=0.1))
        with pytest.raises(NodeError, match="lockstep needs"):
            play(reader, publisher)
