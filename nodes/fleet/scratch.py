"""Disk of a worker: a folder a task, all of them together within a limit, gone when the task or its process is."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from semantic_mapper.errors import FleetError
from semantic_mapper.log_events import get_logger

_POLL_S = 0.5
_KEPT_FREE = 1 << 30  # bytes of the disk that stay free
_LOCK = "lock"
_WEIGHTS = "weights"  # folder with weights that were fetched; see ``worker``

_log = get_logger(__name__)


def scratch_root() -> Path:
    """Folder of this user's tasks on this machine, in the folder that ``TMPDIR`` names."""
    root = Path(tempfile.gettempdir()) / f"semantic-mapper-fleet-{os.getuid()}"
    root.mkdir(mode=0o700, exist_ok=True)
    if root.is_symlink() or root.stat().st_uid != os.getuid():
        raise FleetError(f"{root}: belongs to somebody else; set TMPDIR to a folder of your own")
    return root


class DiskError(FleetError):
    """This machine has too little disk for a task; another one may have more."""


@contextmanager
def task_folder(needed_bytes: int, limit_bytes: int) -> Iterator[Path]:
    """An empty folder for one task; waits while other tasks of this machine take what the limit allows.

    What killed tasks have left is removed first.

    Args:
        needed_bytes: What the task will write, about.
        limit_bytes: For all tasks of this machine together; 0 = what the disk has, but for a gigabyte.

    Raises:
        DiskError: the task needs more than the limit by itself, or than the disk has.
    """
    root = scratch_root()
    folder, lock = _reserve(root, needed_bytes, limit_bytes)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _reserve(root: Path, needed: int, limit: int) -> tuple[Path, int]:
    waited = False
    while True:
        with _locked(root):
            taken = sum(_bytes_of(folder) for folder in _living(root))
            allowed = limit or max(shutil.disk_usage(root).free + taken - _KEPT_FREE, 0)
            if taken + needed <= allowed:
                folder = root / f"{needed}-{secrets.token_hex(6)}"
                folder.mkdir(mode=0o700)
                lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
                fcntl.flock(lock, fcntl.LOCK_EX)
                return folder, lock
        if not taken or needed > allowed:
            raise DiskError(
                f"{root}: a task needs {needed / 1e9:.2f} GB of disk, {allowed / 1e9:.2f} GB are allowed; raise "
                "--worker-disk, or set TMPDIR to a larger disk"
            )
        if not waited:
            _log.info("waiting_for_disk", needed_mb=needed >> 20, taken_mb=taken >> 20, allowed_mb=allowed >> 20)
        waited = True
        time.sleep(_POLL_S)


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    fd = os.open(root / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def _living(root: Path) -> list[Path]:
    """Folders of tasks that run; those of killed ones are removed."""
    found = []
    for folder in root.iterdir():
        if not folder.is_dir() or folder.name == _WEIGHTS:
            continue
        with suppress(FileNotFoundError):
            fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                found.append(folder)
            else:
                shutil.rmtree(folder, ignore_errors=True)
                _log.info("left_folder_removed", folder=str(folder))
            finally:
                os.close(fd)
    return found


def _bytes_of(folder: Path) -> int:
    size, _, _ = folder.name.partition("-")
    return int(size) if size.isdigit() else 0
