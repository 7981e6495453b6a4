"""Finds the messages of an MCAP file by walking its records, so that a damaged or unfinished file gives what it has.

Index and footer are not needed: they are the first things that an interrupted recording lacks. Each chunk's checksum
tells whether its messages can be believed. Where a record's head is damaged, the walk goes on at the next sound chunk.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from dataclasses import dataclass, field

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Message, Statistics
from mcap.stream_reader import CRCValidationError, breakup_chunk

from semantic_mapper.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
_MAX_CHUNK_BYTES = 1 << 29
_BLOCK = 1 << 20
_MESSAGE_HEAD = _RECORD.size + 22  # channel, sequence and two times stand before a message's data
_HEAD_BYTES = 128
_CHUNK_START = re.compile(rb"\x06(?=[\x00-\xff]{4}\x00{4})")  # looks ahead, so that no match hides another
_MAX_SMALL_BYTES = 1 << 20  # records that hold no data of ours: schemas, indexes, statistics, metadata
_KNOWN_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_PARSE_ERRORS = (
    McapError,
    CRCValidationError,
    struct.error,
    ValueError,
    OverflowError,
    EOFError,
    RuntimeError,
    MemoryError,
    zlib.error,
    zstandard.ZstdError,
)


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of the file that cannot be read.

    Args:
        offset, end: First byte, and the byte after the last one.
        chunk: How many chunks stand before it.
        reason: What is wrong with it.
    """

    offset: int
    end: int
    chunk: int
    reason: str


@dataclass(slots=True)
class Scan:
    """What a walk over the file found.

    Args:
        chunks: (offset, length) of each chunk record, or of a message that stands outside chunks.
        attachments: (offset, length) of each attachment record.
        damages: What had to be passed over.
        finished: Whether the file was closed by its writer; False after a crash.
        size: Of the file, bytes.
    """

    chunks: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    attachments: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    damages: list[Damage] = field(default_factory=list[Damage])
    finished: bool = False
    size: int = 0


def _what_is(start: bytes) -> str:
    """What a file is that begins with these bytes, for people."""
    if not start:
        return "it is empty"
    kinds = {
        b"PK": "a ZIP file, as saved maps are",
        b"#ROSBAG": "a ROS 1 bag",
        b"SQLite": "a SQLite file, as ROS 2 bags are",
    }
    return next(
        (f"it is {name}" for magic, name in kinds.items() if start.startswith(magic)), "it does not start like one"
    )


def scan(fd: int, where: str) -> Scan:
    """Walk the records of an open file.

    Args:
        fd: Of a file open for reading; its position is not used.
        where: Names the file in errors.

    Raises:
        LogError: not an MCAP file.
    """
    result = Scan(size=os.fstat(fd).st_size)
    magic = os.pread(fd, len(MAGIC), 0)
    if sum(x == y for x, y in zip(magic, MAGIC, strict=False)) < len(MAGIC) - 1:  # one damaged byte is no reason
        raise LogError(
            f"{where}: not an MCAP log ({_what_is(os.pread(fd, 16, 0))}); make one with `semantic-mapper import` or by "
            "`semantic-mapper up launch/record.toml`"
        )
    at = sure = len(MAGIC)
    while at < result.size and not result.finished:
        chunks = len(result.chunks)
        length, reason = _record_at(fd, at, result)
        at += length
        if len(result.chunks) > chunks:
            sure = at
        if reason:
            # Back to the last chunk: a record in between with a damaged length may have led us past others.
            at = _find_chunk(fd, sure, result.size)
            result.damages.append(Damage(sure, at, len(result.chunks), reason))
    return result


def scan_end(fd: int, length: int) -> Scan:
    """The same of the last ``length`` bytes, from the first believable chunk in them: quick, however long the file."""
    result = Scan(size=os.fstat(fd).st_size)
    at = len(MAGIC) if length >= result.size else _find_chunk(fd, result.size - length, result.size)
    while at < result.size and not result.finished:
        whole, reason = _record_at(fd, at, result)
        at = _find_chunk(fd, at + 1, result.size) if reason else at + whole
    return result


def _record_at(fd: int, at: int, result: Scan) -> tuple[int, str]:
    """Note the record at ``at``: its whole length, and why it cannot be one ("" where it can)."""
    head = os.pread(fd, _RECORD.size + _CHUNK.size, at)
    if len(head) < _RECORD.size:
        return 0, "the file ends in the middle of a record"
    opcode, length = _RECORD.unpack_from(head)
    whole = _RECORD.size + length
    if opcode not in _KNOWN_OPCODES:
        return 0, f"no record starts here (opcode {opcode})"
    if at + whole > result.size:
        return 0, "the file ends in the middle of a record, or the record's length is damaged"
    if opcode == Opcode.CHUNK:
        if not _is_chunk(fd, at, head, length):
            return 0, "the head of a chunk is damaged"
        result.chunks.append((at, whole))
    elif opcode == Opcode.MESSAGE:
        result.chunks.append((at, whole))
    elif opcode == Opcode.ATTACHMENT:
        result.attachments.append((at, whole))
    elif not _is_small_record(fd, at, opcode, length):
        return 0, "a record's head is damaged"
    elif opcode == Opcode.STATISTICS:
        _compare_counts(os.pread(fd, length, at + _RECORD.size), at, result)
    elif opcode == Opcode.FOOTER:
        result.finished = True
    return whole, ""


