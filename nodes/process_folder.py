"""Folders of one process under TMPDIR, and how those that a killed one has left are told from those in use.

A lock in the folder says so, not the process number in its name: containers that share /tmp count theirs by themselves.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import structlog

PREFIX = "semantic-mapper-"
_LOCK = "in-use.lock"  # held by the process that has made the folder; the kernel frees it when that dies

_log = structlog.get_logger(__name__)


class OwnFolder:
    """A new folder that only this user can enter. ``sweep`` leaves it alone until it is closed or its process is dead.

    Args:
        kind: Part of its name.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, kind: str = "") -> None:
        self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-{kind}"))  # mode 0700
        draft = self.path / f"{_LOCK}.new"
        self._lock = os.open(draft, os.O_RDWR | os.O_CREAT, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        draft.rename(self.path / _LOCK)  # now that it is held: nobody else can come first

    def close(self) -> None:
        """Remove it. Harmless when repeated."""
        if self._lock >= 0:
            shutil.rmtree(self.path, onerror=_tell_left_over)
            os.close(self._lock)
            self._lock = -1


def own_folders() -> Iterator[Path]:
    """All that may be folders of ours, in use or not, of all users."""
    return Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*")


def is_in_use(folder: Path) -> bool:
    """Whether the process that has made it still runs.

    Raises:
        OSError: it is another user's.
    """
    lock = _take(folder, fcntl.LOCK_SH)  # shared: two that ask at once do not see each other
    if lock is not None:
        os.close(lock)
    return lock is None and (folder / _LOCK).exists()


def sweep() -> None:
    """Remove the folders of this user's processes that were killed; what holds no lock file is none of ours."""
    for folder in own_folders():
        lock = _take(folder, fcntl.LOCK_EX)
        if lock is None:
            continue
        stat = os.fstat(lock)
        if stat.st_uid == os.getuid() and stat.st_nlink:  # else somebody who sweeps, too, was quicker
            shutil.rmtree(folder, onerror=_tell_left_over)
        os.close(lock)


def _take(folder: Path, how: int) -> int | None:
    """Its lock, open; None where there is none, or somebody holds it."""
    try:
        lock = os.open(folder / _LOCK, os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(lock, how | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        return None
    return lock


def _tell_left_over(function: object, path: str, error: object) -> None:
    sys.stderr.flush()
    _log.warning("left_over", path=path, error=str(error))
