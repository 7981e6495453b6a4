"""Logs that a fuzzer has found, and more of their kind: whatever the bytes, a log error at most."""

from __future__ import annotations

import random
import struct
import tracemalloc
import zlib
from contextlib import suppress
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode

from replay.log import LogReader
from scripts.fuzz_targets import TARGETS, flip
from semantic_mapper.errors import MapError, SemanticMapperError


def with_chunk(compression: str, data: bytes, size: int, crc: int = 0) -> bytes:
    """A log whose last chunk is this one."""
    (whole, _) = TARGETS["log"].seeds()
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(data)) + data
    record = struct.pack("<BQ", Opcode.CHUNK, len(body)) + body
    end = whole.rfind(struct.pack("<BQ", Opcode.DATA_END, 4))
    assert end > 0
    return whole[:end] + record + whole[end:]


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


def test_chunks_that_another_tool_compressed_are_read(tmp_path: Path) -> None:
    inner = struct.pack("<BQ", Opcode.MESSAGE, 22 + 4) + struct.pack("<HIQQ", 9, 0, 0, 0) + b"none"
    for name, data in (("lz4", lz4.frame.compress(inner)), ("zstd", zstandard.compress(inner))):
        errors = read(with_chunk(name, data, len(inner), zlib.crc32(inner)), tmp_path / "log.mcap")
        assert len(errors) == 1 and "damaged" not in errors[0], errors  # only that "none" is no message of ours


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_raise_nothing_but_our_errors(name: str) -> None:
    """A second of what ``scripts/fuzz.py`` does, without its guidance."""
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
