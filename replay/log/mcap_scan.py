"""Finds the messages of an MCAP file: by its index, or, where the writer did not come to write one, record by record.

An index whose checksum is right names every chunk, whatever is damaged before it. Without an index a damaged head of a
record costs what stands between it and the next sound chunk. Each chunk's own checksum tells whether its messages can
be believed. A chunk is unpacked only where it declares a size that a recording's chunks have.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, ChunkIndex
from mcap.stream_reader import StreamReader

from semantic_mapper.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # start, end, unpacked size, crc, length of the compression's name
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, crc of the summary
_MESSAGE_BYTES = 22  # channel, sequence and two times, before a message's data
_HEAD_BYTES = 128  # of a message's data, which tell its topic
MAX_CHUNK_BYTES = 1 << 29
MAX_UNPACKED_BYTES = 1 << 27  # of a compressed chunk; tools make chunks of 4 MiB, or of one message
FREE_UNPACKED_BYTES = 1 << 23  # up to here a chunk may be compressed as far as it goes: a few images of one colour
MAX_RATIO = 100  # beyond; images are compressed already
MAX_CHUNK_RECORDS = 1 << 16
MAX_ATTACHMENT_BYTES = 1 << 28
_MAX_SMALL_BYTES = 1 << 20  # of records that hold no data of ours: schemas, indexes, statistics, metadata
_BLOCK = 1 << 20
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_CHUNK_START = re.compile(rb"\x06(?=[\x00-\xff]{4}\x00{4})")  # looks ahead, so that no match hides another
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, EOFError, RuntimeError, MemoryError, IndexError)
_KINDS = {
    b"PK": "a ZIP file, as saved maps are",
    b"#ROSBAG": "a ROS 1 bag",
    b"SQLite": "a SQLite file, as ROS 2 bags are",
}


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of the file that cannot be read.

    Args:
        offset, end: First byte, and the byte after the last one.
        reason: What is wrong with it.
    """

    offset: int
    end: int
    reason: str


@dataclass(slots=True)
class Scan:
    """Where the messages of a file are.

    Args:
        chunks: (offset, length) of each chunk record, or of a message that stands outside chunks.
        attachments: (offset, length) of each attachment record.
        damages: What had to be passed over.
        finished: Whether the file was closed by its writer; False after a crash.
    """

    chunks: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    attachments: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    damages: list[Damage] = field(default_factory=list[Damage])
    finished: bool = False


def scan(fd: int, where: str) -> Scan:
    """Find the messages of a file that is open for reading; its position is not used.

    Args:
        fd: Of the file.
        where: Names the file in errors.

    Raises:
        LogError: not an MCAP file.
    """
    size = os.fstat(fd).st_size
    start = os.pread(fd, 16, 0)
    if sum(x == y for x, y in zip(start, MAGIC, strict=False)) < len(MAGIC) - 1:  # one damaged byte is no reason
        kind = next((f"is {name}" for magic, name in _KINDS.items() if start.startswith(magic)), "")
        what = f"it {kind or 'does not start like one'}" if start else "it is empty"
        raise LogError(
            f"{where}: not an MCAP log ({what}); make one with `semantic-mapper import` or by "
            "`semantic-mapper up replay --set recorder.enabled=true`"
        )
    return _read_index(fd, size) or _walk(fd, len(MAGIC), size)


def _read_index(fd: int, size: int) -> Scan | None:
    """What the index says; None where it is missing or damaged."""
    end = size - len(MAGIC) - _FOOTER.size
    tail = os.pread(fd, _FOOTER.size + len(MAGIC), max(end, 0))
    if not tail.endswith(MAGIC) or len(tail) != _FOOTER.size + len(MAGIC):
        return None
    opcode, _, summary, _, crc = _FOOTER.unpack_from(tail)
    if opcode != Opcode.FOOTER or not 0 < summary < end:
        return None
    data = os.pread(fd, end - summary, summary)
    if crc and zlib.crc32(data + tail[: _FOOTER.size - 4]) != crc:
        return None
    found = Scan(finished=True)
    try:
        for record in StreamReader(io.BytesIO(data + tail), skip_magic=True).records:
            if isinstance(record, ChunkIndex):
                found.chunks.append((record.chunk_start_offset, record.chunk_length))
            elif isinstance(record, AttachmentIndex):
                found.attachments.append((record.offset, record.length))
    except _PARSE_ERRORS:
        return None
    for places in (found.chunks, found.attachments):
        places.sort()
        bounds = [(0, len(MAGIC)), *places, (summary, 0)]
        if any(a + length > b for (a, length), (b, _) in pairwise(bounds)):
            return None
    return found if found.chunks else None  # messages outside chunks are in no index


def _walk(fd: int, at: int, size: int) -> Scan:
    """Record by record; where one cannot be, on from the next sound chunk behind the last one."""
    found = Scan()
    sure = at
    while at < size and not found.finished:
        head = os.pread(fd, _RECORD.size + _CHUNK.size, at)
        opcode, length = _RECORD.unpack_from(head) if len(head) >= _RECORD.size else (0, size)
        end = at + _RECORD.size + length
        if reason := _damage_of(fd, at, head, opcode, end, size):
            at = _next_chunk(fd, sure, size)  # a record in between may have led us past others
            found.damages.append(Damage(sure, at, reason))
            sure = at
            continue
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            found.chunks.append((at, end - at))
            sure = end
        elif opcode == Opcode.ATTACHMENT:
            found.attachments.append((at, end - at))
        found.finished = opcode == Opcode.FOOTER
        at = end
    return found


