"""Blocks that do not fit in memory: a private SQLite database on disk, each block with its checksum.

The database is scratch space of one running map: SQLite takes its file out of the folder as soon as it is open, so
that nothing stays behind, however the process ends. What is to outlive the process is saved (``map_file``). A write
that fails is taken back, with SQLite's journal in memory: what was there before is there still.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.fusion.evidence import EVIDENCE_DTYPES
from semantic_mapper.types import Float32, Int32, Int64

BLOCK_VOXELS = 512
MASK_BYTES = BLOCK_VOXELS // 8
_CACHE_KIB = 4096  # of SQLite's own pages
_ASKED_AT_ONCE = 500  # keys in one query


class BlockValues(NamedTuple):
    """The voxels of B blocks.

    Args:
        tsdf, weight, votes: (B, 512) float32.
        color: (B, 512, 3) float32.
        evidence: (B, 512, L) as the map keeps it; see ``evidence``.
    """

    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: NDArray[Any]
    votes: Float32


class PackedBlocks(NamedTuple):
    """B blocks one behind the other, each: which voxels are measured and which have votes, as two bit masks of 512 bits
    (of a byte, the highest first); TSDF, weight and colour of those measured; evidence and votes of those with votes.

    Args:
        data: (N,) float32; of what is not float32, the bits, each voxel's evidence in whole ones.
        ends: (B + 1,) where blocks begin and end in it.
        evidence: Type of the evidence.
    """

    data: Float32
    ends: NDArray[np.int64]
    evidence: np.dtype[Any]

    def blobs(self) -> list[memoryview]:
        """The bytes of each block; they share memory."""
        data: Any = self.data.view(np.uint8)
        return [memoryview(data)[start:end] for start, end in pairwise((4 * self.ends).tolist())]


class BlockStore:
    """Blocks by packed key, with the version each had when it was put away.

    Args:
        classes: L.
        evidence: Key of ``EVIDENCE_DTYPES``.

    Raises:
        MapError: no file can be made in the system's folder for temporary files.
    """

    def __init__(self, classes: int, evidence: str = "float32") -> None:
        self._classes, self._evidence = classes, EVIDENCE_DTYPES[evidence]
        try:
            # Calls come from whichever thread holds the map's lock.
            self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)
            self._database.execute(f"PRAGMA cache_size = -{_CACHE_KIB}")
            self._database.execute("PRAGMA journal_mode = MEMORY")
            self._database.execute(
                "CREATE TABLE blocks (key INTEGER PRIMARY KEY, version INTEGER, crc INTEGER, voxels BLOB)"
            )
        except sqlite3.Error as error:
            raise MapError(f"no room for blocks on disk can be made: {error}; is TMPDIR full or read-only?") from error
        # Of every block in the store, by ascending key.
        self.keys = np.empty(0, np.int64)
        self.versions = np.empty(0, np.int64)

    def __len__(self) -> int:
        return len(self.keys)

    def holds(self, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the blocks (B,) are in the store."""
        return self._find(keys)[1]

    def versions_of(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Versions (B,) of blocks (B,) that are in the store."""
        return self.versions[self._find(keys)[0]]

    @property
    def file_bytes(self) -> int:
        """Size of the database; pages of blocks that are gone are used again, never given back."""
        (pages,), (page_bytes,) = (self._database.execute(f"PRAGMA page_{n}").fetchone() for n in ("count", "size"))
        return pages * page_bytes

    def put(self, keys: NDArray[np.int64], versions: NDArray[np.int64], values: BlockValues) -> None:
        """Put blocks away.

        Raises:
            MapError: the disk is full or fails; the store is as it was, and can be used again once there is room.
        """
        self.put_packed(keys, versions, pack_blocks(values, np.arange(len(keys), dtype=np.int32)).blobs())

    def put_packed(self, keys: NDArray[np.int64], versions: NDArray[np.int64], blocks: list[memoryview]) -> None:
        """Put blocks away that ``pack_blocks`` has packed, as their bytes.

        Raises:
            MapError: see ``put``.
        """
        packed = zip(keys.tolist(), versions.tolist(), blocks, strict=True)
        rows = [(key, version, zlib.crc32(voxels), voxels) for key, version, voxels in packed]
        with self._all_or_nothing(f"{len(rows)} blocks cannot be put on disk"):
            self._database.executemany("INSERT OR REPLACE INTO blocks VALUES (?, ?, ?, ?)", rows)
        row, there = self._find(keys)
        self.versions[row[there]] = versions[there]
        new = np.flatnonzero(~there)
        new = new[np.argsort(keys[new])]
        self.keys = np.insert(self.keys, row[new], keys[new])
        self.versions = np.insert(self.versions, row[new], versions[new])

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
        values = _empty(len(wanted), self._classes, self._evidence)
        for key in wanted:
            if key not in found or zlib.crc32(found[key][1]) != found[key][0]:
                raise MapError(f"block {key} on disk is {'damaged' if key in found else 'missing'}; its disk fails")
        unpack_blocks([found[key][1] for key in wanted], values, np.arange(len(wanted)))
        return values

    def drop(self, keys: NDArray[np.int64]) -> None:
        """Forget blocks that are back in memory.

        Raises:
            MapError: see ``put``.
        """
        with self._all_or_nothing(f"{len(keys)} blocks cannot be taken off the disk"):
            for part in _parts(keys.tolist()):
                self._database.execute(f"DELETE FROM blocks WHERE key IN ({','.join('?' * len(part))})", part)
        row, there = self._find(keys)
        self.keys, self.versions = np.delete(self.keys, row[there]), np.delete(self.versions, row[there])

    def close(self) -> None:
        """Give the disk space back."""
        self._database.close()

    def _find(self, keys: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Where blocks (B,) are, or would be, among ``keys``, and whether they are."""
        row = np.searchsorted(self.keys, keys)
        there = np.zeros(len(keys), np.bool_)
        within = row < len(self.keys)
        there[within] = self.keys[row[within]] == keys[within]
        return row, there

    @contextmanager
    def _all_or_nothing(self, failure: str) -> Iterator[None]:
        """One transaction; what SQLite finds wrong is an error of ours."""
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
                f"{failure}: {error}; make room in the folder for temporary files (TMPDIR), or raise "
                "voxel_map.memory_mb"
            ) from error


