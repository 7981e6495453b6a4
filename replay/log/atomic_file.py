"""A file that grows by whole pieces only: what does not fit on the disk leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from semantic_mapper.files import open_unlinked


class AtomicFile:
    """A new file, open for writing. ``write`` collects in memory, ``commit`` brings all of it to the file or nothing.

    Args:
        path: Of the file.
        overwrite: Whether an existing one may be replaced.

    Attributes:
        size: Of what was committed, bytes.

    Raises:
        OSError: it exists, or cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        if overwrite and path.is_symlink():
            path.unlink()  # replaced, never written through
        self._fd = open_unlinked(path, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL))
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self.size = 0
        self.closed = False

    def write(self, data: bytes) -> int:
        """Collect; never fails."""
        self._pending.append(bytes(data))
        self._pending_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        """Where the next byte will be once all is committed."""
        return self.size + self._pending_bytes

    def flush(self) -> None:
        """Do nothing: ``commit`` decides what is in the file."""

    def commit(self) -> None:
        """Bring what was collected to the file.

        Raises:
            OSError: not all of it could be written; the file is as it was, and what was collected is dropped.
        """
        data = memoryview(b"".join(self._pending))
        self.drop()
        written = 0
        try:
            while written < len(data):
                written += os.write(self._fd, data[written:])
        except OSError:
            with contextlib.suppress(OSError):  # a device; else a cut record at the end, which readers pass over
                os.ftruncate(self._fd, self.size)
                os.lseek(self._fd, self.size, os.SEEK_SET)
            raise
        self.size += written

    def drop(self) -> None:
        """Forget what was collected since the last commit."""
        self._pending.clear()
        self._pending_bytes = 0

    def sync(self) -> None:
        """Wait until the disk has it.

        Raises:
            OSError: it cannot.
        """
        os.fsync(self._fd)

    def close(self) -> None:
        """Close it as it is. Harmless when repeated."""
        if not self.closed:
            self.closed = True
            os.close(self._fd)
