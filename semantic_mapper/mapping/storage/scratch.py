"""Blobs by number in a private file on disk, scratch space of one running process.

SQLite takes its file out of the folder as soon as it is open, so nothing stays behind, however the process ends. Each
blob has a checksum. A write that fails is taken back: what was there before is there still.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from semantic_mapper.errors import MapError

_CACHE_KIB = 4096  # of SQLite's own pages
_KEYS_A_QUERY = 500


class ScratchFile:
    """Blobs by an integer key. Calls may come from several threads, one at a time.

    Args:
        what: Of what the blobs are, for messages, such as "blocks".
        advice: Which setting helps where the disk is full.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, what: str, advice: str) -> None:
        self._what, self._advice = what, advice
        try:
            self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)
            self._database.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            self._database.execute("PRAGMA journal_mode = MEMORY")
            self._database.execute("CREATE TABLE blobs (key INTEGER PRIMARY KEY, crc INTEGER, blob BLOB)")
        except sqlite3.Error as error:
            raise MapError(f"no room for {what} on disk can be made: {error}; is TMPDIR full or read-only?") from error

    @property
    def file_bytes(self) -> int:
        """Size of the file; room of blobs that are gone is used again, never given back."""
        (pages,), (page_bytes,) = (self._database.execute(f"PRAGMA page_{n}").fetchone() for n in ("count", "size"))
        return pages * page_bytes

    def put(self, keys: Sequence[int], blobs: Sequence[bytes | memoryview]) -> None:
        """Put blobs on disk.

        Raises:
            MapError: the disk is full or fails; the file is as it was, and can be used again once there is room.
        """
        rows = [(key, zlib.crc32(blob), blob) for key, blob in zip(keys, blobs, strict=True)]
        with self._transaction(f"{len(rows)} {self._what} cannot be put on disk"):
            self._database.executemany("INSERT OR REPLACE INTO blobs VALUES (?, ?, ?)", rows)

    def get(self, keys: Sequence[int]) -> list[bytes]:
        """Read blobs, in the order of the keys; they stay on disk.

        Raises:
            MapError: one is not there, or is not what was put there.
        """
        found: dict[int, tuple[int, bytes]] = {}
        try:
            for part in _parts(keys):
                marks = ",".join("?" * len(part))
                rows = self._database.execute(f"SELECT key, crc, blob FROM blobs WHERE key IN ({marks})", part)
                found.update((key, (crc, blob)) for key, crc, blob in rows)
        except sqlite3.Error as error:
            raise MapError(f"{self._what} on disk cannot be read: {error}") from error
        for key in keys:
            if key not in found or zlib.crc32(found[key][1]) != found[key][0]:
                reason = "damaged" if key in found else "missing"
                raise MapError(f"{self._what} on disk: number {key} is {reason}; its disk fails")
        return [found[key][1] for key in keys]

    def drop(self, keys: Sequence[int]) -> None:
        """Forget blobs.

        Raises:
            MapError: see ``put``.
        """
        with self._transaction(f"{len(keys)} {self._what} cannot be taken off the disk"):
            for part in _parts(keys):
                self._database.execute(f"DELETE FROM blobs WHERE key IN ({','.join('?' * len(part))})", part)

    def close(self) -> None:
        """Give the disk space back. Harmless when repeated."""
        self._database.close()

    @contextmanager
    def _transaction(self, failure: str) -> Iterator[None]:
        try:
            self._database.execute("BEGIN")
            try:
                yield
                self._database.execute("COMMIT")
            finally:
                if self._database.in_transaction:  # some failures end it by themselves
                    self._database.execute("ROLLBACK")
        except sqlite3.Error as error:
            raise MapError(
                f"{failure}: {error}; make room in the folder for temporary files (TMPDIR), or {self._advice}"
            ) from error


def _parts(keys: Sequence[int]) -> Iterator[Sequence[int]]:
    for start in range(0, len(keys), _KEYS_A_QUERY):
        yield keys[start : start + _KEYS_A_QUERY]
