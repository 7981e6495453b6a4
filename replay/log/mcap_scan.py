"""Finds the messages of an MCAP file by walking its records, so that a damaged or unfinished file gives what it has.

Index and footer are not needed: they are the first things that an interrupted recording lacks. Each chunk's checksum
tells whether its messages can be believed. Where a record's head is damaged, the walk goes on at the next sound chunk.

A hostile file costs no more than a large one: memory and parsing are bounded before they happen, per chunk by
``check_chunk_sizes`` and ``MAX_CHUNK_RECORDS``, per file by ``ReadLimits``.
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
from mcap.records import Attachment

from semantic_mapper.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
_INDEX = struct.Struct("<HI")  # channel, bytes of the entries
_STATISTICS = struct.Struct("<QHIIII")  # messages, schemas, channels, attachments, metadata, chunks
_MAX_CHUNK_BYTES = 1 << 29
MAX_UNPACKED_BYTES = 1 << 27  # of a compressed chunk; tools make chunks of 4 MiB, or of one message
FREE_UNPACKED_BYTES = 1 << 23  # up to here a chunk may be compressed as far as it goes: a few images of one colour
MAX_RATIO = 100  # beyond; images are compressed already
MAX_CHUNK_RECORDS = 1 << 16
MAX_ATTACHMENTS = 1 << 10
MAX_ATTACHMENT_BYTES = 1 << 28
_DAMAGE_COST = 16  # records: what it costs to report a damage and find the next chunk
_FIRST_BLOCK, _BLOCK = 1 << 12, 1 << 20
_MESSAGE_HEAD = _RECORD.size + 22  # channel, sequence and two times stand before a message's data
_HEAD_BYTES = 128
_CHUNK_START = re.compile(rb"\x06(?=[\x00-\xff]{4}\x00{4})")  # looks ahead, so that no match hides another
_MAX_SMALL_BYTES = 1 << 20  # records that hold no data of ours: schemas, indexes, statistics, metadata
# Plain integers: comparing members of an IntEnum takes most of the time of a walk over small records.
_FOOTER, _MESSAGE, _CHUNK_OPCODE, _MESSAGE_INDEX = 0x02, 0x05, 0x06, 0x07
_ATTACHMENT, _STATISTICS_OPCODE, _DATA_END = 0x09, 0x0B, 0x0F
# Shortest body of each kind of record: all strings, arrays and maps empty.
_LEAST_BYTES: dict[int, int] = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: 22,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 64,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
_PARSE_ERRORS = (
    McapError,
    struct.error,
    ValueError,
    OverflowError,
    EOFError,
    RuntimeError,
    MemoryError,
    zlib.error,
    zstandard.ZstdError,
)


@dataclass(slots=True)
class ReadLimits:
    """What reading a file may cost; each figure goes down as it is spent.

    The limits grow with the file: a recording needs far less, and a made-up file costs no more than seconds.

    Args:
        records: Records and places that look like one that may be examined.
        messages: Messages that may be indexed.
        unpacked_bytes: Sum over all compressed chunks.
    """

    records: int
    messages: int
    unpacked_bytes: int

    @classmethod
    def of_file(cls, size: int) -> ReadLimits:
        """Limits of a file of ``size`` bytes."""
        return cls((1 << 17) + size // 128, (1 << 16) + size // 256, (1 << 26) + MAX_RATIO * size)


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


class _Heads:
    """Reads the few bytes at the head of records, a block at a time: records may be small and many.

    Args:
        fd: Of the file.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._start = self._end = 0
        self._block = b""

    def read(self, at: int, count: int) -> bytes:
        """``count`` bytes from ``at``, fewer at the end of the file; at most 4 KiB."""
        if not self._start <= at <= self._end - count:
            self._block = os.pread(self.fd, _FIRST_BLOCK, at)
            self._start, self._end = at, at + len(self._block)
        return self._block[at - self._start : at - self._start + count]


