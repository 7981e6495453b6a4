"""Finds the messages of an MCAP file: by its index, or, where the writer did not come to write one, record by record.

An index whose checksum is right names every chunk, whatever is damaged before it. Without an index, reading ends at the
first record whose head is damaged. Each chunk's own checksum tells whether its messages can be believed.
"""

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Chunk, ChunkIndex
from mcap.stream_reader import StreamReader

from semantic_mapper.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, crc of the summary
_CHUNK_TIMES = struct.Struct("<BQQQ")  # opcode, length, first and last time
_PLAIN_CHUNK_BYTES = 40  # before the records of a chunk that is not compressed
_NAME_AT = 37  # length of the compression's name in a chunk
_MESSAGE_BYTES = 22  # channel, sequence and two times, before a message's data
MAX_CHUNK_BYTES = 1 << 29
MAX_UNPACKED_BYTES = 1 << 27  # of a compressed chunk; tools make chunks of 4 MiB, or of one message
MAX_CHUNK_RECORDS = 1 << 16
MAX_ATTACHMENT_BYTES = 1 << 28
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_PARSE_ERRORS = (McapError, struct.error, ValueError, OverflowError, EOFError, RuntimeError, MemoryError, IndexError)


class Place(NamedTuple):
    """Where a record stands in a file."""

    offset: int
    length: int


class Scan(NamedTuple):
    """Where the messages of a file are."""

    chunks: list[Place]  # or messages that stand outside chunks
    attachments: list[Place]
    finished: bool  # whether the file was closed by its writer; False after a crash
    damaged_from: tuple[int, str] | None = None  # from where on nothing can be read, and why; None where all can


def scan(fd: int, where: str) -> Scan:
    """Find the messages of a file that is open for reading; its position is not used.

    Raises LogError: not an MCAP file; names it ``where``.
    """
    size = os.fstat(fd).st_size
    start = os.pread(fd, len(MAGIC), 0)
    if sum(x == y for x, y in zip(start, MAGIC, strict=False)) < len(MAGIC) - 1:  # one damaged byte is no reason
        raise LogError(
            f"{where}: not an MCAP log ({'it does not start like one' if start else 'it is empty'}); make one with "
            "`semantic-mapper import` or by `semantic-mapper up replay --set recorder.enabled=true`"
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
    try:
        records = list(StreamReader(io.BytesIO(data + tail), skip_magic=True).records)
    except _PARSE_ERRORS:
        return None
    chunks = sorted(Place(r.chunk_start_offset, r.chunk_length) for r in records if isinstance(r, ChunkIndex))
    attachments = sorted(Place(r.offset, r.length) for r in records if isinstance(r, AttachmentIndex))
    for places in (chunks, attachments):
        bounds = [(0, len(MAGIC)), *places, (summary, 0)]
        if any(a + length > b for (a, length), (b, _) in pairwise(bounds)):
            return None
    return Scan(chunks, attachments, finished=True) if chunks else None  # messages outside chunks are in no index


def _walk(fd: int, size: int) -> Scan:
    """Record by record, up to one that cannot be."""
    chunks, attachments, at = list[Place](), list[Place](), len(MAGIC)
    while at < size:
        head = os.pread(fd, _RECORD.size, at)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (int(Opcode.CHUNK), size)
        place = Place(at, _RECORD.size + length)
        at += place.length
        if at > size:
            cut = "the file ends in the middle of a record, or the record's length is damaged"
            return Scan(chunks, attachments, finished=False, damaged_from=(place.offset, cut))
        if opcode not in _OPCODES:
            strange = f"no record starts here (opcode {opcode})"
            return Scan(chunks, attachments, finished=False, damaged_from=(place.offset, strange))
        if opcode == Opcode.FOOTER:
            return Scan(chunks, attachments, finished=True)
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            chunks.append(place)
        elif opcode == Opcode.ATTACHMENT:
            attachments.append(place)
    return Scan(chunks, attachments, finished=False)


def last_time_ns(fd: int, place: Place) -> int:
    """Latest time of the messages of a chunk, as its head says; of anything else one that no message has."""
    with contextlib.suppress(OSError, struct.error):  # reading the chunk says what is wrong
        opcode, _, _, last = _CHUNK_TIMES.unpack(os.pread(fd, _CHUNK_TIMES.size, place.offset))
        if opcode == Opcode.CHUNK:
            return last
    return 1 << 64


def read_payloads(fd: int, place: Place, most: int | None = None) -> list[bytes]:
    """Data of the messages of one chunk, or of a message outside chunks; with ``most`` only so many bytes of each, and
    the chunk's checksum is not checked.

    Raises LogError: damaged, beyond the limits of a chunk, or the disk fails; says not where.
    """
    start, size = place
    try:
        head = os.pread(fd, _RECORD.size + _PLAIN_CHUNK_BYTES, start)
        if head[0] not in (Opcode.CHUNK, Opcode.MESSAGE) or size > MAX_CHUNK_BYTES:
            raise ValueError(f"no chunk of a recording starts here (opcode {head[0]}, {size:,} bytes)")
        if head[0] == Opcode.CHUNK:
            (name_bytes,) = struct.unpack_from("<I", head, _NAME_AT)
            if most is None or name_bytes:
                data = _unpack_chunk(os.pread(fd, size - _RECORD.size, start + _RECORD.size))
                return list(_messages(lambda at, count: data[at : at + count], len(data), most))
            start, size = start + len(head), size - len(head)
        return list(_messages(lambda at, count: os.pread(fd, count, start + at), size, most))
    except OSError as error:
        raise LogError(f"cannot be read from disk: {error}") from error
    except (*_PARSE_ERRORS, zlib.error, zstandard.ZstdError) as error:
        raise LogError(f"damaged: {str(error) or type(error).__name__}") from error


def _unpack_chunk(body: bytes) -> bytes:
    chunk = Chunk.read(ReadDataStream(io.BytesIO(body)))
    data, unpacked = chunk.data, chunk.uncompressed_size
    if chunk.compression and unpacked > MAX_UNPACKED_BYTES:
        raise ValueError(f"a chunk unpacks to {unpacked:,} bytes; allowed are {MAX_UNPACKED_BYTES >> 20} MiB")
    if chunk.compression == "zstd":
        # The decompressor allocates what the data declare; -1 where they do not, then it is the chunk that bounds it.
        if zstandard.frame_content_size(data) not in (unpacked, -1):
            raise ValueError("compressed data declare another size than the chunk")
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=unpacked)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=unpacked + 1)
    elif chunk.compression:
        raise ValueError(f"compressed with {chunk.compression!r}, which is not known")
    if len(data) != unpacked:
        raise ValueError("the chunk holds another size than it declares")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum (crc) of the chunk is wrong")
    return data


def _messages(read: Callable[[int, int], bytes], size: int, most: int | None) -> Iterator[bytes]:
    """Data, at ``most`` so much of it, of each message in the records of a chunk."""
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
            yield read(start, at - start if most is None else min(at - start, most))
    raise ValueError(f"the chunk holds more than {MAX_CHUNK_RECORDS:,} records")


def read_attachment(fd: int, place: Place) -> Attachment | None:
    """One attachment; None where its checksum is wrong, or it is larger than any of ours."""
    body = os.pread(fd, place.length, place.offset)[_RECORD.size :] if place.length <= MAX_ATTACHMENT_BYTES else b""
    if len(body) < 4 or zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        return None
    try:
        return Attachment.read(ReadDataStream(io.BytesIO(body)))
    except _PARSE_ERRORS:
        return None
