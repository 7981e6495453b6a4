"""Files that people name: read with a limit, before anything of them is in memory."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from semantic_mapper.errors import ConfigError


def read_regular(path: Path, limit: int) -> bytes:
    """All bytes of a regular file.

    Args:
        path: Of the file. Pipes, devices and sockets are refused: they may never end, or never begin.
        limit: Largest size in bytes.

    Raises:
        ConfigError: no regular file, or a larger one.
        OSError: it is missing or cannot be read; ``filename`` is set.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer must not block
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise ConfigError(f"{path}: is no regular file; copy its content to one")
    with os.fdopen(fd, "rb") as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ConfigError(f"{path}: is larger than the limit of {limit:,} bytes; is it the right file?")
    return data
