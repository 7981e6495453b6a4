"""Reading a log: what is damaged is reported and passed over, the rest is given."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from semantic_mapper.config import nearest_path
from semantic_mapper.errors import CodecError, ConfigError, EmptyMapError, LogError
from semantic_mapper.files import open_regular
from semantic_mapper.replay.log.mcap_scan import Place, Scan, last_time_ns, read_attachment, read_payloads, scan
from semantic_mapper.transport.codec import Envelope, decode_as, read_envelope, unpack_parts
from semantic_mapper.transport.messages import StreamInfo, parse_topic
from semantic_mapper.types import PosedFrame

INFO_ATTACHMENT = "stream_info"
PART_ATTACHMENT = "part.json"
Decoded = TypeVar("Decoded")
HEAD_BYTES = 128  # of a message, which tell its topic
MAX_INFOS = 1024  # messages that describe a stream; a recording has one a camera and restart


class LogAttachment(NamedTuple):
    """A file that is kept in a log: its name ("calibration.json"), its kind ("application/json"), and its bytes."""

    name: str
    media_type: str
    data: bytes


class Part(msgspec.Struct, frozen=True):
    """Which part of which recording a log is, as it says itself in an attachment."""

    recording: str  # the same in all parts of one recording
    part: int  # from 0

    def attachment(self) -> LogAttachment:
        """To keep in the log."""
        return LogAttachment(PART_ATTACHMENT, "application/json", msgspec.json.encode(self))


class _LogFile(NamedTuple):
    path: Path
    fd: int
    found: Scan
    attachments: dict[str, LogAttachment]
    part: Part | None


class _Entry(NamedTuple):
    """Where a message stands: the chunk's place in the file, and the message's place in the chunk."""

    name: str  # "frame 3"
    file: _LogFile
    chunk: Place
    position: int
    topic: str  # "" where the chunk is too damaged to tell

    @property
    def where(self) -> str:
        """For errors."""
        return f"{self.file.path}: {self.name} at byte {self.chunk.offset}"


class LogReader:
    """A log, or the parts of a recording read as one. Iterate it as often as you like, also from several threads.

    A message that is damaged or cannot be decoded becomes a ``LogError`` in ``errors`` (each once) and goes to
    ``on_error``; iteration goes on with the next. A message whose checksum is wrong is never used. Raises LogError: no
    such file, not an MCAP file, not a log of ours, or several that are not parts of one recording. EmptyMapError: no
    frame is in it.

    Args:
        paths: A file, which may be unfinished (its writer was killed) or cut off; or several parts, in any order.
        on_error: Called with each error as it is found.
        allow_empty: Open a log without frames too.

    Attributes:
        path, part: Of the first file; ``part`` is None where the log is whole by itself.
        paths: Of all files, in order.
        info: Cameras, label set, source.
        errors: Everything that had to be passed over so far.
        notices: Sentences for people ("the log was not closed ...").
        finished: False where the writer did not come to close a file.
    """

    def __init__(
        self,
        paths: Path | Sequence[Path],
        *,
        on_error: Callable[[LogError], None] = lambda error: None,
        allow_empty: bool = False,
    ) -> None:
        self.errors: list[LogError] = []
        self._on_error = on_error
        self._reported: set[str] = set()
        self._last_chunk: tuple[tuple[int, Place] | None, list[bytes] | LogError] = None, []
        self._entries: list[_Entry] = []
        self._frames: list[_Entry] = []
        with ExitStack() as stack:
            files = [self._open(path, stack) for path in ([paths] if isinstance(paths, Path) else paths)]
            self.notices = _sort_parts(files) if len(files) > 1 else []
            self.paths = [file.path for file in files]
            self.path, self.part = files[0].path, files[0].part
            self._attachments = files[0].attachments
            self.finished = all(file.found.finished for file in files)
            for file in files:
                self._add_entries(file)
            self.info = self._read_info(self._attachments.pop(INFO_ATTACHMENT, None))
            if not any(entry.topic for entry in self._frames) and not allow_empty:
                raise EmptyMapError(f"{self.path}: the log holds no frames; record or import it again")
            self._stack = stack.pop_all()

    def __len__(self) -> int:
        """Frames in the log, those included that turn out to be damaged when they are read."""
        return len(self._frames)

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order they were written."""
        for item in self.frames_or_errors(len(self)):
            if isinstance(item, PosedFrame):
                yield item
            else:
                self._report(item)

    def frames_or_errors(self, count: int) -> Iterator[PosedFrame | LogError]:
        """The first ``count`` frames in order; the error in place of one that is damaged."""
        for number in range(count):
            try:
                yield self.frame(number)
            except LogError as error:
                yield error

    def frame(self, number: int) -> PosedFrame:
        """Frame ``number`` of ``len(self)``. Raises LogError: it is damaged, or there is no such frame."""
        if not 0 <= number < len(self):
            raise LogError(f"{self.path}: no frame {number}; the log holds {len(self)}")
        return self._decoded(self._frames[number], partial(decode_as, PosedFrame))

    def frame_parts(self, from_stamp_ns: int = 0) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Frames as they travel: what is known without decoding images (pose included), and the wire bytes. Chunks
        that end before ``from_stamp_ns`` are not read."""
        if from_stamp_ns <= 0:
            return self._parts(self._frames)
        return self._parts(e for e in self._frames if last_time_ns(e.file.fd, e.chunk) >= from_stamp_ns)

    def messages(self) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Messages of all topics as they travel; each part begins with its stream information."""
        return self._parts(self._entries)

    def attachments(self) -> dict[str, LogAttachment]:
        """Files that are kept in the log, the first one of several, by name."""
        return self._attachments

    def close(self) -> None:
        """Close the files. Harmless when repeated."""
        self._stack.close()

    def __enter__(self) -> "LogReader":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _open(self, path: Path, stack: ExitStack) -> _LogFile:
        try:
            fd = stack.enter_context(open_regular(path)).fileno()
            found = scan(fd, str(path))
        except ConfigError as error:
            raise LogError(f"{path}: cannot be read: it is no regular file; copy its content to one") from error
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror or error}{nearest_path(path)}") from error
        kept: dict[str, LogAttachment] = {}
        for place in found.attachments:
            attachment = read_attachment(fd, place)
            if attachment is None:
                self._report(LogError(f"{path}: the attachment at byte {place.offset} is damaged; left out"))
            else:
                kept[attachment.name] = LogAttachment(attachment.name, attachment.media_type, attachment.data)
        try:
            part = msgspec.json.decode(kept[PART_ATTACHMENT].data, type=Part) if PART_ATTACHMENT in kept else None
        except msgspec.DecodeError as error:
            raise LogError(f"{path}: its attachment {PART_ATTACHMENT}: {error}") from error
        return _LogFile(path, fd, found, kept, part)

    def _add_entries(self, file: _LogFile) -> None:
        first, first_frame = len(self._entries), len(self._frames)
        for chunk in file.found.chunks:
            try:
                topics = [_topic_name(head) for head in read_payloads(file.fd, chunk, HEAD_BYTES)]
            except LogError:  # reported when its turn comes
                topics = []
            for position, topic in enumerate(topics if any(topics) else [""]):  # nothing of ours in it: reported once
                is_frame = topic in ("frame", "")
                name = f"frame {len(self._frames)}" if is_frame else f"message {len(self._entries)}"
                self._entries.append(_Entry(name, file, chunk, position, topic))
                if is_frame:
                    self._frames.append(self._entries[-1])
        messages, frames = len(self._entries) - first, len(self._frames) - first_frame
        if file.found.damaged_from is not None:
            offset, reason = file.found.damaged_from
            after = f"after message {messages - 1} (frame {frames - 1})"
            self._report(LogError(f"{file.path}: from byte {offset}, {after}: {reason}; what follows is passed over"))
        if not file.found.finished:
            self.notices.append(
                f"{file.path} was not closed by its writer; the {frames} frames that are whole are read. "
                "`semantic-mapper import` writes a clean copy"
            )

    def _read_info(self, attached: LogAttachment | None) -> StreamInfo:
        """What the stream is; of several cameras, each tells of itself when it begins."""
        infos: list[StreamInfo] = []
        if attached is not None:
            try:
                infos.append(decode_as(StreamInfo, unpack_parts(attached.data)))
            except CodecError as error:
                self._report(LogError(f"{self.path}: attachment {INFO_ATTACHMENT}: {error}"))
        for entry in islice((entry for entry in self._entries if entry.topic == "info"), MAX_INFOS):
            try:
                infos.append(self._decoded(entry, partial(decode_as, StreamInfo)))
            except LogError as error:
                self._report(error)
        if not infos:
            why = f" ({self.errors[0]})" if self.errors else ""
            raise LogError(
                f"{self.path}: says nothing of its cameras and classes{why}: not a log of semantic-mapper (`import` "
                "makes one of a ROS bag; of what `export` writes for Foxglove use the log it was made of), damaged, or "
                "cut off before its first frame"
            )
        cameras, sources = dict(infos[0].cameras), [infos[0].source]
        for info in infos:
            if not info.cameras.keys() <= cameras.keys():
                cameras |= info.cameras
                sources.append(info.source)
        if len(sources) == 1:
            return infos[0]
        return msgspec.structs.replace(infos[0], source=" + ".join(sources), cameras=cameras, frame_count=None)

    def _parts(self, entries: Iterable[_Entry]) -> Iterator[tuple[Envelope, list[bytes]]]:
        for entry in entries:
            try:
                yield self._decoded(entry, lambda parts: (read_envelope(parts), parts))
            except LogError as error:
                self._report(error)

    def _decoded(self, entry: _Entry, decode: Callable[[list[bytes]], Decoded]) -> Decoded:
        payloads = self._read_chunk(entry)
        if isinstance(payloads, LogError):
            raise LogError(f"{entry.where}: {payloads}") from payloads
        if entry.position >= len(payloads):
            raise LogError(f"{entry.where}: damaged: the chunk holds {len(payloads)} messages")
        try:
            return decode(unpack_parts(payloads[entry.position]))
        except CodecError as error:
            raise LogError(f"{entry.where}: {error}") from error

    def _read_chunk(self, entry: _Entry) -> list[bytes] | LogError:
        """Messages of a chunk, or why they are missing; the last chunk is kept for those that have several messages."""
        key, (kept, payloads) = (entry.file.fd, entry.chunk), self._last_chunk  # other threads may exchange it
        if kept != key:
            try:
                payloads = read_payloads(entry.file.fd, entry.chunk)
            except LogError as error:
                payloads = error
            self._last_chunk = key, payloads
        return payloads

    def _report(self, error: LogError) -> None:
        if str(error) not in self._reported:
            self._reported.add(str(error))
            self.errors.append(error)
            self._on_error(error)