@dataclass(slots=True)
class Scan:
    """What a walk over the file found.

    Args:
        chunks: (offset, length) of each chunk record, or of a message that stands outside chunks.
        attachments: (offset, length) of each attachment record.
        damages: What had to be passed over.
        finished: Whether the file was closed by its writer; False after a crash.
        size: Of the file, bytes.
        limits: What may still be spent on this file.
    """

    limits: ReadLimits
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
    size = os.fstat(fd).st_size
    result = Scan(ReadLimits.of_file(size), size=size)
    magic = os.pread(fd, len(MAGIC), 0)
    if sum(x == y for x, y in zip(magic, MAGIC, strict=False)) < len(MAGIC) - 1:  # one damaged byte is no reason
        raise LogError(
            f"{where}: not an MCAP log ({_what_is(os.pread(fd, 16, 0))}); make one with `semantic-mapper import` or by "
            "`semantic-mapper up replay --set recorder.enabled=true`"
        )
    heads = _Heads(fd)
    at = sure = len(MAGIC)
    while at < result.size and not result.finished:
        if result.limits.records <= 0:
            reason = "the file holds more records than a recording of its size; the rest is not read"
            result.damages.append(Damage(at, result.size, len(result.chunks), reason))
            break
        chunks = len(result.chunks)
        length, reason = _record_at(heads, at, result)
        result.limits.records -= 1
        at += length
        if len(result.chunks) > chunks:
            sure = at
        if reason:
            # Back to the last chunk: a record in between with a damaged length may have led us past others.
            at = _find_chunk(fd, sure, result.size, result.limits)
            if result.limits.records <= 0:
                reason += "; too many places after it look like a chunk"
            result.damages.append(Damage(sure, at, len(result.chunks), reason))
            result.limits.records -= _DAMAGE_COST
    return result


def scan_end(fd: int, length: int) -> Scan:
    """The same of the last ``length`` bytes, from the first believable chunk in them: quick, however long the file."""
    size = os.fstat(fd).st_size
    result = Scan(ReadLimits.of_file(size), size=size)
    heads = _Heads(fd)
    at = len(MAGIC) if length >= size else _find_chunk(fd, size - length, size, result.limits)
    while at < size and not result.finished and result.limits.records > 0:
        result.limits.records -= 1
        whole, reason = _record_at(heads, at, result)
        at = _find_chunk(fd, at + 1, size, result.limits) if reason else at + whole
    return result


def _record_at(heads: _Heads, at: int, result: Scan) -> tuple[int, str]:
    """Note the record at ``at``: its whole length, and why it cannot be one ("" where it can)."""
    head = heads.read(at, _RECORD.size + _CHUNK.size)
    if len(head) < _RECORD.size:
        return 0, "the file ends in the middle of a record"
    opcode, length = _RECORD.unpack_from(head)
    whole = _RECORD.size + length
    if opcode not in _LEAST_BYTES:
        return 0, f"no record starts here (opcode {opcode})"
    if length < _LEAST_BYTES[opcode]:
        return 0, f"a record (opcode {opcode}) of {length} bytes is too short for its kind"
    if at + whole > result.size:
        return 0, "the file ends in the middle of a record, or the record's length is damaged"
    if opcode == _CHUNK_OPCODE:
        sizes = _chunk_sizes(heads.fd, at, head, length)
        if sizes is None:
            return 0, "the head of a chunk is damaged"
        if reason := _refuse_chunk(*sizes, result.limits):
            result.damages.append(Damage(at, at + whole, len(result.chunks), reason))
        else:
            result.chunks.append((at, whole))
    elif opcode == _MESSAGE:
        result.chunks.append((at, whole))
    elif opcode == _ATTACHMENT:
        _note_attachment(at, whole, result)
    elif not _is_small_record(head, opcode, length):
        return 0, "a record's head is damaged"
    elif opcode == _STATISTICS_OPCODE:
        _compare_counts(head[_RECORD.size :], at, result)
    elif opcode == _FOOTER:
        result.finished = True
    return whole, ""


def _refuse_chunk(compressed: bool, packed: int, unpacked: int, limits: ReadLimits) -> str:
    """Why a chunk must not be unpacked, "" where it may; takes it off the limits of the file."""
    if not compressed:
        return ""
    try:
        check_chunk_sizes(packed, unpacked)
    except ValueError as error:
        return str(error)
    if unpacked > limits.unpacked_bytes:
        return f"the compressed chunks up to here unpack to more than {MAX_RATIO} times the size of the file"
    limits.unpacked_bytes -= unpacked
    return ""


