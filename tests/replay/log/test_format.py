from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import mcap.reader
import mcap.writer
import msgpack
import numpy as np
import pytest

from semantic_mapper.errors import LogError
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.log.format import LogReader, LogWriter, recover
from semantic_mapper.transport.codec import encode, encode_frame, pack_parts
from semantic_mapper.transport.messages import StreamInfo
from tests.replay.conftest import FRAMES
from tests.transport import samples


def seqs(reader: LogReader) -> list[int]:
    return [frame.seq for frame in reader]


def chunk_starts(path: Path) -> list[tuple[int, int]]:
    """(offset, length) of each chunk, the first of which holds the stream information."""
    with path.open("rb") as file:
        summary = mcap.reader.make_reader(file).get_summary()
    assert summary is not None
    return sorted((c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes)


def test_frames_come_back_bit_for_bit(small_log: Path) -> None:
    with LogReader(small_log) as reader:
        assert len(reader) == FRAMES and reader.finished
        assert reader.info == StreamInfo("test", {samples.CAMERA: samples.INTRINSICS}, NYU40)
        for seq, frame in enumerate(reader):
            expected = samples.make_frame(seq)
            assert (frame.seq, frame.stamp_ns) == (seq, expected.stamp_ns)
            assert np.array_equal(frame.rgb, expected.rgb) and np.array_equal(
                frame.T_world_camera, expected.T_world_camera
            )
            assert frame.depth_m is not None and expected.depth_m is not None
            assert frame.depth_m.tobytes() == expected.depth_m.tobytes()
        assert not reader.errors and not reader.notices


def test_log_bytes_are_wire_bytes_and_open_to_other_readers(small_log: Path) -> None:
    with small_log.open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        messages = [(schema, channel, message) for schema, channel, message in reader.iter_messages(["frame/front"])]
    assert len(messages) == FRAMES
    for seq, (schema, channel, message) in enumerate(messages):
        assert channel.message_encoding == "msgpack"
        assert schema is not None and schema.encoding == "jsonschema" and b"T_world_camera" in schema.data
        assert msgpack.unpackb(message.data) == encode_frame(samples.make_frame(seq))
        assert message.log_time == samples.make_frame(seq).stamp_ns


def test_any_frame_can_be_read_in_any_order_and_from_any_thread(small_log: Path) -> None:
    with LogReader(small_log) as reader:
        assert [reader.frame(n).seq for n in (7, 0, 11, 7)] == [7, 0, 11, 7]
        for number in (-1, FRAMES):
            with pytest.raises(LogError, match="no frame"):
                reader.frame(number)
        found: list[list[int]] = []
        threads = [threading.Thread(target=lambda: found.append(seqs(reader))) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == [list(range(FRAMES))] * 4


def test_a_log_may_hold_other_messages_beside_frames_and_no_frames_only_where_allowed(tmp_path: Path) -> None:
    path = tmp_path / "mixed.mcap"
    LogWriter(path, StreamInfo("empty")).close()
    with pytest.raises(LogError, match="holds no frames"):
        LogReader(path)
    with LogReader(path, allow_empty=True) as reader:
        assert len(reader) == 0 and reader.info.source == "empty"
    path.unlink()
    with LogWriter(path, StreamInfo("test")) as writer:
        for seq in range(3):
            writer.write_frame(samples.make_frame(seq))
            writer.write_parts(encode(samples.make_status()))
        assert (writer.frames, writer.messages) == (3, 7)
    with LogReader(path) as reader:
        assert seqs(reader) == [0, 1, 2]
        assert [e.topic for e, _ in reader.messages()] == ["info"] + ["frame", "status"] * 3


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89", b"not a log at all, just some text", b"\x89MCAP0\r\n", bytes(5000), b"PK\x03\x04" + bytes(9)],
)
def test_a_file_that_is_no_log_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"x\.mcap"):
        LogReader(path)


def write_foreign(path: Path, payloads: dict[str, bytes], **how) -> None:
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, **how)
        writer.start()
        channel = writer.register_channel("any", "json", writer.register_schema("o", "jsonschema", b"{}"))
        for payload in payloads.values():
            writer.add_message(channel, 1, payload, 1)
        writer.finish()