def _sort_parts(files: list[_LogFile]) -> list[str]:
    """Bring the parts of one recording into their order; what is missing of it, for people."""
    recordings: dict[str, Path] = {}
    numbered: list[tuple[int, _LogFile]] = []
    for file in files:
        if file.part is None:
            raise LogError(f"{file.path}: was not recorded in parts, so it is a log by itself; read it alone")
        recordings.setdefault(file.part.recording, file.path)
        numbered.append((file.part.part, file))
    if len(recordings) > 1:
        names = ", ".join(map(str, recordings.values()))
        raise LogError(f"these are parts of different recordings: {names}; name the parts of one")
    numbered.sort(key=lambda pair: pair[0])
    files[:] = [file for _, file in numbered]
    first = numbered[0][0]
    notices = [f"{files[0].path} is part {first}: what was recorded before is not here"] if first else []
    for (a, one), (b, other) in pairwise(numbered):
        if a == b:
            raise LogError(f"{one.path} and {other.path} are the same part {a} of a recording; name one of them")
        if b > a + 1:
            notices.append(f"between {one.path} and {other.path}, {b - a - 1} parts of the recording are missing")
    return notices


def _topic_name(payload_head: bytes) -> str:
    """Name of the topic from the first bytes of a payload: fixarray, bin8, topic."""
    if len(payload_head) < 3 or payload_head[0] & 0xF0 != 0x90 or payload_head[1] != 0xC4:
        return ""
    try:
        topic, _ = parse_topic(payload_head[3 : 3 + payload_head[2]])
    except CodecError:
        return ""
    return topic.name