def _damage_of(fd: int, at: int, head: bytes, opcode: int, end: int, size: int) -> str:
    """Why no record can be here; "" where one can."""
    if end > size:
        return "the file ends in the middle of a record, or the record's length is damaged"
    if opcode not in _OPCODES:
        return f"no record starts here (opcode {opcode})"
    if opcode == Opcode.CHUNK and not _is_chunk(fd, at, head, end):
        return "the head of a chunk is damaged"
    if opcode == Opcode.MESSAGE and end - at < _RECORD.size + _MESSAGE_BYTES:
        return "a message is too short"
    if opcode not in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT) and end - at > _MAX_SMALL_BYTES:
        return "a record's head is damaged"
    return ""


def _is_chunk(fd: int, at: int, head: bytes, end: int) -> bool:
    """Whether the sizes in a chunk's head agree with its record: a strong test, as they stand there three times."""
    if len(head) < _RECORD.size + _CHUNK.size or end - at > MAX_CHUNK_BYTES:
        return False
    _, _, unpacked, _, name_bytes = _CHUNK.unpack_from(head, _RECORD.size)
    start = at + _RECORD.size + _CHUNK.size + name_bytes + 8
    packed = os.pread(fd, 8, start - 8) if name_bytes <= 16 else b""
    if len(packed) < 8 or start + int.from_bytes(packed, "little") != end:
        return False
    return name_bytes > 0 or unpacked == end - start


def _next_chunk(fd: int, start: int, size: int) -> int:
    """Offset of the next believable chunk, or the end of the file."""
    while start < size:
        block = os.pread(fd, _BLOCK + _RECORD.size, start)  # the overlap finds a match that straddles two blocks
        for match in _CHUNK_START.finditer(block):
            at = start + match.start()
            head = os.pread(fd, _RECORD.size + _CHUNK.size, at)
            if len(head) >= _RECORD.size:
                end = at + _RECORD.size + _RECORD.unpack_from(head)[1]
                if end <= size and _is_chunk(fd, at, head, end):
                    return at
        start += _BLOCK
    return size


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


def read_payloads(fd: int, offset: int, length: int) -> list[bytes]:
    """Data of the messages of one chunk (or of a message outside chunks), once its checksum has been found right.

    Raises:
        LogError: damaged, beyond the limits of a chunk, or the disk fails; says not where.
    """
    try:
        record = os.pread(fd, length, offset)
        if record[0] == Opcode.MESSAGE:
            return [record[_RECORD.size + _MESSAGE_BYTES :]]
        if record[0] != Opcode.CHUNK:
            raise ValueError(f"no chunk starts here (opcode {record[0]})")
        data = _unpack_chunk(record)
        records = _inner_records(lambda at, count: data[at : at + count], 0, len(data))
        return [data[start + _MESSAGE_BYTES : end] for opcode, start, end in records if opcode == Opcode.MESSAGE]
    except OSError as error:
        raise LogError(f"cannot be read from disk: {error}") from error
    except (*_PARSE_ERRORS, zlib.error, zstandard.ZstdError) as error:
        raise LogError(f"damaged: {str(error) or type(error).__name__}") from error


def _unpack_chunk(record: bytes) -> bytes:
    """The records of a chunk.

    Raises:
        ValueError, RuntimeError, ZstdError: damaged, or larger than a chunk may be.
    """
    _, _, unpacked, crc, name_bytes = _CHUNK.unpack_from(record, _RECORD.size)
    at = _RECORD.size + _CHUNK.size
    name = record[at : at + name_bytes]
    data = record[at + name_bytes + 8 :]
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


def _inner_records(read: Callable[[int, int], bytes], at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, first byte and end of the body of each record of a chunk.

    Raises:
        ValueError, struct.error: these are no records, or more than a chunk may hold.
    """
    for _ in range(MAX_CHUNK_RECORDS):
        if at >= end:
            return
        opcode, length = _RECORD.unpack(read(at, _RECORD.size))
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if opcode == 0 or not length or (opcode == Opcode.MESSAGE and length < _MESSAGE_BYTES):
            raise ValueError(f"the chunk holds a record with opcode {opcode} and {length} bytes, which cannot be")
        if at > end:
            raise ValueError("a record is longer than its chunk")
        yield opcode, start, at
    raise ValueError(f"the chunk holds more than {MAX_CHUNK_RECORDS:,} records")


def payload_heads(fd: int, offset: int, length: int) -> list[bytes]:
    """The first bytes of each message of a chunk, without reading (and checking) all of it; [b""] where damaged."""
    head = os.pread(fd, _RECORD.size + _CHUNK.size, offset)
    try:
        if head[0] == Opcode.MESSAGE:
            start = offset + _RECORD.size + _MESSAGE_BYTES
            return [os.pread(fd, min(_HEAD_BYTES, offset + length - start), start)]
        if _CHUNK.unpack_from(head, _RECORD.size)[4]:  # compressed by another tool
            return [payload[:_HEAD_BYTES] for payload in read_payloads(fd, offset, length)]
        heads: list[bytes] = []
        first = offset + _RECORD.size + _CHUNK.size + 8
        for opcode, start, end in _inner_records(lambda at, n: os.pread(fd, n, at), first, offset + length):
            if opcode == Opcode.MESSAGE:
                start += _MESSAGE_BYTES
                heads.append(os.pread(fd, min(_HEAD_BYTES, end - start), start))
        return heads
    except (LogError, *_PARSE_ERRORS):
        return [b""]


def read_attachment(fd: int, offset: int, length: int) -> Attachment | None:
    """One attachment; None where its checksum is wrong, or it is larger than any of ours."""
    body = os.pread(fd, length, offset)[_RECORD.size :] if length <= MAX_ATTACHMENT_BYTES else b""
    if len(body) < 4 or zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        return None
    try:
        return Attachment.read(ReadDataStream(io.BytesIO(body)))
    except _PARSE_ERRORS:
        return None
