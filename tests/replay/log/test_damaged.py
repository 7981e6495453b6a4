"""Logs with chunks that nobody's recorder writes: one error each, little memory, and the frames round them are read."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import lz4.frame
import mcap.reader
import pytest
import zstandard
from mcap.opcode import Opcode

from semantic_mapper.replay.log import reader
from semantic_mapper.replay.log.format import LogReader, recover
from semantic_mapper.transport.codec import pack_parts
from tests.replay.conftest import FRAMES

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


def test_messages_of_one_chunk_unpack_it_once(small_log: Path) -> None:
    with LogReader(small_log) as log:
        payloads = [pack_parts(parts) for envelope, parts in log.messages() if envelope.topic == "frame"]
    inner = b"".join(struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(p), 9, 0, 0, 0) + p for p in payloads)
    packer = zstandard.ZstdCompressor().compressobj()  # a stream does not tell the size of what it holds
    packed = packer.compress(inner) + packer.flush()
    with LogReader(with_chunk(small_log, "zstd", packed, len(inner), zlib.crc32(inner))) as log:
        with patch.object(reader, "read_payloads", wraps=reader.read_payloads) as reads:
            assert len(list(log)) == 2 * FRAMES and not log.errors
        assert reads.call_count == FRAMES + 1


def test_a_damaged_head_costs_nothing_but_what_follows_it_where_there_is_no_index(small_log: Path) -> None:
    with small_log.open("rb") as file:
        summary = mcap.reader.make_reader(file).get_summary()
    assert summary is not None
    offset = summary.chunk_indexes[5].chunk_start_offset
    data = bytearray(small_log.read_bytes())
    data[offset + 5] ^= 0xFF  # of the record's length
    small_log.write_bytes(data)
    with LogReader(small_log) as log:  # the index names the chunks behind it
        assert len(list(log)) == FRAMES and log.finished
    small_log.write_bytes(data[:-1000])  # without its index
    with LogReader(small_log) as log:
        assert len(list(log)) == 4 and not log.finished and "passed over" in str(log.errors[0])
