"""A recording: one log or several parts, written so that a full disk costs what does not fit and nothing else."""

import errno
import shutil
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semantic_mapper.errors import LogError
from semantic_mapper.log_events import get_logger
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.replay.log.reader import LogAttachment, LogReader, Part
from semantic_mapper.replay.log.sequence import part_path, parts_on_disk
from semantic_mapper.transport.messages import Parts, StreamInfo

DiskFull = Literal["stop", "delete-oldest"]
RETRY_S = 1.0  # how often a recording that pauses looks for room
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class RecordingRules:
    """How a recording is split, and what happens where the disk is full."""

    # messages of a part take at most so much (one that is larger has a part of its own), its index some kilobytes more;
    # 0 = any size
    split_bytes: int = 0
    split_s: float = 0.0  # a part covers at most this many seconds of recording; 0 = any time
    # "stop": what is recorded stays, and recording ends. "delete-oldest": the oldest parts of this recording are
    # deleted, never the one that is being written; where none is left, recording pauses until there is room.
    disk_full: DiskFull = "stop"
    reserve_bytes: int = 0  # so much of the disk is left free for others


class Recording:
    """Writes messages to the parts of a recording.

    Raises LogError: something is there already, or the first part cannot be written.

    Args:
        path: Of the first part; the folder has to be there.
        info: What the stream is; stands in each part, as ``attachments`` do.
        rules: See ``RecordingRules``.
        recording: Name of the recording, the same for all that is part of it.
        overwrite: Replace a recording that is there, its numbered parts included.
        goes_on: A recording was interrupted: go on in the part after the last one that is there. Of the parts that are
            there, those of the same ``recording`` may be deleted.

    Attributes:
        messages, frames: Written, in all parts.
        lost: Messages that were not written, for want of room.
        deleted: Parts.
        ended: Nothing will be written any more.
        gone: A part's file was removed by somebody else while it was written.
        trouble: Why nothing is written at the moment, for people; empty where all is well.
    """

    def __init__(
        self,
        path: Path,
        info: StreamInfo,
        rules: RecordingRules,
        *,
        recording: str,
        attachments: Sequence[LogAttachment] = (),
        overwrite: bool = False,
        goes_on: bool = False,
    ) -> None:
        self._path = path
        self._info = info
        self._rules = rules
        self._recording = recording
        self._attachments = tuple(attachments)
        self._number = 0
        self._others: list[Parts] = []  # what further streams are
        self._finished: deque[Path] = deque()  # parts that may be deleted, the oldest first
        self._done_frames = self._done_messages = 0  # in parts that are finished
        self.lost = self.deleted = 0
        self.trouble = ""
        self.ended = self.gone = False
        self._retry_at = float("-inf")
        there = parts_on_disk(path)
        if goes_on:
            self._number = max(there, default=-1) + 1
            self._finished.extend(file for file in there.values() if _is_of(file, recording))
        else:
            make_way(path, overwrite=overwrite)
        self._began = time.monotonic()
        self._part: LogWriter | None = self._open(self._number)

    @property
    def path(self) -> Path:
        """Of the part that is written now, or was last."""
        return part_path(self._path, self._number)

    @property
    def parts(self) -> int:
        """Begun since the recording was opened and not deleted."""
        return len(self._finished) + (self._part is not None)

    @property
    def frames(self) -> int:
        """Written to all parts since the recording was opened."""
        return self._done_frames + (self._part.frames if self._part is not None else 0)

    @property
    def messages(self) -> int:
        """Written to all parts since the recording was opened."""
        return self._done_messages + (self._part.messages if self._part is not None else 0)

    @property
    def nothing_left(self) -> bool:
        """Whether the files of the recording were removed by somebody else while it was written."""
        return self.gone and not parts_on_disk(self._path)

    def write(self, parts: Parts) -> None:
        """Append one encoded message; where there is no room it is counted in ``lost``.

        Raises CodecError: not a message of ours; the recording is as it was.
        """
        if self.ended or time.monotonic() < self._retry_at:
            self.lost += 1
            return
        while True:
            try:
                self._check_reserve(parts)
                self._write(parts)
                return
            except OSError as error:
                reason = error
            except LogError as error:  # the disk took no more, whatever it had promised
                self._drop_failed_part()
                reason = error.__cause__
            is_full = isinstance(reason, OSError) and reason.errno in _NO_ROOM
            if not is_full or not self._delete_oldest():
                self.lost += 1
                self._stop(str(reason.strerror if isinstance(reason, OSError) else reason))
                return

    def announce(self, info: Parts, attachment: LogAttachment) -> None:
        """Append what a further stream is; like the first one's it stands in each part that begins from now on, and the
        attachment in the place of the one of its name. Raises CodecError: not a message of ours; nothing has changed.
        """
        self._others.append(info)  # first: where there is no room now, it stands in the next part
        self._attachments = (*(kept for kept in self._attachments if kept.name != attachment.name), attachment)
        if self._part is not None:
            self._part.attach(attachment)
        self.write(info)

    def close(self) -> None:
        """Finish the last part. Harmless when repeated."""
        self._finish_part()
        self.ended = True

    def _check_reserve(self, parts: Parts) -> None:
        """Raises OSError: a message does not fit next to the reserve, or the disk is gone."""
        free, reserve = shutil.disk_usage(self._path.parent).free, self._rules.reserve_bytes
        if free - _size(parts) < reserve:
            room = f"{free / 1e6:.0f} MB are free, {reserve / 1e6:.0f} MB are left to others"
            raise OSError(errno.ENOSPC, f"the disk is full: {room}")

    def _write(self, parts: Parts) -> None:
        if self._part is not None and self._is_due(self._part, _size(parts)):
            self._finish_part()
        if self._part is None:
            self._part = self._open(self._number + 1)
            self._number += 1
            self._began = time.monotonic()
            for info in self._others:
                self._part.write_parts(info)
            _log.info("part_begun", log=str(self.path))
        self._part.write_parts(parts)
        self.trouble = ""

    def _is_due(self, part: LogWriter, size: int) -> bool:
        rules = self._rules
        if not self._holds_anything(part):
            return False
        too_large = rules.split_bytes and part.bytes_written + size > rules.split_bytes
        return bool(too_large) or bool(rules.split_s and time.monotonic() - self._began >= rules.split_s)

    def _holds_anything(self, part: LogWriter) -> bool:
        """More than what the streams are."""
        return part.messages > 1 + len(self._others)

    def _open(self, number: int) -> LogWriter:
        attachments = (*self._attachments, Part(self._recording, number).attachment())
        return LogWriter(part_path(self._path, number), self._info, attachments=attachments)

    def _finish_part(self) -> None:
        part, self._part = self._part, None
        if part is None:
            return
        self._done_frames += part.frames
        self._done_messages += part.messages
        self._finished.append(part.path)
        if not part.path.exists():  # Linux lets a removed file be written to
            self.gone = True
            _log.error("part_gone", log=str(part.path), frames=part.frames)
        try:
            part.close()
        except LogError as error:  # its messages are whole
            _log.warning("part_not_closed", log=str(part.path), error=str(error))

    def _delete_oldest(self) -> bool:
        """False where nothing may be deleted: not the newest part that holds anything."""
        newest = 0 if self._part is not None and self._holds_anything(self._part) else 1
        if self._rules.disk_full != "delete-oldest" or len(self._finished) <= newest:
            return False
        oldest = self._finished.popleft()
        oldest.unlink(missing_ok=True)
        self.deleted += 1
        _log.warning("part_deleted", log=str(oldest), reason="the disk is full")
        return True

    def _drop_failed_part(self) -> None:
        """Finish a part that can take no more; one that holds nothing is removed."""
        part = self._part
        self._finish_part()
        if part is not None and not self._holds_anything(part) and self._number:
            self._finished.pop()
            part.path.unlink(missing_ok=True)
            self._done_messages -= part.messages
            self._number -= 1

    def _stop(self, why: str) -> None:
        """Nothing more is written: at all, or until there is room."""
        if self._rules.disk_full == "stop":
            self.ended = True
            self._finish_part()
            what = "recording has stopped; " + ("its file is gone" if self.gone else "what is recorded is whole")
        else:
            what = "no older part is left to delete; recording goes on once there is room"
        self._retry_at = time.monotonic() + RETRY_S
        if not self.trouble:
            _log.error("recording_stopped", log=str(self.path), reason=why, then=what)
        self.trouble = f"{self.path}: cannot be written: {why}; {what}"


def _is_of(file: Path, recording: str) -> bool:
    try:
        with LogReader(file, allow_empty=True) as log:
            return log.part is not None and log.part.recording == recording
    except LogError:
        return False


def _size(parts: Parts) -> int:
    return sum(len(part) for part in parts)


def make_way(path: Path, *, overwrite: bool, dry: bool = False) -> None:
    """Make sure that no other recording is mixed with a new one.

    What is there is deleted with ``overwrite``, not yet if ``dry``. Raises LogError: it must not be replaced.
    """
    for file in parts_on_disk(path).values():  # parts also come of a recorder that was restarted
        if not overwrite:
            how = "let it be replaced: --overwrite, in a launch file overwrite = true"
            raise LogError(f"{file}: exists already; give another name, or {how}")
        if not file.is_file():
            raise LogError(f"{file}: is no file that a log could replace; give another name")
        if not dry:
            file.unlink()