def check_chunk_sizes(packed: int, unpacked: int) -> None:
    """Refuse a compressed chunk that says of itself that it unpacks to more than a recording's would.

    Args:
        packed, unpacked: Bytes of its records, compressed and not.

    Raises:
        ValueError: over a limit.
    """
    if unpacked > MAX_UNPACKED_BYTES:
        limit = f"at most {MAX_UNPACKED_BYTES >> 20} MiB"
    elif unpacked > max(FREE_UNPACKED_BYTES, MAX_RATIO * packed):
        limit = f"above {FREE_UNPACKED_BYTES >> 20} MiB at most {MAX_RATIO} times its size"
    else:
        return
    raise ValueError(f"a compressed chunk of {packed:,} bytes unpacks to {unpacked:,}; allowed is {limit}")


def _note_attachment(at: int, whole: int, result: Scan) -> None:
    if len(result.attachments) >= MAX_ATTACHMENTS:
        reason = f"the file holds more than {MAX_ATTACHMENTS} attachments; from here on they are left out"
        if all(damage.reason != reason for damage in result.damages):
            result.damages.append(Damage(at, at + whole, len(result.chunks), reason))
    elif whole > MAX_ATTACHMENT_BYTES:
        reason = f"an attachment of {whole:,} bytes, more than {MAX_ATTACHMENT_BYTES >> 20} MiB, is left out"
        result.damages.append(Damage(at, at + whole, len(result.chunks), reason))
    else:
        result.attachments.append((at, whole))


def _is_small_record(head: bytes, opcode: int, length: int) -> bool:
    """One flipped bit makes a chunk look like another record, which would be passed over in silence: check sizes."""
    if opcode == _MESSAGE_INDEX:
        return len(head) >= _RECORD.size + 6 and _INDEX.unpack_from(head, _RECORD.size)[1] + 6 == length
    if opcode == _FOOTER:
        return length == 20
    if opcode == _DATA_END:
        return length == 4
    return length <= _MAX_SMALL_BYTES


def _compare_counts(body: bytes, at: int, result: Scan) -> None:
    """The writer's own count of chunks tells of any that the walk has missed."""
    if len(body) < _STATISTICS.size:
        return
    counted = _STATISTICS.unpack_from(body)[5]
    missing = counted - len(result.chunks)
    if missing > 0 and not result.damages:
        reason = f"its index counts {counted} chunks, {len(result.chunks)} were found"
        result.damages.append(Damage(at, at, len(result.chunks), reason))


def _chunk_sizes(fd: int, at: int, head: bytes, length: int) -> tuple[bool, int, int] | None:
    """Whether a chunk is compressed, and the bytes of its records in the file and unpacked.

    None where the sizes in its head disagree with its record; a strong test, as they stand there three times.
    """
    if len(head) < _RECORD.size + _CHUNK.size or length > _MAX_CHUNK_BYTES:
        return None
    _, _, unpacked, _, name_length = _CHUNK.unpack_from(head, _RECORD.size)
    if name_length > 16:
        return None
    tail = os.pread(fd, name_length + 8, at + _RECORD.size + _CHUNK.size)
    if len(tail) < name_length + 8:
        return None
    (packed,) = struct.unpack_from("<Q", tail, name_length)
    if packed + _CHUNK.size + name_length + 8 != length or not (name_length or unpacked == packed):
        return None
    return name_length > 0, packed, unpacked


def _find_chunk(fd: int, start: int, size: int, limits: ReadLimits) -> int:
    """Offset of the next believable chunk, or the end of the file."""
    block_bytes = _FIRST_BLOCK
    while start < size:
        block = os.pread(fd, block_bytes + _RECORD.size, start)  # the overlap finds a match that straddles two blocks
        for match in _CHUNK_START.finditer(block):
            if limits.records <= 0:
                return size
            limits.records -= 1
            at = start + match.start()
            head = os.pread(fd, _RECORD.size + _CHUNK.size, at)
            if len(head) < _RECORD.size:
                continue
            _, length = _RECORD.unpack_from(head)
            if at + _RECORD.size + length <= size and _chunk_sizes(fd, at, head, length) is not None:
                return at
        start += block_bytes
        block_bytes = min(2 * block_bytes, _BLOCK)
    return size


