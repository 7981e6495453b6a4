"""Reading a log: what is damaged is reported and passed over, the rest is given."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import msgspec

from semantic_mapper.errors import CodecError, ConfigError, LogError
from semantic_mapper.files import open_regular
from semantic_mapper.replay.log.mcap_scan import Scan, read_attachment, read_payloads, scan
from semantic_mapper.transport.codec import Envelope, decode_as, read_envelope, unpack_parts
from semantic_mapper.transport.messages import StreamInfo, parse_topic
from semantic_mapper.types import PosedFrame

INFO_ATTACHMENT = "stream_info"
HEAD_BYTES = 128  # of a message, which tell its topic
MAX_INFOS = 1024  # messages that describe a stream; a recording has one a camera and restart


class LogAttachment(NamedTuple):
    """A file that is kept in a log: its name ("calibration.json"), its kind ("application/json"), and its bytes."""

    name: str
    media_type: str
    data: bytes


class _Entry(NamedTuple):
    """Where a message stands: the chunk's place in the file, and the message's place in the chunk."""

    number: int
    offset: int
    length: int
    position: int
    topic: str  # "" where the chunk is too damaged to tell


class LogReader:
    """A recorded log, open for reading. Iterate it as often as you like, also from several threads.

    A message that is damaged or cannot be decoded becomes a ``LogError`` in ``errors`` (each once) and goes to
    ``on_error``; iteration goes on with the next. A message whose checksum is wrong is never used. Raises LogError: no
    such file, not an MCAP file, not a log of ours, or no frame in it.

    Args:
        path: Of the file; may be unfinished (its writer was killed) or cut off.
        on_error: Called with each error as it is found.
        allow_empty: Open a log without frames too.

    Attributes:
        info: Cameras, label set, source.
        errors: Everything that had to be passed over so far.
        notices: Sentences for people ("the log was not closed ...").
        finished: False where the writer did not come to close the file.
    """

    def __init__(
        self, path: Path, *, on_error: Callable[[LogError], None] | None = None, allow_empty: bool = False
    ) -> None:
        self.path = path
        self.errors: list[LogError] = []
        self.notices: list[str] = []
        self._on_error = on_error
        self._reported: set[str] = set()
        self._last_chunk: tuple[int, list[bytes] | str] = -1, ""
        try:
            self._file = open_regular(path)
        except ConfigError as error:
            raise LogError(f"{path}: cannot be read: it is no regular file; copy its content to one") from error
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
        try:
            found = scan(self._file.fileno(), str(path))
            self._frames: list[int] = []
            self._index = self._make_index(found)
            self._frames = [i for i, entry in enumerate(self._index) if entry.topic in ("frame", "")]
            self._attachments = found.attachments
            self.finished = found.finished
            self.info = self._read_info(found)
            self._report_damages(found)
            if not any(entry.topic == "frame" for entry in self._index) and not allow_empty:
                raise LogError(f"{path}: the log holds no frames; record or import it again")
        except LogError:
            self._file.close()
            raise
        except OSError as error:  # of a failing disk, or of a device
            self._file.close()
            raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error

    def __len__(self) -> int:
        """Frames in the log, those included that turn out to be damaged when they are read."""
        return len(self._frames)

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order they were written."""
        for number in range(len(self._frames)):
            try:
                yield self.frame(number)
            except LogError as error:
                self._report(error)

    def frames_or_errors(self, count: int) -> Iterator[PosedFrame | LogError]:
        """The first ``count`` frames in order; the error in place of one that is damaged."""
        for number in range(count):
            try:
                yield self.frame(number)
            except LogError as error:
                yield error

    def frame(self, number: int) -> PosedFrame:
        """Frame ``number`` of ``len(self)``. Raises LogError: it is damaged, or there is no such frame."""
        if not 0 <= number < len(self._frames):
            raise LogError(f"{self.path}: no frame {number}; the log holds {len(self._frames)}")
        entry = self._index[self._frames[number]]
        try:
            return decode_as(PosedFrame, self._read(entry))
        except CodecError as error:
            raise LogError(f"{self._where(entry)}: {error}") from error

    def frame_parts(self) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Frames as they travel: what is known without decoding images (pose included), and the wire bytes."""
        return self._parts([self._index[i] for i in self._frames])

    def messages(self) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Messages of all topics as they travel."""
        return self._parts(self._index)

    def attachments(self) -> dict[str, LogAttachment]:
        """Files that are kept in the log, by name; one whose checksum is wrong is reported and left out."""
        kept: dict[str, LogAttachment] = {}
        for offset, length in self._attachments:
            found = read_attachment(self._file.fileno(), offset, length)
            if found is None:
                self._report(LogError(f"{self.path}: the attachment at byte {offset} is damaged; left out"))
            elif found.name != INFO_ATTACHMENT:
                kept[found.name] = LogAttachment(found.name, found.media_type, found.data)
        return kept

    def close(self) -> None:
        """Close the file. Harmless when repeated."""
        self._file.close()

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _make_index(self, found: Scan) -> list[_Entry]:
        entries: list[_Entry] = []
        for offset, length in found.chunks:
            try:
                heads = read_payloads(self._file.fileno(), offset, length, HEAD_BYTES)
            except LogError:  # reported when its turn comes
                heads = []
            topics = [_topic_name(head) for head in heads]
            if not any(topics):
                topics = [""]  # nothing of ours in it: reported once
            entries += [
                _Entry(len(entries) + position, offset, length, position, topic)
                for position, topic in enumerate(topics)
            ]
        return entries

    def _read_info(self, found: Scan) -> StreamInfo:
        """What the stream is; of several cameras, each tells of itself when it begins."""
        first = self._info_attached(found)
        cameras, sources = ({}, []) if first is None else (dict(first.cameras), [first.source])
        for entry in islice((entry for entry in self._index if entry.topic == "info"), MAX_INFOS):
            try:
                info = decode_as(StreamInfo, self._read(entry))
            except (LogError, CodecError) as error:
                if first is None:  # else reported when its turn comes
                    self._report(LogError(f"{self._where(entry)}: {error}"))
                continue
            first = first or info
            if not sources or not set(info.cameras) <= set(cameras):
                cameras |= info.cameras
                sources.append(info.source)
        if first is not None:
            if len(sources) == 1:
                return first
            return msgspec.structs.replace(first, source=" + ".join(sources), cameras=cameras, frame_count=None)
        if self.errors:
            raise LogError(
                f"{self.path}: its stream information (cameras and classes) cannot be used: {self.errors[0]}; record "
                "or import it again"
            )
        raise LogError(
            f"{self.path}: says nothing of its cameras and classes: not a log of semantic-mapper (what `export` writes "
            f"for Foxglove is not one either: use the log it was made of), or cut off before its first frame"
        )

    def _info_attached(self, found: Scan) -> StreamInfo | None:
        for offset, length in found.attachments:
            attachment = read_attachment(self._file.fileno(), offset, length)
            if attachment is not None and attachment.name == INFO_ATTACHMENT:
                try:
                    return decode_as(StreamInfo, unpack_parts(attachment.data))
                except CodecError as error:
                    self._report(LogError(f"{self.path}: stream information at byte {offset}: {error}"))
        return None

    def _report_damages(self, found: Scan) -> None:
        if found.damaged_from is not None:
            offset, reason = found.damaged_from
            after = f"after message {len(self._index) - 1} (frame {len(self._frames) - 1})"
            self._report(LogError(f"{self.path}: from byte {offset}, {after}: {reason}; what follows is passed over"))
        if not found.finished:
            self.notices.append(
                f"{self.path} was not closed by its writer; the {len(self._frames)} frames that are whole are read. "
                "`semantic-mapper import` writes a clean copy"
            )

    def _parts(self, entries: list[_Entry]) -> Iterator[tuple[Envelope, list[bytes]]]:
        for entry in entries:
            try:
                parts = self._read(entry)
                envelope = read_envelope(parts)
            except LogError as error:
                self._report(error)
            except CodecError as error:
                self._report(LogError(f"{self._where(entry)}: {error}"))
            else:
                yield envelope, parts

    def _read(self, entry: _Entry) -> list[bytes]:
        if self._file.closed:
            raise LogError(f"{self.path}: the log is closed")
        payloads = self._read_chunk(entry)
        if isinstance(payloads, str):
            raise LogError(f"{self._where(entry)}: {payloads}")
        if entry.position >= len(payloads):
            raise LogError(f"{self._where(entry)}: damaged: the chunk holds {len(payloads)} messages")
        return unpack_parts(payloads[entry.position])

    def _read_chunk(self, entry: _Entry) -> list[bytes] | str:
        """Messages of a chunk, or why they are missing; the last chunk is kept for those that have several messages."""
        offset, payloads = self._last_chunk  # one read and one write: other threads may exchange it
        if offset != entry.offset:
            try:
                payloads = read_payloads(self._file.fileno(), entry.offset, entry.length)
            except LogError as error:
                payloads = str(error)
            self._last_chunk = entry.offset, payloads
        return payloads

    def _where(self, entry: _Entry) -> str:
        at = bisect_left(self._frames, entry.number)
        is_frame = at < len(self._frames) and self._frames[at] == entry.number
        name = f"frame {at}" if is_frame else f"message {entry.number}"
        return f"{self.path}: {name} at byte {entry.offset}"

    def _report(self, error: LogError) -> None:
        if str(error) in self._reported:
            return
        self._reported.add(str(error))
        self.errors.append(error)
        if self._on_error is not None:
            self._on_error(error)


def _topic_name(payload_head: bytes) -> str:
    """Name of the topic from the first bytes of a payload: fixarray, bin8, topic."""
    if len(payload_head) < 3 or payload_head[0] & 0xF0 != 0x90 or payload_head[1] != 0xC4:
        return ""
    try:
        topic, _ = parse_topic(payload_head[3 : 3 + payload_head[2]])
    except CodecError:
        return ""
    return topic.name
