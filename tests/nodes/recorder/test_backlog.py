"""What a recorder in waiting takes over: just what is in no log of the one before it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from semantic_mapper.nodes.recorder import backlog
from semantic_mapper.nodes.recorder.backlog import Backlog
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.codec import encode, encode_frame
from semantic_mapper.transport.messages import EndOfStream
from tests.transport import samples

FRAMES = [encode_frame(samples.make_frame(seq)) for seq in range(12)]


def heard(*messages: list[bytes]) -> Backlog:
    made = Backlog()
    for parts in (encode(samples.make_info()), *messages):
        made.add(parts)
    return made


def write(path: Path, messages: list[list[bytes]]) -> Path:
    with LogWriter(path, samples.make_info()) as log:
        for parts in messages:
            log.write_parts(parts)
    return path


def test_what_no_log_holds_is_taken_over_in_its_order(tmp_path: Path) -> None:
    out = write(tmp_path / "recorded.mcap", FRAMES[:5])
    write(tmp_path / "recorded-1.mcap", FRAMES[5:8])
    found = list(heard(*FRAMES[2:]).missing_in_logs(out))
    assert found == [encode(samples.make_info()), *FRAMES[8:]]


def test_a_message_that_was_cut_off_is_written_again(tmp_path: Path) -> None:
    out = tmp_path / "recorded.mcap"
    with LogWriter(out, samples.make_info()) as log:
        for parts in FRAMES[:4]:
            log.write_parts(parts)
        whole = log.bytes_written
        log.write_parts(FRAMES[4])
    with out.open("r+b") as file:
        file.truncate(whole + 100)
    assert list(heard(*FRAMES[:6]).missing_in_logs(out))[1:] == FRAMES[4:6]


def test_only_the_end_of_a_long_log_is_read(tmp_path: Path) -> None:
    out = write(tmp_path / "recorded.mcap", [encode_frame(samples.make_frame(seq)) for seq in range(300)])
    last = [encode_frame(samples.make_frame(seq)) for seq in range(295, 303)]
    found = heard(*last)
    assert list(found.missing_in_logs(out))[1:] == last[5:]


def test_without_a_stream_or_a_log_there_is_nothing_or_all(tmp_path: Path) -> None:
    assert list(Backlog().missing_in_logs(tmp_path / "recorded.mcap")) == []
    assert list(heard(*FRAMES[:2]).missing_in_logs(tmp_path / "recorded.mcap"))[1:] == FRAMES[:2]


def test_the_oldest_messages_give_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backlog, "MAX_BYTES", 3 * sum(map(len, FRAMES[0])))
    assert list(heard(*FRAMES).missing_in_logs(tmp_path / "none.mcap"))[1:][-1] == FRAMES[-1]
    assert len(list(heard(*FRAMES).missing_in_logs(tmp_path / "none.mcap"))) in (3, 4)  # what the stream is, and 2 or 3
    monkeypatch.setattr(backlog, "MAX_BYTES", 1)
    assert len(list(heard(*FRAMES).missing_in_logs(tmp_path / "none.mcap"))) == 1


def test_the_end_of_the_stream_is_noticed() -> None:
    assert not heard(*FRAMES[:2]).ended
    assert heard(FRAMES[0], encode(EndOfStream("player", "end", 1))).ended


def test_the_newest_part_is_the_one_with_the_highest_number_whatever_the_clock_said(tmp_path: Path) -> None:
    out = write(tmp_path / "recorded.mcap", [encode_frame(samples.make_frame(seq)) for seq in range(100, 200)])
    write(tmp_path / "recorded-9.mcap", FRAMES[:4])
    newest = write(tmp_path / "recorded-10.mcap", FRAMES[4:9])
    os.utime(newest, (1e9, 1e9))  # the clock was set back
    assert list(heard(*FRAMES[5:11]).missing_in_logs(out))[1:] == FRAMES[9:11]
