"""A log that is there once it is complete: where it cannot be finished, nothing is left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from semantic_mapper.errors import LogError
from semantic_mapper.files import atomic_path
from semantic_mapper.replay.log.format import LogAttachment, LogWriter
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import StreamInfo

_DEFAULTS = CodecOptions()


@contextmanager
def atomic_log(
    path: Path,
    info: StreamInfo,
    *,
    options: CodecOptions = _DEFAULTS,
    attachments: Sequence[LogAttachment] = (),
    overwrite: bool = False,
) -> Iterator[LogWriter]:
    """A writer of the log ``path``, which gets its name as the last thing; after an error there is none.

    Args:
        path, info, options, attachments: See ``LogWriter``.
        overwrite: Whether a log that is there may be replaced; it stays until then.

    Raises:
        LogError: ``path`` is there already, or cannot be written.
    """
    if path.exists() and not overwrite:
        raise LogError(f"{path}: exists already; remove it or choose another name")
    writer: LogWriter | None = None
    try:
        with atomic_path(path) as unfinished:
            writer = LogWriter(unfinished, info, options=options, attachments=attachments, overwrite=True)
            with writer:
                yield writer
    except OSError as error:
        raise _nothing_left(path, error) from error
    except LogError as error:
        reason = error.__cause__ if writer is None else writer.trouble
        if not isinstance(reason, OSError):  # of a log that is read meanwhile
            raise
        raise _nothing_left(path, reason) from error


def _nothing_left(path: Path, error: OSError) -> LogError:
    return LogError(
        f"{path}: cannot be written ({error.strerror or error}), and nothing of it was left; make room, "
        "or choose another place"
    )
