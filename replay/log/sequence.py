"""A recording in parts, each a log by itself, read as one: ``kitchen.mcap``, ``kitchen-1.mcap``, ``kitchen-2.mcap``."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from types import TracebackType

import msgspec

from semantic_mapper.errors import LogError
from semantic_mapper.replay.log.reader import LogAttachment, LogReader
from semantic_mapper.transport.codec import Envelope
from semantic_mapper.types import PosedFrame

PART_ATTACHMENT = "part.json"
SUFFIX = ".mcap"
LISTED = 5  # files of a folder that an error names


class Part(msgspec.Struct, frozen=True):
    """Which part of which recording a log is, as it says itself in an attachment."""

    recording: str  # the same in all parts of one recording
    part: int  # from 0

    def attachment(self) -> LogAttachment:
        """To keep in the log."""
        return LogAttachment(PART_ATTACHMENT, "application/json", msgspec.json.encode(self))


class LogSequence:
    """The parts of one recording (in any order), open for reading; gives what ``LogReader`` gives of one.

    Raises LogError: a part cannot be opened, or they are no parts of one recording.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        *,
        on_error: Callable[[LogError], None] | None = None,
        allow_empty: bool = False,
    ) -> None:
        opened: list[tuple[int, LogReader]] = []
        try:
            recordings: dict[str, Path] = {}
            for path in paths:
                log = LogReader(path, on_error=on_error, allow_empty=True)
                part = read_part(log)
                opened.append((-1 if part is None else part.part, log))
                if part is None:
                    raise LogError(f"{path}: was not recorded in parts, so it is a log by itself; read it alone")
                recordings.setdefault(part.recording, path)
            if len(recordings) > 1:
                names = ", ".join(map(str, recordings.values()))
                raise LogError(f"these are parts of different recordings: {names}; name the parts of one")
            opened.sort(key=lambda entry: entry[0])
            self.logs = [log for _, log in opened]
            self.path, self.info = self.logs[0].path, self.logs[0].info
            self._notices = _missing_parts(opened)
            self._ends = list(accumulate(len(log) for log in self.logs))
            if not allow_empty and not len(self):
                raise LogError(f"{self.path} and the parts after it hold no frames")
        except LogError:
            for _, log in opened:
                log.close()
            raise

    @property
    def errors(self) -> list[LogError]:
        """Everything that had to be passed over so far."""
        return [error for log in self.logs for error in log.errors]

    @property
    def notices(self) -> list[str]:
        """Sentences for people."""
        return self._notices + [notice for log in self.logs for notice in log.notices]

    @property
    def finished(self) -> bool:
        """Whether the writer came to close all parts."""
        return all(log.finished for log in self.logs)

    def __len__(self) -> int:
        """Frames in all parts."""
        return self._ends[-1]

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order they were written."""
        for log in self.logs:
            yield from log

    def frames_or_errors(self, count: int) -> Iterator[PosedFrame | LogError]:
        """The first ``count`` frames in order; the error in place of one that is damaged."""
        for log in self.logs:
            here = min(count, len(log))
            yield from log.frames_or_errors(here)
            count -= here

    def frame(self, number: int) -> PosedFrame:
        """Frame ``number`` of ``len(self)``. Raises LogError: it is damaged, or there is no such frame."""
        if not 0 <= number < len(self):
            raise LogError(f"{self.path}: no frame {number}; its {len(self.logs)} parts hold {len(self)}")
        at = bisect_right(self._ends, number)
        return self.logs[at].frame(number - (self._ends[at] - len(self.logs[at])))

    def frame_parts(self) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Frames as they travel; see ``LogReader.frame_parts``."""
        for log in self.logs:
            yield from log.frame_parts()

    def messages(self) -> Iterator[tuple[Envelope, list[bytes]]]:
        """Messages of all topics as they travel; each part begins with its stream information."""
        for log in self.logs:
            yield from log.messages()

    def attachments(self) -> dict[str, LogAttachment]:
        """Files that are kept in the first part."""
        return self.logs[0].attachments()

    def close(self) -> None:
        """Close all parts. Harmless when repeated."""
        for log in self.logs:
            log.close()

    def __enter__(self) -> LogSequence:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


Log = LogReader | LogSequence


def open_log(
    paths: Path | str | Sequence[Path], *, on_error: Callable[[LogError], None] | None = None, allow_empty: bool = False
) -> Log:
    """Open a log, or the parts of a recording as one.

    Raises LogError: see ``LogReader`` and ``LogSequence``.

    Args:
        paths: A file (that log alone), several (the parts of one recording, in any order), or a folder: all logs in it.
        on_error: Called with each error as it is found.
        allow_empty: Open one without frames too.
    """
    named = [Path(paths)] if isinstance(paths, str | Path) else list(paths)
    files = [file for path in named for file in (logs_in(path) if path.is_dir() else [path])]
    if len(files) == 1:
        return LogReader(files[0], on_error=on_error, allow_empty=allow_empty)
    try:
        return LogSequence(files, on_error=on_error, allow_empty=allow_empty)
    except LogError as error:
        if len(named) > 1:
            raise
        names = ", ".join(file.name for file in files[:LISTED]) + (", ..." if len(files) > LISTED else "")
        raise LogError(
            f"{named[0]}: a folder is taken for the parts of one recording, which its logs are not: {error}. To read "
            f"one of them, name its file: {names}"
        ) from error


def logs_in(folder: Path) -> list[Path]:
    """The logs in a folder. Raises LogError: there is no log."""
    files = sorted(folder.glob(f"*{SUFFIX}"))
    if not files:
        raise LogError(f"{folder}: cannot be read as a recording: the folder holds no log (*{SUFFIX})")
    return files


def read_part(log: LogReader) -> Part | None:
    """Which part of a recording a log is; None where it is whole by itself.

    Raises LogError: it says so in a way that cannot be understood.
    """
    kept = log.attachments().get(PART_ATTACHMENT)
    if kept is None:
        return None
    try:
        return msgspec.json.decode(kept.data, type=Part)
    except msgspec.DecodeError as error:
        raise LogError(f"{log.path}: its attachment {PART_ATTACHMENT}: {error}") from error


def part_path(first: Path, part: int) -> Path:
    """Name of a part: that of the first one, with the number of any other."""
    return first if part == 0 else first.with_name(f"{first.stem}-{part}{first.suffix}")


def parts_on_disk(first: Path) -> dict[int, Path]:
    """Files that are named like the parts of a recording, by number."""
    found = {0: first} if first.exists() else {}
    name = re.compile(re.escape(first.stem) + r"-([1-9]\d*)" + re.escape(first.suffix))
    for file in first.parent.glob(f"*{first.suffix}"):
        if match := name.fullmatch(file.name):
            found[int(match[1])] = file
    return dict(sorted(found.items()))


def _missing_parts(opened: Sequence[tuple[int, LogReader]]) -> list[str]:
    """What is missing of a recording, for people."""
    notices: list[str] = []
    first, log = opened[0]
    if first:
        notices.append(f"{log.path} is part {first}: what was recorded before is not here")
    for (a, one), (b, other) in pairwise(opened):
        if a == b:
            raise LogError(f"{one.path} and {other.path} are the same part {a} of a recording; name one of them")
        if b > a + 1:
            notices.append(f"between {one.path} and {other.path}, {b - a - 1} parts of the recording are missing")
    return notices
