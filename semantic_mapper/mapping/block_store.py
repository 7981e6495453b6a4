"""Blocks that do not fit in memory: a private SQLite database on disk, each block with its checksum.

The database is scratch space of one running map: SQLite takes its file out of the folder as soon as it is open, so
that nothing stays behind, however the process ends. What is to outlive the process is saved (``map_file``).
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.key_table import ABSENT, KeyTable
from semantic_mapper.types import Float32

BLOCK_VOXELS = 512
_MASK_BYTES = BLOCK_VOXELS // 8
_CACHE_KIB = 4096  # of SQLite's own pages
_ASKED_AT_ONCE = 500  # keys in one query


class BlockValues(NamedTuple):
    """The voxels of B blocks.

    Args:
        tsdf, weight, votes: (B, 512) float32.
        color: (B, 512, 3) float32.
        evidence: (B, 512, L) float32.
    """

    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: Float32
    votes: Float32


class BlockStore:
    """Blocks by packed key, with the version each had when it was put away.

    Args:
        classes: L.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, classes: int) -> None:
        self._classes = classes
        try:
            # Calls come from whichever thread holds the map's lock.
            self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)
            self._database.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            self._database.execute("PRAGMA journal_mode = OFF")
            self._database.execute(
                "CREATE TABLE blocks (key INTEGER PRIMARY KEY, version INTEGER, crc INTEGER, voxels BLOB)"
            )
        except sqlite3.Error as error:
            raise MapError(f"no room for blocks on disk can be made: {error}; is TMPDIR full or read-only?") from error
        self._versions = KeyTable()

    def __len__(self) -> int:
        return len(self._versions)

    @property
    def versions(self) -> KeyTable:
        """Packed key -> version of every block in the store."""
        return self._versions

    def holds(self, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the blocks (B,) are in the store."""
        return self._versions.find(keys) != ABSENT

    @property
    def file_bytes(self) -> int:
        """Size of the database; pages of blocks that are gone are used again, never given back."""
        (pages,), (page_bytes,) = (self._database.execute(f"PRAGMA page_{n}").fetchone() for n in ("count", "size"))
        return pages * page_bytes

    def put(self, keys: NDArray[np.int64], versions: NDArray[np.int64], values: BlockValues) -> None:
        """Put blocks away.

        Raises:
            MapError: the disk is full or fails.
        """
        rows: list[tuple[int, int, int, bytes]] = []
        for n, (key, version) in enumerate(zip(keys.tolist(), versions.tolist(), strict=True)):
            voxels = _pack(values, n)
            rows.append((key, version, zlib.crc32(voxels), voxels))
        try:
            self._database.execute("BEGIN")
            self._database.executemany("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?, ?)", rows)
            self._database.execute("COMMIT")
        except sqlite3.Error as error:
            raise MapError(
                f"{len(rows)} blocks cannot be put on disk: {error}; make room in the folder for temporary files "
                "(TMPDIR), or raise voxel_map.memory_mb"
            ) from error
        self._versions.put(keys, versions)

    def get(self, keys: NDArray[np.int64]) -> BlockValues:
        """Read blocks (B,), in the order asked for; they stay in the store.

        Raises:
            MapError: a block is not there, or is not what was put away.
        """
        wanted = keys.tolist()
        found: dict[int, tuple[int, bytes]] = {}
        try:
            for part in _parts(wanted):
                marks = ",".join("?" * len(part))
                rows = self._database.execute(f"SELECT key, crc, voxels FROM blocks WHERE key IN ({marks})", part)
                found.update((key, (crc, voxels)) for key, crc, voxels in rows)
        except sqlite3.Error as error:
            raise MapError(f"blocks on disk cannot be read: {error}") from error
        values = _empty(len(wanted), self._classes)
        for n, key in enumerate(wanted):
            if key not in found or zlib.crc32(found[key][1]) != found[key][0]:
                raise MapError(f"block {key} on disk is {'damaged' if key in found else 'missing'}; its disk fails")
            _unpack(found[key][1], values, n)
        return values

    def drop(self, keys: NDArray[np.int64]) -> None:
        """Forget blocks that are back in memory."""
        wanted = keys.tolist()
        for part in _parts(wanted):
            self._database.execute(f"DELETE FROM blocks WHERE key IN ({','.join('?' * len(part))})", part)
        self._versions.remove(keys)

    def close(self) -> None:
        """Give the disk space back."""
        self._database.close()


def _parts(keys: list[int]) -> Iterator[list[int]]:
    for start in range(0, len(keys), _ASKED_AT_ONCE):
        yield keys[start : start + _ASKED_AT_ONCE]


def _empty(count: int, classes: int) -> BlockValues:
    flat = (count, BLOCK_VOXELS)
    shapes: Iterable[tuple[int, ...]] = (flat, flat, (*flat, 3), (*flat, classes), flat)
    return BlockValues(*(np.zeros(shape, np.float32) for shape in shapes))


def _pack(values: BlockValues, n: int) -> bytes:
    """Voxels of block n that hold something: two bit masks, then their values."""
    measured, voted = values.weight[n] > 0, values.votes[n] > 0
    parts = (
        np.packbits(measured),
        np.packbits(voted),
        values.tsdf[n][measured],
        values.weight[n][measured],
        values.color[n][measured],
        values.evidence[n][voted],
        values.votes[n][voted],
    )
    return b"".join(part.tobytes() for part in parts)


def _unpack(voxels: bytes, values: BlockValues, n: int) -> None:
    measured = np.unpackbits(np.frombuffer(voxels, np.uint8, _MASK_BYTES)).astype(np.bool_)
    voted = np.unpackbits(np.frombuffer(voxels, np.uint8, _MASK_BYTES, _MASK_BYTES)).astype(np.bool_)
    rest = np.frombuffer(voxels, np.float32, offset=2 * _MASK_BYTES)
    a, b, classes = int(measured.sum()), int(voted.sum()), values.evidence.shape[2]
    ends = np.cumsum((a, a, 3 * a, classes * b, b))
    tsdf, weight, color, evidence, votes = np.split(rest, ends[:-1])
    values.tsdf[n][measured], values.weight[n][measured] = tsdf, weight
    values.color[n][measured] = color.reshape(-1, 3)
    values.evidence[n][voted], values.votes[n][voted] = evidence.reshape(-1, classes), votes
