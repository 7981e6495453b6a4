"""One training a folder: two would write each other's state."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import open_unlinked

LOCK_FILE = ".lock"


@contextmanager
def sole_use_of(folder: Path | None) -> Iterator[None]:
    """Meanwhile no other process that asks gets the folder. The lock goes with the process, however it ends.

    Raises ConfigError: another process has it.
    """
    if folder is None:
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with os.fdopen(open_unlinked(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT), "r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{folder}: another training is writing there; let it end, or give this one another --out"
            ) from error
        yield
