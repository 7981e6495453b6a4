"""Logs that a fuzzer has found, and more of their kind: whatever the bytes, a log error at most."""

from __future__ import annotations

import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from unittest.mock import patch

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode

from research.experiments.fuzz_targets import TARGETS, flip
from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.replay.log import reader
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.replay.log.recover import recover
from semantic_mapper.transport.codec import pack_parts


def with_chunk(compression: str, data: bytes, size: int, crc: int = 0) -> bytes:
    """A log whose last chunk is this one."""
    return with_records(chunk_record(compression, data, size, crc))


def chunk_record(compression: str, data: bytes, size: int, crc: int = 0) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


def with_records(records: bytes) -> bytes:
    """A log of three frames with these records after them."""
    whole = TARGETS["log"].seeds()[0]
    end = whole.rfind(struct.pack("<BQ", Opcode.DATA_END, 4))
    assert end > 0
    return whole[:end] + records + whole[end:]


def read(data: bytes, path: Path) -> list[str]:
    """Errors of a log that is read whole."""
    path.write_bytes(data)
    with LogReader(path) as log:
        assert len(list(log)) == 3  # the frames before the bad chunk
        return [str(error) for error in log.errors]


def test_a_record_in_a_chunk_that_announces_more_than_can_be(tmp_path: Path) -> None:
    inner = struct.pack("<BQ", Opcode.SCHEMA, 1 << 63) + bytes(20)
    errors = read(with_chunk("", inner, len(inner), zlib.crc32(inner)), tmp_path / "log.mcap")
    assert len(errors) == 1 and "damaged" in errors[0]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "xz"])
def test_a_chunk_that_is_not_compressed_as_it_says(tmp_path: Path, compression: str) -> None:
    assert read(with_chunk(compression, b"no such thing", 100), tmp_path / "log.mcap")


def test_a_bomb_takes_no_more_memory_than_its_chunk_announces(tmp_path: Path) -> None:
    zeros = bytes(1 << 26)
    for name, data in (("lz4", lz4.frame.compress(zeros)), ("zstd", zstandard.compress(zeros))):
        spoiled = with_chunk(name, data, 1000)
        tracemalloc.start()
        errors = read(spoiled, tmp_path / "log.mcap")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(errors) == 1 and "size" in errors[0]
        assert peak < 1 << 24


COMPRESS: dict[str, Callable[[bytes], bytes]] = {"": bytes, "lz4": lz4.frame.compress, "zstd": zstandard.compress}
EMPTY_MESSAGE = struct.pack("<BQ", Opcode.MESSAGE, 22) + bytes(22)


@pytest.mark.parametrize(("compression", "limit"), [("lz4", "100 times"), ("zstd", "100 times"), ("zstd", "128 MiB")])
def test_a_chunk_that_unpacks_to_far_more_than_it_takes_is_not_unpacked(
    tmp_path: Path, compression: str, limit: str
) -> None:
    zeros = bytes(1 << 24 if limit == "100 times" else (1 << 27) + 1)
    bomb = with_chunk(compression, COMPRESS[compression](zeros), len(zeros))
    tracemalloc.start()
    errors = read(bomb, tmp_path / "log.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(errors) == 1 and "unpacks to" in errors[0] and limit in errors[0]
    assert peak < 1 << 22


def test_chunks_that_are_small_by_themselves_may_not_unpack_to_more_than_the_file_could(tmp_path: Path) -> None:
    inner = struct.pack("<BQ", Opcode.MESSAGE, (1 << 23) - 9) + bytes((1 << 23) - 9)
    record = chunk_record("zstd", zstandard.compress(inner), len(inner), zlib.crc32(inner))
    errors = read(with_records(record * 20), tmp_path / "log.mcap")
    assert len(errors) == 20
    assert 0 < sum("100 times the size of the file" in error for error in errors) < 20


@pytest.mark.parametrize("compression", COMPRESS)
@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (bytes(9), "opcode 0"),
        (struct.pack("<BQ", Opcode.SCHEMA, 0), "opcode 3 and 0 bytes"),
        (struct.pack("<BQ", 0x80, 0), "opcode 128 and 0 bytes"),
        (EMPTY_MESSAGE, "more than 65,536 records"),
    ],
)
def test_a_chunk_of_countless_records_is_one_damage(
    tmp_path: Path, compression: str, record: bytes, reason: str
) -> None:
    inner = record * (70_000 if record is EMPTY_MESSAGE else 300_000)
    errors = read(with_chunk(compression, COMPRESS[compression](inner), len(inner)), tmp_path / "log.mcap")
    assert len(errors) == 1 and reason in errors[0], errors[:3]


