"""One training a folder: two would write each other's state."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semantic_mapper.errors import ConfigError

LOCK_FILE = ".lock"


@contextmanager
def sole_use_of(folder: Path | None) -> Iterator[None]:
    """Meanwhile no other process that asks gets the folder. The lock goes with the process, however it ends.

    Raises:
        ConfigError: another process has it.
    """
    if folder is None:
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK_FILE).open("w", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{folder}: another training is writing there; let it end, or give this one another --out"
            ) from error
        yield
