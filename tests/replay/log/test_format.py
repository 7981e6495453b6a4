"""Logs as they are written, cut off, damaged, and made by other tools: what is whole is read, and nothing else."""

import random
import signal
import struct
import subprocess
import sys
import threading
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import lz4.frame
import mcap.reader
import mcap.writer
import msgpack
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from semantic_mapper.errors import LogError
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.log import reader as log_reader
from semantic_mapper.replay.log.format import LogReader, LogWriter, recover
from semantic_mapper.transport.codec import encode, encode_frame, pack_parts
from semantic_mapper.transport.messages import Status, StreamInfo
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
    with small_log.open("rb") as file:  # wire bytes, open to other readers
        messages = list(mcap.reader.make_reader(file, validate_crcs=True).iter_messages(["frame/front"]))
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
            writer.write_parts(encode(Status("mapper", "running", 5)))
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
        assert len(reader) == 1 and seqs(reader) == [42]


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
        assert len(reader.errors) == 1, "each error is reported once"
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


COMPRESS: dict[str, Callable[[bytes], bytes]] = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstandard.compress}
EMPTY_MESSAGE = struct.pack("<BQ", Opcode.MESSAGE, 22) + bytes(22)
ZEROS = bytes(1 << 24)
STRANGE = struct.pack("<BQ", Opcode.SCHEMA, 1 << 63) + bytes(20)


def with_chunk(log: Path, compression: str, data: bytes, size: int, crc: int = 0) -> Path:
    """The log with this chunk behind its frames; the index does not know it."""
    whole = log.read_bytes()
    end = whole.rfind(struct.pack("<BQ", Opcode.DATA_END, 4))
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(data)) + data
    log.write_bytes(whole[:end] + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body + whole[end:])
    return log


@pytest.mark.parametrize(
    ("compression", "data", "size", "reason"),
    [
        ("", STRANGE, len(STRANGE), "longer than its chunk"),
        ("", bytes(9) * 1000, 9000, "opcode 0"),
        ("", EMPTY_MESSAGE * 70_000, 31 * 70_000, "more than 65,536 records"),
        ("zstd", b"no such thing", 100, "damaged"),
        ("lz4", b"no such thing", 100, "damaged"),
        ("xz", b"no such thing", 100, "'xz', which is not known"),
        ("lz4", lz4.frame.compress(ZEROS), 1000, "another size"),
        ("zstd", zstandard.compress(ZEROS), 1000, "another size"),
        ("zstd", b"", (1 << 27) + 1, "128 MiB"),
    ],
)
def test_a_strange_chunk_is_one_error_and_takes_no_memory(
    small_log: Path, compression: str, data: bytes, size: int, reason: str
) -> None:
    path = with_chunk(small_log, compression, data, size)
    tracemalloc.start()
    with LogReader(path) as log:
        assert len(list(log)) == FRAMES
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(log.errors) == 1 and reason in str(log.errors[0]), log.errors
    assert peak < 1 << 24
    report = recover(path, path.with_name("clean.mcap"))
    assert report.frames == FRAMES and len(report.lost) == 1
    with pytest.raises(LogError, match="exists already"):
        recover(path, path.with_name("clean.mcap"))


def test_messages_of_one_chunk_unpack_it_once(small_log: Path) -> None:
    with LogReader(small_log) as log:
        payloads = [pack_parts(parts) for envelope, parts in log.messages() if envelope.topic == "frame"]
    inner = b"".join(struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(p), 9, 0, 0, 0) + p for p in payloads)
    packer = zstandard.ZstdCompressor().compressobj()  # a stream does not tell the size of what it holds
    packed = packer.compress(inner) + packer.flush()
    with LogReader(with_chunk(small_log, "zstd", packed, len(inner), zlib.crc32(inner))) as log:
        with patch.object(log_reader, "read_payloads", wraps=log_reader.read_payloads) as reads:
            assert len(list(log)) == 2 * FRAMES and not log.errors
        assert reads.call_count == FRAMES + 1


def test_a_damaged_head_costs_nothing_but_what_follows_it_where_there_is_no_index(small_log: Path) -> None:
    data = bytearray(small_log.read_bytes())
    data[chunk_starts(small_log)[5][0] + 5] ^= 0xFF  # of the record's length
    small_log.write_bytes(data)
    with LogReader(small_log) as log:  # the index names the chunks behind it
        assert len(list(log)) == FRAMES and log.finished
    small_log.write_bytes(data[:-1000])  # without its index
    with LogReader(small_log) as log:
        assert len(list(log)) == 4 and not log.finished and "passed over" in str(log.errors[0])