def read_payloads(fd: int, offset: int, length: int) -> list[bytes]:
    """Data of the messages of one chunk (or of a message outside chunks), once its checksum has been found right.

    Raises:
        LogError: damaged, beyond the limits of a chunk, or the disk fails; says not where.
    """
    try:
        record = os.pread(fd, length, offset)
        if record[0] == _MESSAGE:
            return [record[_MESSAGE_HEAD:]]
        return _payloads(_unpack_chunk(record))
    except OSError as error:
        raise LogError(f"cannot be read from disk: {error}") from error
    except (IndexError, *_PARSE_ERRORS) as error:
        raise LogError(f"damaged: {str(error) or type(error).__name__}") from error


def _unpack_chunk(record: bytes) -> bytes:
    """The records of a chunk.

    Raises:
        ValueError, RuntimeError, ZstdError: damaged, or larger than a chunk may be.
    """
    _, _, unpacked, crc, name_length = _CHUNK.unpack_from(record, _RECORD.size)
    at = _RECORD.size + _CHUNK.size
    name = record[at : at + name_length]
    data = record[at + name_length + 8 :]
    if name:
        check_chunk_sizes(len(data), unpacked)
    if name == b"zstd":
        # The decompressor allocates what the data declare; -1 where they do not, then it is the chunk that bounds it.
        if zstandard.frame_content_size(data) not in (unpacked, -1):
            raise ValueError("compressed data declare another size than the chunk")
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=unpacked)
    elif name == b"lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=unpacked + 1)
    elif name:
        raise ValueError(f"compressed with {name.decode('ascii', 'replace')!r}, which is not known")
    if len(data) != unpacked:
        raise ValueError("the chunk holds another size than it declares")
    if crc and zlib.crc32(data) != crc:
        raise ValueError("the checksum (crc) of the chunk is wrong")
    return data


def _payloads(data: bytes) -> list[bytes]:
    """Data of the messages among the records of a chunk.

    Raises:
        ValueError: these are no records, or more than a chunk may hold.
    """
    payloads: list[bytes] = []
    at = records = 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        records += 1
        if at > len(data):
            raise ValueError("a record is longer than its chunk")
        if reason := _refuse_inner_record(opcode, length, records):
            raise ValueError(reason)
        if opcode == _MESSAGE:
            payloads.append(data[start + _LEAST_BYTES[_MESSAGE] : at])
    return payloads


def _refuse_inner_record(opcode: int, length: int, number: int) -> str:
    """Why a chunk that holds this record must not be read on; "" where it may.

    Kinds of records that are not known are to be passed over, but none of them is opcode 0 or empty.
    """
    if opcode == 0 or length < _LEAST_BYTES.get(opcode, 1):
        return f"the chunk holds a record with opcode {opcode} and {length} bytes, which cannot be"
    if number > MAX_CHUNK_RECORDS:
        return f"the chunk holds more than {MAX_CHUNK_RECORDS:,} records"
    return ""


def payload_heads(fd: int, offset: int, length: int, limits: ReadLimits) -> list[bytes]:
    """The first bytes of each message of a chunk, without reading (and checking) all of it; [b""] where damaged."""
    head = os.pread(fd, _RECORD.size + _CHUNK.size, offset)
    if head[0] == _MESSAGE:
        return [os.pread(fd, min(_HEAD_BYTES, length - _MESSAGE_HEAD), offset + _MESSAGE_HEAD)]
    name_length = _CHUNK.unpack_from(head, _RECORD.size)[4]
    if name_length > 0:  # compressed by another tool
        try:
            return [payload[:_HEAD_BYTES] for payload in read_payloads(fd, offset, length)]
        except LogError:
            return [b""]
    window, heads = _Heads(fd), list[bytes]()
    at, records = offset + _RECORD.size + _CHUNK.size + 8, 0
    while at + _RECORD.size <= offset + length and limits.records > 0:
        opcode, inner = _RECORD.unpack(window.read(at, _RECORD.size))
        records += 1
        limits.records -= 1
        if _refuse_inner_record(opcode, inner, records):
            return [b""]
        if at + _RECORD.size + inner > offset + length:
            break
        if opcode == _MESSAGE:
            heads.append(window.read(at + _MESSAGE_HEAD, min(_HEAD_BYTES, inner - _LEAST_BYTES[_MESSAGE])))
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
