"""Blocks that do not fit in memory: a private SQLite database on disk, each block with its checksum.

The database is scratch space of one running map: SQLite takes its file out of the folder as soon as it is open, so
that nothing stays behind, however the process ends. What is to outlive the process is saved (``map_file``). A write
that fails is taken back, with SQLite's journal in memory: what was there before is there still.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.evidence import EVIDENCE_DTYPES
from semantic_mapper.mapping.key_table import ABSENT, KeyTable
from semantic_mapper.types import Float32

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
        values = _empty(len(wanted), self._classes, self._evidence)
        for n, key in enumerate(wanted):
            if key not in found or zlib.crc32(found[key][1]) != found[key][0]:
                raise MapError(f"block {key} on disk is {'damaged' if key in found else 'missing'}; its disk fails")
            unpack_block(found[key][1], values, n)
        return values

    def drop(self, keys: NDArray[np.int64]) -> None:
        """Forget blocks that are back in memory.

        Raises:
            MapError: see ``put``.
        """
        with self._all_or_nothing(f"{len(keys)} blocks cannot be taken off the disk"):
            for part in _parts(keys.tolist()):
                self._database.execute(f"DELETE FROM blocks WHERE key IN ({','.join('?' * len(part))})", part)
        self._versions.remove(keys)

    def close(self) -> None:
        """Give the disk space back."""
        self._database.close()

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
    ends = _ends(values.weight, values.votes, rows, evidence_words(values.evidence.shape[2], values.evidence))
    data = np.zeros(ends[-1], np.float32)
    _pack(values, rows, ends, (data, data.view(np.uint8), data.view(values.evidence.dtype)))
    return PackedBlocks(data, ends, values.evidence.dtype)


@kernel()
def evidence_words(classes, evidence):
    """How many float32 the evidence of one voxel takes up in packed blocks, for an array of its type."""
    return (classes * evidence.itemsize + 3) // 4


@kernel()
def _ends(weight, votes, rows, width):
    """Where the packed blocks begin and end (B + 1,), in units of float32."""
    ends = np.zeros(len(rows) + 1, np.int64)
    for n in range(len(rows)):
        measured, voted = 0, 0
        for voxel in range(BLOCK_VOXELS):
            measured += weight[rows[n], voxel] > 0
            voted += votes[rows[n], voxel] > 0
        ends[n + 1] = ends[n] + MASK_BYTES // 2 + 5 * measured + (width + 1) * voted
    return ends


@kernel()
def _pack(values, rows, ends, out_views):
    """Write blocks as ``PackedBlocks`` says to zeros; ``out_views`` are float32, bytes, evidence of the same memory."""
    out, out_bytes, out_evidence = out_views
    classes, each = values.evidence.shape[2], 4 // out_evidence.itemsize
    width = evidence_words(classes, out_evidence)
    for n in range(len(rows)):
        block, masks = rows[n], 4 * ends[n]
        measured = 0
        for voxel in range(BLOCK_VOXELS):
            bit = np.uint8(0x80 >> (voxel & 7))
            if values.weight[block, voxel] > 0:
                out_bytes[masks + (voxel >> 3)] |= bit
                measured += 1
            if values.votes[block, voxel] > 0:
                out_bytes[masks + MASK_BYTES + (voxel >> 3)] |= bit
        tsdf = ends[n] + MASK_BYTES // 2
        weight, color, evidence = tsdf + measured, tsdf + 2 * measured, tsdf + 5 * measured
        votes = ends[n + 1] - (ends[n + 1] - evidence) // (width + 1)
        for voxel in range(BLOCK_VOXELS):
            if values.weight[block, voxel] > 0:
                out[tsdf], out[weight] = values.tsdf[block, voxel], values.weight[block, voxel]
                for c in range(3):
                    out[color + c] = values.color[block, voxel, c]
                tsdf, weight, color = tsdf + 1, weight + 1, color + 3
            if values.votes[block, voxel] > 0:
                for c in range(classes):
                    out_evidence[each * evidence + c] = values.evidence[block, voxel, c]
                out[votes] = values.votes[block, voxel]
                evidence, votes = evidence + width, votes + 1


def unpack_block(voxels: bytes | memoryview, values: BlockValues, n: int) -> None:
    """Fill block ``n``, whose voxels are all zero, with what ``pack_blocks`` has packed of one."""
    data = np.frombuffer(voxels, np.float32)
    _unpack_block((data, data.view(np.uint8), data.view(values.evidence.dtype)), values, n)


@kernel()
def _unpack_block(views, values, n):
    """The reverse of ``_pack`` for one block, onto voxels that are zero."""
    data, data_bytes, said = views
    classes, each = values.evidence.shape[2], 4 // said.itemsize
    width = evidence_words(classes, said)
    measured = 0
    for voxel in range(BLOCK_VOXELS):
        measured += (data_bytes[voxel >> 3] >> (7 - (voxel & 7))) & 1
    tsdf = MASK_BYTES // 2
    weight, color, evidence = tsdf + measured, tsdf + 2 * measured, tsdf + 5 * measured
    votes = len(data) - (len(data) - evidence) // (width + 1)
    for voxel in range(BLOCK_VOXELS):
        shift = 7 - (voxel & 7)
        if (data_bytes[voxel >> 3] >> shift) & 1:
            values.tsdf[n, voxel], values.weight[n, voxel] = data[tsdf], data[weight]
            for c in range(3):
                values.color[n, voxel, c] = data[color + c]
            tsdf, weight, color = tsdf + 1, weight + 1, color + 3
        if (data_bytes[MASK_BYTES + (voxel >> 3)] >> shift) & 1:
            for c in range(classes):
                values.evidence[n, voxel, c] = said[each * evidence + c]
            values.votes[n, voxel] = data[votes]
            evidence, votes = evidence + width, votes + 1
