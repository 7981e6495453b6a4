"""Files that appear under their name whole, or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_path


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write to, which takes the place of ``path`` in one step when all is written.

    Raises:
        MapError: it cannot be written; what was at ``path`` before is untouched.
    """
    with whole_path(path) as temporary, temporary.open("wb") as file:
        yield file


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """As ``whole_file``, for writers that open their file themselves: a name beside ``path`` to write to."""
    try:
        with atomic_path(path) as temporary:
            yield temporary
    except OSError as error:
        raise MapError(f"{path}: cannot be written: {error.strerror or error}") from error