def _is_small_record(fd: int, at: int, opcode: int, length: int) -> bool:
    """One flipped bit makes a chunk look like another record, which would be passed over in silence: check sizes."""
    if opcode == Opcode.MESSAGE_INDEX:
        head = os.pread(fd, 6, at + _RECORD.size)
        return len(head) == 6 and struct.unpack("<HI", head)[1] + 6 == length
    if opcode == Opcode.FOOTER:
        return length == 20
    if opcode == Opcode.DATA_END:
        return length == 4
    return length <= _MAX_SMALL_BYTES


def _compare_counts(body: bytes, at: int, result: Scan) -> None:
    """The writer's own count of chunks tells of any that the walk has missed."""
    try:
        counted = Statistics.read(ReadDataStream(io.BytesIO(body))).chunk_count
    except _PARSE_ERRORS:
        return
    missing = counted - len(result.chunks)
    if missing > 0 and not result.damages:
        reason = f"its index counts {counted} chunks, {len(result.chunks)} were found"
        result.damages.append(Damage(at, at, len(result.chunks), reason))


def _is_chunk(fd: int, at: int, head: bytes, length: int) -> bool:
    """Whether the sizes in a chunk's head agree with its record; a strong test, as they stand there three times."""
    if len(head) < _RECORD.size + _CHUNK.size or length > _MAX_CHUNK_BYTES:
        return False
    _, _, uncompressed, _, name_length = _CHUNK.unpack_from(head, _RECORD.size)
    if name_length > 16 or uncompressed > _MAX_CHUNK_BYTES:
        return False
    tail = os.pread(fd, name_length + 8, at + _RECORD.size + _CHUNK.size)
    if len(tail) < name_length + 8:
        return False
    (data_length,) = struct.unpack_from("<Q", tail, name_length)
    return data_length + _CHUNK.size + name_length + 8 == length and (name_length > 0 or uncompressed == data_length)


def _find_chunk(fd: int, start: int, size: int) -> int:
    """Offset of the next believable chunk, or the end of the file."""
    while start < size:
        block = os.pread(fd, _BLOCK + _RECORD.size, start)  # the overlap finds a match that straddles two blocks
        for match in _CHUNK_START.finditer(block):
            at = start + match.start()
            head = os.pread(fd, _RECORD.size + _CHUNK.size, at)
            _, length = _RECORD.unpack_from(head)
            if at + _RECORD.size + length <= size and _is_chunk(fd, at, head, length):
                return at
        start += _BLOCK
    return size


def read_messages(fd: int, offset: int, length: int, where: str) -> list[Message]:
    """Messages of one chunk (or a message outside chunks), once its checksum has been found right.

    Raises:
        LogError: damaged.
    """
    try:
        record = os.pread(fd, length, offset)
        stream = ReadDataStream(io.BytesIO(record[_RECORD.size :]))
        if record[0] == Opcode.MESSAGE:
            return [Message.read(stream, length - _RECORD.size)]
        chunk = Chunk.read(stream)
        if chunk.compression == "zstd":
            _check_zstd_size(chunk)
        elif chunk.compression == "lz4":
            _unpack_lz4(chunk)
        elif chunk.compression:
            raise ValueError(f"compressed with {chunk.compression!r}, which is not known")
        return [r for r in breakup_chunk(chunk, validate_crc=True) if isinstance(r, Message)]
    except OSError as error:
        raise LogError(f"{where}: cannot be read from disk: {error}") from error
    except _PARSE_ERRORS as error:
        raise LogError(f"{where}: damaged: {str(error) or type(error).__name__}") from error


def payload_heads(fd: int, offset: int, length: int) -> list[bytes]:
    """The first bytes of each message of a chunk, without reading (and checking) all of it; [b""] where damaged."""
    head = os.pread(fd, _RECORD.size + _CHUNK.size, offset)
    if head[0] == Opcode.MESSAGE:
        return [os.pread(fd, _HEAD_BYTES, offset + _MESSAGE_HEAD)]
    name_length = _CHUNK.unpack_from(head, _RECORD.size)[4]
    if name_length > 0:  # compressed by another tool
        try:
            return [m.data[:_HEAD_BYTES] for m in read_messages(fd, offset, length, "")]
        except LogError:
            return [b""]
    heads: list[bytes] = []
    at = offset + _RECORD.size + _CHUNK.size + 8
    while at + _RECORD.size <= offset + length:
        opcode, inner = _RECORD.unpack(os.pread(fd, _RECORD.size, at))
        if at + _RECORD.size + inner > offset + length:
            break
        if opcode == Opcode.MESSAGE:
            heads.append(os.pread(fd, _HEAD_BYTES, at + _MESSAGE_HEAD))
        at += _RECORD.size + inner
    return heads or [b""]


def read_attachment(fd: int, offset: int, length: int) -> Attachment | None:
    """One attachment, or None where its checksum is wrong."""
    record = os.pread(fd, length, offset)
    body = record[_RECORD.size :]
    if len(body) < 4 or zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        return None
    try:
        return Attachment.read(ReadDataStream(io.BytesIO(body)))
    except _PARSE_ERRORS:
        return None


def _check_zstd_size(chunk: Chunk) -> None:
    """The decompressor allocates what the data announce, not what the chunk does."""
    if zstandard.frame_content_size(chunk.data) != chunk.uncompressed_size:
        raise ValueError("compressed data announce another size than the chunk")


def _unpack_lz4(chunk: Chunk) -> None:
    """The decompressor believes any amount of data unless it is told how much there may be."""
    data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    if len(data) != chunk.uncompressed_size:
        raise ValueError("compressed data hold another size than the chunk announces")
    chunk.compression, chunk.data = "", data
