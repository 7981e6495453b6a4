"""The log: an MCAP file whose messages are the very bytes that travel between processes.

One message a chunk, not compressed (images already are), each chunk with its checksum and flushed at once: a killed
writer loses at most the message it was writing, and a damaged byte spoils one message. A full disk costs the message
that does not fit: the file ends with the one before. What the stream is (cameras, label set) stands twice: as an
attachment, and as the first message.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple, cast

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import CompressionType, Writer

from semantic_mapper.errors import LogError
from semantic_mapper.files import atomic_path, open_unlinked
from semantic_mapper.replay.log.mcap_scan import MAGIC
from semantic_mapper.replay.log.reader import INFO_ATTACHMENT, LogAttachment, LogReader
from semantic_mapper.transport.codec import EncodedImage, encode, encode_frame, header_type, pack_parts, read_envelope
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import Parts, StreamInfo
from semantic_mapper.types import PosedFrame


class AtomicFile:
    """A new file, open for writing. ``write`` collects in memory, ``commit`` brings all of it to the file or nothing.

    Raises OSError: it exists and may not be replaced, or cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        if overwrite and path.is_symlink():
            path.unlink()  # replaced, never written through
        self.fd = open_unlinked(path, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL))
        self._pending = bytearray()
        self.size = 0  # of what was committed, bytes

    def write(self, data: bytes) -> int:
        """Collect; never fails."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Where the next byte will be once all is committed."""
        return self.size + len(self._pending)

    def commit(self) -> None:
        """Bring what was collected to the file.

        Raises OSError: not all of it could be written; the file is as it was, and what was collected is dropped.
        """
        data, self._pending = memoryview(self._pending), bytearray()
        written = 0
        try:
            while written < len(data):
                written += os.write(self.fd, data[written:])
        except OSError:
            with contextlib.suppress(OSError):  # a device; else a cut record at the end, which readers pass over
                os.ftruncate(self.fd, self.size)
                os.lseek(self.fd, self.size, os.SEEK_SET)
            raise
        self.size += written


PROFILE = "semantic-mapper"
_DEFAULTS = CodecOptions()


