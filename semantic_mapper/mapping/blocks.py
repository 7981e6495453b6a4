"""Voxel blocks: their keys and an index of these, as bytes, and those that do not fit in memory on disk.

A block key is the block's integer coordinate (x, y, z); three of them packed into one int64 sort like the triple. The
index is an open-addressing table that compiled kernels can read (``block_index.h``). On disk is scratch space of one
process: SQLite unlinks its file as soon as it is open. A write that fails is taken back."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.kernels import kernel
from semantic_mapper.types import Bool, Float32, Int32, Int64, UInt16

KEY_BITS = 21
KEY_LIMIT = 1 << (KEY_BITS - 1)  # |coordinate| must stay below: 167 km at 2 cm voxels
_KEY_MASK = (1 << KEY_BITS) - 1
_EMPTY = -1

BLOCK_VOXELS = 512
_CACHE_KIB = 4096  # of SQLite's own pages


class BlockIndex(NamedTuple):
    """(S,) int64 packed keys (-1 = empty slot) and (S,) int32 buffer indices; S is a power of two."""

    slot_keys: Int64
    slot_values: Int32


def make_block_index(keys: Int32, values: Int32) -> BlockIndex:
    """Build the table of keys (B, 3) with values (B,); at most half of the slots are used."""
    slots = 1 << max(6, int(2 * len(keys)).bit_length() + 1)
    index = BlockIndex(np.full(slots, _EMPTY, np.int64), np.zeros(slots, np.int32))
    insert_blocks(index, pack_keys(keys), np.ascontiguousarray(values))
    return index


def has_room(index: BlockIndex, count: int) -> bool:
    """Whether the table stays at most half full with ``count`` keys."""
    return 2 * count <= len(index.slot_keys)


def pack_keys(keys: Int32) -> Int64:
    """(B, 3) -> (B,); the order of packed keys is the lexicographic order of the triples."""
    wide = keys.astype(np.int64) + KEY_LIMIT
    return (wide[:, 0] << (2 * KEY_BITS)) | (wide[:, 1] << KEY_BITS) | wide[:, 2]


def unpack_keys(packed: Int64) -> Int32:
    """(B,) -> (B, 3)."""
    parts = (packed >> (2 * KEY_BITS), (packed >> KEY_BITS) & _KEY_MASK, packed & _KEY_MASK)
    return (np.stack(parts, axis=1) - KEY_LIMIT).astype(np.int32)


def find_blocks(index: BlockIndex, packed: Int64) -> Int32:
    """Buffer indices (B,) of packed keys (B,), -1 where there is no such block."""
    found = np.empty(len(packed), np.int32)
    _find_block_indices(index, np.ascontiguousarray(packed), found)
    return found


@kernel
def insert_blocks(index: BlockIndex, packed: Int64, values: Int32) -> None:
    """Add keys (B,) that are not in the table yet, with their buffer indices (B,); ``has_room`` must say yes."""


@kernel
def _find_block_indices(index: BlockIndex, packed: Int64, found: Int32) -> None: ...


class BlockValues(NamedTuple):
    """The voxels of B blocks: (B, 512) float32, colour (B, 512, 3), evidence (B, 512, L) uint16."""

    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: UInt16
    votes: Float32

    def take(self, rows: NDArray[Any]) -> BlockValues:
        """A copy of blocks with these numbers (N,)."""
        copies: list[Any] = [values[rows] for values in self]
        return BlockValues(*copies)


def empty_blocks(count: int, classes: int) -> BlockValues:
    """Blocks whose voxels are all zero."""
    flat = (count, BLOCK_VOXELS)
    tsdf, weight, votes = (np.zeros(flat, np.float32) for _ in range(3))
    return BlockValues(tsdf, weight, np.zeros((*flat, 3), np.float32), np.zeros((*flat, classes), np.uint16), votes)


class PackedBlocks(NamedTuple):
    """B blocks one behind the other: of each, two masks of 512 bits (of a byte, the highest first): voxels that are
    measured, and that have votes; then TSDF, weight and colour of the first, votes and evidence of the second."""

    data: Float32  # (N,) float32; of masks and evidence, the bits
    ends: Int64  # (B + 1,) where blocks begin and end in it

    def blobs(self) -> list[memoryview]:
        """The bytes of each block; they share memory."""
        data: Any = self.data.view(np.uint8)
        return [memoryview(data)[start:end] for start, end in pairwise((4 * self.ends).tolist())]


class ScratchFile:
    """Blobs by an integer key, each with a checksum, for one thread at a time. What fails is a ``MapError``: no file
    can be made in the folder for temporary files, the disk is full (the file is as it was, and works again once there
    is room), or a blob is damaged. ``what`` the blobs are and ``advice`` are for messages."""

    def __init__(self, what: str, advice: str) -> None:
        self._what, self._advice = what, advice
        try:
            self._database = sqlite3.connect("", check_same_thread=False)
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
        """Put blobs on disk."""
        rows = [(key, zlib.crc32(blob), blob) for key, blob in zip(keys, blobs, strict=True)]
        with self._transaction(f"{len(rows)} {self._what} cannot be put on disk"):
            self._database.executemany("INSERT OR REPLACE INTO blobs VALUES (?, ?, ?)", rows)

    def get(self, keys: Sequence[int]) -> list[bytes]:
        """Read blobs, in the order of the keys; they stay on disk."""
        blobs: list[bytes] = []
        for key in keys:
            try:
                found = self._database.execute("SELECT crc, blob FROM blobs WHERE key = ?", (key,)).fetchone()
            except sqlite3.Error as error:
                raise MapError(f"{self._what} on disk cannot be read: {error}") from error
            if found is None or zlib.crc32(found[1]) != found[0]:
                raise MapError(f"{self._what} on disk: number {key} is missing or damaged; its disk fails")
            blobs.append(found[1])
        return blobs

    def drop(self, keys: Sequence[int]) -> None:
        """Forget blobs."""
        with self._transaction(f"{len(keys)} {self._what} cannot be taken off the disk"):
            self._database.executemany("DELETE FROM blobs WHERE key = ?", [(key,) for key in keys])

    def close(self) -> None:
        """Give the disk space back. Harmless when repeated."""
        self._database.close()

    @contextmanager
    def _transaction(self, failure: str) -> Iterator[None]:
        try:
            with self._database:
                yield
        except sqlite3.Error as error:
            raise MapError(
                f"{failure}: {error}; make room in the folder for temporary files (TMPDIR), or {self._advice}"
            ) from error


class BlockStore:
    """Blocks on disk by packed key: ``keys`` (B,), ascending; when each last changed, and whether it holds a surface.
    After a ``MapError`` the store is as it was."""

    def __init__(self) -> None:
        self.keys = np.empty(0, np.int64)
        self.versions = np.empty(0, np.int64)
        self.surface = np.empty(0, np.bool_)

    def __len__(self) -> int:
        return len(self.keys)

    @cached_property
    def _scratch(self) -> ScratchFile:
        return ScratchFile("blocks", "raise voxel_map.memory_mb")

    @property
    def file_bytes(self) -> int:
        """Size of the file."""
        return self._scratch.file_bytes

    def find(self, keys: Int64) -> tuple[NDArray[np.intp], Bool]:
        """Rows of blocks (B,) among ``keys``, or where they would be, and whether they are there."""
        return find_sorted(self.keys, keys)

    def put(self, keys: Int64, blocks: PackedBlocks, versions: Int64, surface: Bool) -> None:
        """Put blocks (B,) away that are not in the store."""
        self._scratch.put(keys.tolist(), blocks.blobs())
        order = np.argsort(keys)
        rows = np.searchsorted(self.keys, keys[order])
        self.keys = np.insert(self.keys, rows, keys[order])
        self.versions = np.insert(self.versions, rows, versions[order])
        self.surface = np.insert(self.surface, rows, surface[order])

    def read_into(self, values: BlockValues, rows: Int64, keys: Int64) -> None:
        """Fill ``rows`` (B,) of ``values``, which are zero, with blocks (B,) of the store, where they stay."""
        unpack_blocks(self._scratch.get(keys.tolist()), values, rows)

    def drop(self, keys: Int64) -> None:
        """Forget blocks (B,)."""
        self._scratch.drop(keys.tolist())
        rows, there = self.find(keys)
        rows = rows[there]
        self.keys, self.versions = np.delete(self.keys, rows), np.delete(self.versions, rows)
        self.surface = np.delete(self.surface, rows)


def find_sorted(sorted_keys: Int64, keys: Int64) -> tuple[NDArray[np.intp], Bool]:
    """Rows of keys (B,) among sorted ones, or where they would be, and whether they are there."""
    rows = np.searchsorted(sorted_keys, keys)
    there = rows < len(sorted_keys)
    there[there] = sorted_keys[rows[there]] == keys[there]
    return rows, there


def pack_blocks(values: BlockValues, rows: NDArray[np.int32]) -> PackedBlocks:
    """Copy blocks ``rows`` (B,) of ``values`` in one compiled pass, without the voxels that hold nothing."""
    rows, ends = np.ascontiguousarray(rows), np.empty(len(rows) + 1, np.int64)
    packed_block_ends(values.weight, values.votes, rows, ends, values.evidence.shape[-1])
    data = np.zeros(ends[-1], np.float32)
    pack_block_values(values, rows, ends, data)
    return PackedBlocks(data, ends)


def unpack_blocks(blobs: Sequence[bytes | memoryview], values: BlockValues, rows: Int64) -> None:
    """Fill blocks ``rows`` (B,), whose voxels are all zero, with those that ``pack_blocks`` has packed.

    ``MapError``: bytes are no packed block with as many classes."""
    sizes = np.array([0, *map(len, blobs)], np.int64)
    count = 0
    if not (sizes % 4).any():
        ends = np.cumsum(sizes // 4)
        count = unpack_block_values(np.frombuffer(b"".join(blobs), np.float32), ends, values, rows)
    if count < len(rows):
        raise MapError(f"a packed block of {len(blobs[count])} bytes does not hold what it says; its disk fails")


@kernel
def packed_block_ends(weight: Float32, votes: Float32, rows: Int32, ends: Int64, classes: int) -> None:
    """Where packed blocks begin and end (B + 1,), in units of float32; ``rows`` (B,) of them."""


@kernel
def pack_block_values(values: BlockValues, rows: Int32, ends: Int64, data: Float32) -> None:
    """Write blocks ``rows`` (B,) as ``PackedBlocks`` says to ``data`` (N,), which is zero; ``ends`` (B + 1,)."""


@kernel
def unpack_block_values(data: Float32, ends: Int64, values: BlockValues, rows: Int64) -> int:
    """The reverse, onto voxels that are zero; how many were unpacked, fewer than B where one is damaged."""
    ...
