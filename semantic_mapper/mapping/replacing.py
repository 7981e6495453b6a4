"""A file that is replaced whole: written beside the old one, flushed, then renamed over it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from semantic_mapper.errors import MapError

PART_SUFFIX = ".part"


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write; at the end it takes the place of ``path``, and both survive a power cut.

    However the process ends, ``path`` is the old file or the new one. What a killed writer leaves is ``path`` with
    ``.part`` behind its name; the next writer takes it over. An error inside removes it.

    Raises:
        MapError: the disk is full or fails, or another writer is at work on the same file; the old one is untouched.
    """
    part = path.with_name(path.name + PART_SUFFIX)
    try:
        with _open_alone(part) as file:
            try:
                yield file
                file.flush()
                os.fsync(file.fileno())
                os.replace(part, path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise MapError(
            f"{path}: cannot write the map: {reason}. A file that was there before is as it was; make room, or choose "
            "another folder"
        ) from error
    _sync_folder(path)


def _open_alone(part: Path) -> BinaryIO:
    """Open an empty file that no other process or thread writes to."""
    while True:
        handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_still(handle, part):
                os.ftruncate(handle, 0)
                return os.fdopen(handle, "w+b")
        except BlockingIOError as error:
            os.close(handle)
            raise MapError(f"{part}: another save is writing there; wait for it, or choose another name") from error
        except OSError:
            os.close(handle)
            raise
        os.close(handle)  # the writer before us has renamed it meanwhile: it is the finished file now


def _is_still(handle: int, part: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(part))
    except FileNotFoundError:
        return False


def _sync_folder(path: Path) -> None:
    """Make the rename itself survive a power cut."""
    try:
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise MapError(
            f"{path}: the map is written, but a power cut may still lose it: {error.strerror}; save it again"
        ) from error