class LogWriter:
    """Writes a log. A context manager; not for several threads at once. ``options`` are those of ``write_frame``,
    lossless by default; errors call the file ``named``, where it has another name until it is whole.

    Raises LogError: the file exists, or cannot be written; then no file is left.
    """

    def __init__(
        self,
        path: Path,
        info: StreamInfo,
        *,
        options: CodecOptions = _DEFAULTS,
        overwrite: bool = False,
        attachments: Sequence[LogAttachment] = (),
        named: Path | None = None,
    ) -> None:
        self.path = path
        self.frames = 0
        self.messages = 0
        self._named = named or path
        self._options = options
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._last_stamp_ns = 0
        self._failed = self._closed = False
        parts = encode(info)  # before the file is made: what cannot be packed leaves none behind
        with self._explained():
            self._file = AtomicFile(path, overwrite=overwrite)
        # A chunk is closed once it is longer than chunk_size, that is after each message.
        self._writer = Writer(cast(IO[bytes], self._file), chunk_size=1, compression=CompressionType.NONE)
        try:
            self._writer.start(profile=PROFILE)
            self._writer.add_attachment(0, 0, INFO_ATTACHMENT, "application/msgpack", pack_parts(parts))
            for attachment in attachments:
                self.attach(attachment)
            self.write_parts(parts)
        except LogError:
            os.close(self._file.fd)
            if path.is_file():
                path.unlink()
            raise

    @property
    def bytes_written(self) -> int:
        """Size of the file so far."""
        return self._file.size

    def attach(self, attachment: LogAttachment) -> None:
        """Keep a file in the log, from the next message on; of several of one name readers give the last."""
        self._writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)

    def flush(self) -> None:
        """Bring to the file what no message has followed.

        Raises LogError: the disk is full or gone; the log is as it was, and takes nothing more.
        """
        with self._explained():
            self._file.commit()

    def write_frame(self, frame: PosedFrame, *, encoded_rgb: EncodedImage | None = None) -> None:
        """Append one frame; ``encoded_rgb`` is a PNG or JPEG file that decodes to its ``rgb``, kept as it is.

        Raises CodecError: the frame cannot be packed; the log is as it was. LogError: the disk is full or gone.
        """
        self.write_parts(encode_frame(frame, self._options, encoded_rgb=encoded_rgb))

    def write_parts(self, parts: Parts) -> None:
        """Append one encoded message of any topic, as it came over the wire.

        Raises CodecError: not a message of ours; the log is as it was. LogError: the disk is full or gone; the log is
        as it was, and takes nothing more.
        """
        if self._failed:
            raise LogError(f"{self._named}: takes nothing more since a message could not be written")
        envelope = read_envelope(parts)
        stamp = envelope.stamp_ns or self._last_stamp_ns
        self._writer.add_message(
            channel_id=self._channel(envelope.topic, envelope.source),
            log_time=stamp,
            publish_time=stamp,
            sequence=envelope.seq & 0xFFFFFFFF,
            data=pack_parts(parts),
        )
        self.flush()
        self._last_stamp_ns = stamp
        self.messages += 1
        self.frames += envelope.topic == "frame"

    def close(self) -> None:
        """Write the index and close the file. Harmless when repeated.

        Where there is no room for the index, the log ends without one: it is whole, and slower to search. Raises
        LogError: the disk is full to the last byte, or gone; what was written can be read.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failed:
                self._writer.finish()
                with contextlib.suppress(LogError):  # no room for the index
                    self.flush()
            with self._explained():
                if self._failed:
                    self._file.write(_short_end())
                    self._file.commit()
                os.fsync(self._file.fd)
        finally:
            os.close(self._file.fd)

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _channel(self, topic: str, source: str) -> int:
        name = f"{topic}/{source}"
        if name not in self._channels:
            if topic not in self._schemas:
                kind = header_type(topic)
                self._schemas[topic] = self._writer.register_schema(
                    f"semantic_mapper.{kind.__name__}", "jsonschema", _schema(kind)
                )
            self._channels[name] = self._writer.register_channel(name, "msgpack", self._schemas[topic])
        return self._channels[name]

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except FileExistsError as error:
            raise LogError(f"{self._named}: exists already; remove it or choose another name") from error
        except OSError as error:
            self._failed = True  # the index in memory tells of what is not in the file
            raise LogError(f"{self._named}: cannot be written: {error.strerror or error}") from error


def _short_end() -> bytes:
    """The end of an MCAP file without index: 50 bytes."""
    builder = RecordBuilder()
    DataEnd(0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return builder.end() + MAGIC


def _schema(kind: type[msgspec.Struct]) -> bytes:
    described = msgspec.json.schema(kind)
    described["description"] = (
        "The payload is a msgpack array of binaries: [topic, header, buffers...]. The header is msgpack in turn and "
        "follows this schema; each of its 'encoding' fields says how the buffer is packed."
    )
    return json.dumps(described).encode()


@contextmanager
def atomic_log(
    path: Path,
    info: StreamInfo,
    *,
    options: CodecOptions = _DEFAULTS,
    attachments: Sequence[LogAttachment] = (),
    overwrite: bool = False,
) -> Iterator[LogWriter]:
    """A writer of the log ``path``, which gets its name as the last thing; after an error no log is left.

    A log that may be replaced stays until then. Raises LogError: ``path`` is there already, or cannot be written.
    """
    if path.exists() and not overwrite:
        raise LogError(f"{path}: exists already; remove it or choose another name")
    with (
        atomic_path(path, raises=LogError) as unfinished,
        LogWriter(unfinished, info, options=options, attachments=attachments, overwrite=True, named=path) as writer,
    ):
        yield writer


class RecoverReport(NamedTuple):
    """Frames and messages of the new log; why each of the others could not be saved; and whether the old log had been
    closed by its writer."""

    frames: int
    messages: int
    lost: tuple[LogError, ...]
    finished: bool


def recover(src: Path, dst: Path) -> RecoverReport:
    """Write every intact message of ``src`` to the new log ``dst``; ``src`` is not touched.

    Raises LogError: ``src`` gives no frame at all, or ``dst`` exists or cannot be written; then there is no ``dst``.
    """
    with (
        LogReader(src) as reader,
        atomic_log(dst, reader.info, attachments=tuple(reader.attachments().values())) as writer,
    ):
        for envelope, parts in reader.messages():
            if envelope.topic != "info":  # the writer has put it there already
                writer.write_parts(parts)
        frames, messages = writer.frames, writer.messages
        if frames == 0:
            raise LogError(f"{src}: none of its {len(reader)} frames can be read: {reader.errors[0]}")
        return RecoverReport(frames, messages, tuple(reader.errors), reader.finished)