@pytest.mark.parametrize(
    ("record", "reason"),
    [
        (struct.pack("<BQ", Opcode.METADATA, 0), "too short for its kind"),
        (struct.pack("<BQ", Opcode.METADATA, 8) + bytes(8), "more records than a recording"),
        (struct.pack("<BQ", Opcode.MESSAGE_INDEX, 6) + bytes(6), "more records than a recording"),
        (EMPTY_MESSAGE, "more messages than a recording"),
        (struct.pack("<BQ", Opcode.ATTACHMENT, 36) + bytes(32) + struct.pack("<I", zlib.crc32(bytes(32))), "1024"),
        (b"\xee" + struct.pack("<BQQQQIIQ", Opcode.CHUNK, 40, 0, 0, 0, 0, 0, 0), "more records than a recording"),
        (b"\xee" + (b"\x06" * 5 + bytes(8)) * 16, "look like a chunk"),
    ],
)
def test_a_file_of_countless_records_is_read_no_further_than_a_recording_would_be(
    tmp_path: Path, record: bytes, reason: str
) -> None:
    path = write(tmp_path / "log.mcap", with_records(record * (10 * 2**20 // len(record))))
    with LogReader(path) as log:
        assert [frame.seq for frame in islice(log, 3)]  # what is sound before it is read
        assert sum(reason in str(error) for error in log.errors) == 1
        assert len(log) < 20_000 and len(log.errors) < 20_000


def test_messages_of_one_chunk_unpack_it_once(tmp_path: Path) -> None:
    with LogReader(write(tmp_path / "log.mcap", TARGETS["log"].seeds()[0])) as log:
        payloads = [pack_parts(parts) for envelope, parts in log.messages() if envelope.topic == "frame"]
    inner = b"".join(
        struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(payload), 9, 0, 0, 0) + payload for payload in payloads
    )
    for data in (zstandard.compress(inner), _unsized_zstd(inner), inner):
        name = "" if data is inner else "zstd"
        path = write(tmp_path / "log.mcap", with_chunk(name, data, len(inner), zlib.crc32(inner)))
        with LogReader(path) as log:
            with patch.object(reader, "read_payloads", wraps=reader.read_payloads) as reads:
                assert len(list(log)) == 6 and not log.errors
            assert reads.call_count == 4  # the three frames before it, and the chunk


def _unsized_zstd(data: bytes) -> bytes:
    """As tools that compress a stream write it: without the size of what they compress."""
    packer = zstandard.ZstdCompressor().compressobj()
    packed = packer.compress(data) + packer.flush()
    assert zstandard.frame_content_size(packed) == -1
    return packed


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def test_recover_keeps_what_stands_round_a_bomb(tmp_path: Path) -> None:
    zeros = bytes(1 << 25)
    bomb = with_chunk("zstd", zstandard.compress(zeros), len(zeros))
    report = recover(write(tmp_path / "log.mcap", bomb), tmp_path / "clean.mcap")
    assert report.frames == 3 and ["unpacks to" in str(error) for error in report.lost] == [True]
    with LogReader(tmp_path / "clean.mcap") as log:
        assert len(list(log)) == 3 and not log.errors


def test_chunks_that_another_tool_compressed_are_read(tmp_path: Path) -> None:
    inner = struct.pack("<BQ", Opcode.MESSAGE, 22 + 4) + struct.pack("<HIQQ", 9, 0, 0, 0) + b"none"
    for name, data in (("lz4", lz4.frame.compress(inner)), ("zstd", zstandard.compress(inner))):
        errors = read(with_chunk(name, data, len(inner), zlib.crc32(inner)), tmp_path / "log.mcap")
        assert len(errors) == 1 and "damaged" not in errors[0], errors  # only that "none" is no message of ours


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_raise_nothing_but_our_errors(name: str) -> None:
    """A second of what ``research/experiments/fuzz.py`` does, without its guidance."""
    target, rng = TARGETS[name], random.Random(7)
    seeds = target.seeds()
    for seed in seeds[: 1 if name == "log" else None]:
        with suppress(MapError):  # the answer that is an error
            target.read(seed)
    refused = 0
    for _ in range(60 if name == "log" else 1500):
        data = rng.choice(seeds)
        for _ in range(rng.randint(1, 3)):
            data = target.mutate(data, rng, lambda part: flip(part, rng))
        try:
            target.read(data)
        except SemanticMapperError:
            refused += 1
    assert refused
