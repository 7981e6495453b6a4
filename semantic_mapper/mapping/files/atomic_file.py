"""A file that is replaced whole: written beside the old one, flushed, then renamed over it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write; at the end it takes the place of ``path``, and both survive a power cut.

    However the process ends, ``path`` is the old file or the new one; see ``atomic_write``.

    Raises:
        MapError: the disk is full or fails; the old file is untouched.
    """
    try:
        with atomic_write(path) as file:
            yield file
    except OSError as error:
        reason = error.strerror or str(error)
        raise MapError(
            f"{path}: cannot write the map: {reason}. A file that was there before is as it was; make room, or choose "
            "another folder"
        ) from error
    _sync_folder(path)


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