def _parts(keys: list[int]) -> Iterator[list[int]]:
    for start in range(0, len(keys), _ASKED_AT_ONCE):
        yield keys[start : start + _ASKED_AT_ONCE]


def _empty(count: int, classes: int, evidence: type[np.generic]) -> BlockValues:
    flat = (count, BLOCK_VOXELS)
    tsdf, weight, votes = (np.zeros(flat, np.float32) for _ in range(3))
    return BlockValues(tsdf, weight, np.zeros((*flat, 3), np.float32), np.zeros((*flat, classes), evidence), votes)


def pack_blocks(values: BlockValues, rows: NDArray[np.int32]) -> PackedBlocks:
    """Copy blocks ``rows`` (B,) of ``values`` in one compiled pass, without the voxels that hold nothing."""
    rows, ends = np.ascontiguousarray(rows), np.empty(len(rows) + 1, np.int64)
    packed_block_ends(values.weight, values.votes, rows, ends, evidence_floats(values.evidence))
    data = np.zeros(ends[-1], np.float32)
    pack_block_values(values, rows, ends, data)
    return PackedBlocks(data, ends, values.evidence.dtype)


def unpack_blocks(blobs: Sequence[bytes | memoryview], values: BlockValues, rows: NDArray[np.int64]) -> None:
    """Fill blocks ``rows`` (B,), whose voxels are all zero, with those that ``pack_blocks`` has packed.

    Raises:
        MapError: bytes are no packed block with as many classes.
    """
    sizes = np.array([0, *map(len, blobs)], np.int64)
    count = 0
    if not (sizes % 4).any():
        ends = np.cumsum(sizes // 4)
        count = unpack_block_values(np.frombuffer(b"".join(blobs), np.float32), ends, values, rows)
    if count < len(rows):
        raise MapError(f"a packed block of {len(blobs[count])} bytes does not hold what it says; its disk fails")


def evidence_floats(evidence: NDArray[Any]) -> int:
    """How many float32 the evidence (..., L) of one voxel takes up in packed blocks."""
    return (evidence.shape[-1] * evidence.itemsize + 3) // 4


@kernel
def packed_block_ends(weight: Float32, votes: Float32, rows: Int32, ends: Int64, evidence_floats: int) -> None:
    """Where packed blocks begin and end, in units of float32.

    Args:
        weight, votes: (capacity, 512).
        rows: (B,) blocks to pack.
        ends: (B + 1,) to fill.
        evidence_floats: Of one voxel.
    """
    ...


@kernel
def pack_block_values(values: BlockValues, rows: Int32, ends: Int64, data: Float32) -> None:
    """Write blocks ``rows`` (B,) as ``PackedBlocks`` says to ``data`` (N,), which is zero; ``ends`` (B + 1,)."""
    ...


@kernel
def unpack_block_values(data: Float32, ends: Int64, values: BlockValues, rows: Int64) -> int:
    """The reverse, onto voxels that are zero.

    Args:
        data: (N,) packed blocks.
        ends: (B + 1,) where they begin and end.
        values: To fill.
        rows: (B,) blocks of ``values``.

    Returns:
        How many were unpacked, fewer than B where one is damaged.
    """
    ...
