"""A clean log from a damaged one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from semantic_mapper.errors import LogError
from semantic_mapper.replay.log.atomic_log import atomic_log
from semantic_mapper.replay.log.format import LogReader


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """What recovering saved and what it could not.

    Args:
        frames, messages: In the new log.
        lost: Why each of the others could not be saved.
        finished: Whether the old log had been closed by its writer.
    """

    frames: int
    messages: int
    lost: tuple[LogError, ...]
    finished: bool


def recover(src: Path, dst: Path) -> RecoverReport:
    """Write every intact message of ``src`` to the new log ``dst``; ``src`` is not touched.

    Raises:
        LogError: ``src`` gives no frame at all, or ``dst`` exists or cannot be written; then there is no ``dst``.
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
