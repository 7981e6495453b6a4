"""Finds the messages of an MCAP file: by its index, or, where the writer did not come to write one, record by record.

An index whose checksum is right names every chunk, whatever is damaged before it. Without an index, reading ends at the
first record whose head is damaged. Each chunk's own checksum tells whether its messages can be believed.
"""

from __future__ import annotations

import io
import os
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
MAX_CHUNK_BYTES = 1 << 29
MAX_UNPACKED_BYTES = 1 << 27  # of a compressed chunk; tools make chunks of 4 MiB, or of one message
MAX_CHUNK_RECORDS = 1 << 16
MAX_ATTACHMENT_BYTES = 1 << 28
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, EOFError, RuntimeError, MemoryError, IndexError)
_KINDS = {
    b"PK": "a ZIP file, as saved maps are",
    b"#ROSBAG": "a ROS 1 bag",
    b"SQLite": "a SQLite file, as ROS 2 bags are",
}


@dataclass(slots=True)
class Scan:
    """Where the messages of a file are."""

    # (offset, length) of each chunk record, or of a message that stands outside chunks
    chunks: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    # (offset, length) of each attachment record
    attachments: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    damaged_from: tuple[int, str] | None = None  # from where on nothing can be read, and why; None where all can
    finished: bool = False  # whether the file was closed by its writer; False after a crash


def scan(fd: int, where: str) -> Scan:
    """Find the messages of a file that is open for reading; its position is not used.

    Raises LogError: not an MCAP file.

    Args:
        fd: Of the file.
        where: Names the file in errors.
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
    return _read_index(fd, size) or _walk(fd, size)


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


def _walk(fd: int, size: int) -> Scan:
    """Record by record, up to one that cannot be."""
    found, at = Scan(), len(MAGIC)
    while at < size and not found.finished:
        head = os.pread(fd, _RECORD.size, at)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (int(Opcode.CHUNK), size)
        end = at + _RECORD.size + length
        if opcode not in _OPCODES or end > size:
            strange = f"no record starts here (opcode {opcode})"
            cut = "the file ends in the middle of a record, or the record's length is damaged"
            found.damaged_from = at, cut if end > size else strange
            break
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            found.chunks.append((at, end - at))
        elif opcode == Opcode.ATTACHMENT:
            found.attachments.append((at, end - at))
        found.finished = opcode == Opcode.FOOTER
        at = end
    return found


def read_payloads(fd: int, offset: int, length: int, most: int | None = None) -> list[bytes]:
    """Data of the messages of one chunk, or of a message outside chunks.

    Raises LogError: damaged, beyond the limits of a chunk, or the disk fails; says not where.

    Args:
        fd: Of the file.
        offset, length: Of the record.
        most: Only so many bytes of each message, without checking the chunk's checksum; None = all.
    """
    try:
        head = os.pread(fd, _RECORD.size + _CHUNK.size, offset)
        start = offset + _RECORD.size
        if head[0] == Opcode.MESSAGE:
            size = length - _RECORD.size - _MESSAGE_BYTES
            return [os.pread(fd, size if most is None else min(size, most), start + _MESSAGE_BYTES)]
        if head[0] != Opcode.CHUNK or length > MAX_CHUNK_BYTES:
            raise ValueError(f"no chunk of a recording starts here (opcode {head[0]}, {length:,} bytes)")
        is_plain = _CHUNK.unpack_from(head, _RECORD.size)[4] == 0
        if most is None or not is_plain:
            data = _unpack_chunk(os.pread(fd, length, offset))
            return [data[a:b] for a, b in _messages(lambda at, count: data[at : at + count], len(data), most)]
        start += _CHUNK.size + 8
        places = _messages(lambda at, count: os.pread(fd, count, start + at), offset + length - start, most)
        return [os.pread(fd, b - a, start + a) for a, b in places]
    except OSError as error:
        raise LogError(f"cannot be read from disk: {error}") from error
    except (*_PARSE_ERRORS, zlib.error, zstandard.ZstdError) as error:
        raise LogError(f"damaged: {str(error) or type(error).__name__}") from error


def _unpack_chunk(record: bytes) -> bytes:
    """The records of a chunk."""
    _, _, unpacked, crc, name_bytes = _CHUNK.unpack_from(record, _RECORD.size)
    at = _RECORD.size + _CHUNK.size
    name = record[at : at + name_bytes]
    data = record[at + name_bytes + 8 :]
    if name and unpacked > MAX_UNPACKED_BYTES:
        raise ValueError(f"a chunk unpacks to {unpacked:,} bytes; allowed are {MAX_UNPACKED_BYTES >> 20} MiB")
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


def _messages(read: Callable[[int, int], bytes], size: int, most: int | None) -> Iterator[tuple[int, int]]:
    """First byte and end of the data, at ``most`` so much of it, of each message in the records of a chunk."""
    at = 0
    for _ in range(MAX_CHUNK_RECORDS):
        if at >= size:
            return
        opcode, length = _RECORD.unpack(read(at, _RECORD.size))
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if opcode == 0 or not length or (opcode == Opcode.MESSAGE and length < _MESSAGE_BYTES):
            raise ValueError(f"the chunk holds a record with opcode {opcode} and {length} bytes, which cannot be")
        if at > size:
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            start += _MESSAGE_BYTES
            yield start, at if most is None else min(at, start + most)
    raise ValueError(f"the chunk holds more than {MAX_CHUNK_RECORDS:,} records")


def read_attachment(fd: int, offset: int, length: int) -> Attachment | None:
    """One attachment; None where its checksum is wrong, or it is larger than any of ours."""
    body = os.pread(fd, length, offset)[_RECORD.size :] if length <= MAX_ATTACHMENT_BYTES else b""
    if len(body) < 4 or zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        return None
    try:
        return Attachment.read(ReadDataStream(io.BytesIO(body)))
    except _PARSE_ERRORS:
        return None