def test_a_foreign_mcap_is_refused_and_a_log_without_chunks_is_read(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write_foreign(path, {"odometry": b"{}"})
    with pytest.raises(LogError, match="not a log of semantic-mapper"):
        LogReader(path)
    messages = samples.all_messages()
    write_foreign(path, {name: pack_parts(messages[name]) for name in ("info", "frame")}, use_chunking=False)
    with LogReader(path) as reader:
        assert len(reader) == 1 and seqs(reader) == [3]


@pytest.mark.slow
def test_a_flipped_bit_costs_one_frame_wherever_it_strikes(small_log: Path, tmp_path: Path) -> None:
    rng = random.Random(0)
    data = small_log.read_bytes()
    starts = [offset for offset, _ in chunk_starts(small_log)]
    offsets = [rng.randrange(len(data)) for _ in range(300)]
    offsets += [start + i for start in starts[1:4] for i in range(60)]  # the heads of chunks and messages
    offsets += range(40)
    damaged = tmp_path / "damaged.mcap"
    for offset in offsets:
        spoiled = bytearray(data)
        spoiled[offset] ^= 1 << rng.randrange(8)
        damaged.write_bytes(spoiled)
        told: list[LogError] = []
        with LogReader(damaged, on_error=told.append) as reader:
            found = seqs(reader)
            assert len(found) >= FRAMES - 1, offset
            assert sorted(set(found)) == found, offset
            if len(found) < FRAMES:
                assert reader.errors, offset
            assert told == reader.errors, offset
            for error in reader.errors:
                assert "byte" in str(error) or "chunks" in str(error)
            for frame in reader:  # what is given is right
                assert np.array_equal(frame.rgb, samples.make_frame(frame.seq).rgb), offset


def test_a_damaged_frame_is_named_by_number_and_offset(small_log: Path) -> None:
    offset, length = chunk_starts(small_log)[1 + 4]
    data = bytearray(small_log.read_bytes())
    data[offset + length // 2] ^= 1
    small_log.write_bytes(data)
    with LogReader(small_log) as reader:
        assert len(reader) == FRAMES
        assert seqs(reader) == [s for s in range(FRAMES) if s != 4]
        assert seqs(reader) == [s for s in range(FRAMES) if s != 4]
        assert len(reader.errors) == 1, "each error is told once"
        assert f"frame 4 at byte {offset}" in str(reader.errors[0]) and "crc" in str(reader.errors[0])
        with pytest.raises(LogError, match="frame 4 at byte"):
            reader.frame(4)


def test_a_log_cut_anywhere_is_readable_up_to_the_break(small_log: Path, tmp_path: Path) -> None:
    data = small_log.read_bytes()
    chunks = chunk_starts(small_log)
    ends = [offset + length for offset, length in chunks]
    rng = random.Random(0)
    cut_log = tmp_path / "cut.mcap"
    first_whole = ends[1]  # stream information and one frame
    for cut in [first_whole, *(rng.randrange(first_whole, len(data)) for _ in range(50)), *ends[2:], len(data) - 1]:
        cut_log.write_bytes(data[:cut])
        with LogReader(cut_log) as reader:
            whole = sum(end <= cut for end in ends[1:])
            assert seqs(reader) == list(range(whole)), cut
            if cut < len(data) - 60:
                assert not reader.finished and "was not closed" in reader.notices[0]
    for cut in [0, 5, 30, chunks[0][0], ends[0], first_whole - 1]:
        cut_log.write_bytes(data[:cut])
        with pytest.raises(LogError):
            LogReader(cut_log)


def test_a_valid_chunk_with_an_undecodable_frame_costs_that_frame(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, StreamInfo("test")) as writer:
        for seq in range(4):
            parts = encode_frame(samples.make_frame(seq))
            if seq == 2:
                parts[2] = bytes(len(parts[2]))  # no PNG any more, of the right length
            writer.write_parts(parts)
    with LogReader(path) as reader:
        assert seqs(reader) == [0, 1, 3]
        assert "frame 2 at byte" in str(reader.errors[0]) and "PNG" in str(reader.errors[0])


@pytest.mark.parametrize("compression", [mcap.writer.CompressionType.ZSTD, mcap.writer.CompressionType.NONE])
def test_a_log_that_another_tool_rewrote_is_read(small_log: Path, tmp_path: Path, compression) -> None:
    rewritten = tmp_path / "rewritten.mcap"
    with small_log.open("rb") as source, rewritten.open("wb") as file:
        reader = mcap.reader.make_reader(source)
        writer = mcap.writer.Writer(file, chunk_size=10_000, compression=compression)
        writer.start()
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, "msgpack", 0)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    with LogReader(rewritten) as again:
        assert seqs(again) == list(range(FRAMES)) and not again.errors


def test_recover_writes_a_clean_log_of_what_is_whole(small_log: Path, tmp_path: Path) -> None:
    chunks = chunk_starts(small_log)
    data = bytearray(small_log.read_bytes())[: chunks[10][0] + 50]  # frames 0 to 8 are whole
    data[chunks[4][0] + 200] ^= 1
    damaged, clean = tmp_path / "damaged.mcap", tmp_path / "clean.mcap"
    damaged.write_bytes(data)
    report = recover(damaged, clean)
    assert (report.frames, report.finished, len(report.lost)) == (8, False, 2)
    with LogReader(clean) as reader:
        assert reader.finished and not reader.notices
        assert seqs(reader) == [0, 1, 2, 4, 5, 6, 7, 8] and not reader.errors
        assert reader.info.label_set == NYU40
    assert damaged.read_bytes() == data
    with pytest.raises(LogError, match="exists already"):
        recover(damaged, clean)


WRITER = """
import sys, itertools
from pathlib import Path
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from tests.transport import samples
with LogWriter(Path(sys.argv[1]), StreamInfo("killed")) as writer:
    for seq in itertools.count():
        writer.write_frame(samples.make_frame(seq))
        print(seq, flush=True)
"""


@pytest.mark.parametrize("frames", [1, 20])
def test_a_killed_writer_loses_at_most_the_message_it_was_writing(tmp_path: Path, frames: int) -> None:
    path = tmp_path / "killed.mcap"
    root = Path(__file__).parents[3]
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True, cwd=root)
    assert child.stdout is not None
    last = -1
    while last < frames:
        last = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    last = max([last, *(int(line) for line in child.stdout.read().split("\n")[:-1])])
    child.wait()
    child.stdout.close()
    with LogReader(path) as reader:
        found = seqs(reader)
        assert not reader.finished
    assert found[: last + 1] == list(range(last + 1))  # all that was said to be written
    assert len(found) <= last + 2
