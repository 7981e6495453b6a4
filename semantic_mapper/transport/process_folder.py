"""Folders of one process under TMPDIR, and how those that a killed one has left are distinguished from those in use.

A lock in the folder says so, not the process number in its name: containers that share /tmp count theirs by themselves.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from semantic_mapper.log_events import get_logger

PREFIX = "semantic-mapper-"
_LOCK = "in-use.lock"  # held by the process that has made the folder; the kernel frees it when that dies
_ASK_S = 0.05  # another process may be asking, too

_log = get_logger(__name__)


class OwnFolder:
    """A new folder that only this user can enter, with ``kind`` in its name; ``OSError`` where it cannot be made.

    ``sweep`` leaves it alone until it is closed or its process is dead.
    """

    def __init__(self, kind: str = "") -> None:
        self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-{kind}"))  # mode 0700
        draft = self.path / f"{_LOCK}.new"
        self._lock = FileLock(draft)
        self._lock.acquire()
        draft.rename(self.path / _LOCK)  # now that it is held: nobody else can come first

    def close(self) -> None:
        """Remove it. Harmless when repeated."""
        if self._lock.is_locked:
            shutil.rmtree(self.path, onerror=_report_left_over)
            self._lock.release()


def own_folders() -> Iterator[Path]:
    """All that may be folders of ours, in use or not, of all users."""
    return Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*")


def is_in_use(folder: Path) -> bool:
    """Whether the process that has made it still runs; ``OSError`` where it is another user's."""
    with _lock_of(folder) as lock:
        return lock is None and (folder / _LOCK).exists()


def sweep() -> None:
    """Remove the folders of this user's processes that were killed; what holds no lock file belongs to others."""
    for folder in own_folders():
        with suppress(OSError):  # it is another user's, or another process has just removed it
            if folder.stat().st_uid != os.getuid():
                continue
            with _lock_of(folder) as lock:
                if lock is not None:
                    shutil.rmtree(folder, onerror=_report_left_over)


@contextmanager
def _lock_of(folder: Path) -> Iterator[FileLock | None]:
    """Hold its lock; None where the lock is missing, or another process holds it."""
    lock = FileLock(folder / _LOCK)
    with suppress(Timeout):
        if (folder / _LOCK).exists():
            lock.acquire(timeout=_ASK_S, poll_interval=_ASK_S / 5)
    try:
        yield lock if lock.is_locked else None
    finally:
        lock.release()


def _report_left_over(function: object, path: str, error: object) -> None:
    sys.stderr.flush()
    _log.warning("left_over", path=path, error=str(error))
