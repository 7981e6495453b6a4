"""Block key -> buffer index, as an open-addressing table that compiled kernels can read.

Open3D has its own hash map, but only its own kernels can ask it. A block key is the block's integer coordinate
(x, y, z); three of them packed into one int64 sort like the triple.

Numba caches compiled callers by the time stamp of *their* file: after a change here, delete ``__pycache__`` (the tests
do so themselves).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernel_cache import kernel

KEY_BITS = 21
KEY_LIMIT = 1 << (KEY_BITS - 1)  # |coordinate| must stay below: 167 km at 2 cm voxels
_KEY_MASK = (1 << KEY_BITS) - 1
_EMPTY = -1
_HASH_FACTOR = -7046029254386353131  # 2^64 / golden ratio as int64


class BlockIndex(NamedTuple):
    """(S,) int64 packed keys (-1 = empty slot) and (S,) int32 buffer indices; S is a power of two."""

    slot_keys: NDArray[np.int64]
    slot_values: NDArray[np.int32]


def make_block_index(keys: NDArray[np.int32], values: NDArray[np.int32]) -> BlockIndex:
    """Build the table of keys (B, 3) with values (B,); at most half of the slots are used."""
    slots = 1 << max(6, int(2 * len(keys)).bit_length() + 1)
    index = BlockIndex(np.full(slots, _EMPTY, np.int64), np.zeros(slots, np.int32))
    insert_blocks(index, pack_keys(keys), values)
    return index


def has_room(index: BlockIndex, count: int) -> bool:
    """Whether the table stays at most half full with ``count`` keys."""
    return 2 * count <= len(index.slot_keys)


def pack_keys(keys: NDArray[np.int32]) -> NDArray[np.int64]:
    """(B, 3) -> (B,); the order of packed keys is the lexicographic order of the triples."""
    wide = keys.astype(np.int64) + KEY_LIMIT
    return (wide[:, 0] << (2 * KEY_BITS)) | (wide[:, 1] << KEY_BITS) | wide[:, 2]


def unpack_keys(packed: NDArray[np.int64]) -> NDArray[np.int32]:
    """(B,) -> (B, 3)."""
    parts = (packed >> (2 * KEY_BITS), (packed >> KEY_BITS) & _KEY_MASK, packed & _KEY_MASK)
    return (np.stack(parts, axis=1) - KEY_LIMIT).astype(np.int32)


@kernel(inline=True)
def pack_key(bx, by, bz):
    """One packed key of integer coordinates."""
    limit = np.int64(KEY_LIMIT)
    return ((np.int64(bx) + limit) << (2 * KEY_BITS)) | ((np.int64(by) + limit) << KEY_BITS) | (np.int64(bz) + limit)


@kernel(inline=True)
def pack_step(axis, sign):
    """What to add to a packed key for the next block along an axis, in the direction of ``sign``."""
    step = np.int64(1) << ((2 - axis) * KEY_BITS)
    return step if sign > 0 else -step


@kernel(inline=True)
def key_part(packed, axis):
    """One coordinate of a packed key."""
    return ((packed >> ((2 - axis) * KEY_BITS)) & _KEY_MASK) - KEY_LIMIT


@kernel(inline=True)
def first_slot(packed, slot_count):
    """Where the search for a key begins."""
    h = packed * np.int64(_HASH_FACTOR)
    return (h ^ (h >> np.int64(29))) & np.int64(slot_count - 1)


@kernel()
def find_block(index, packed):
    """Buffer index of a packed key, -1 where there is no such block."""
    slots = len(index.slot_keys)
    slot = first_slot(packed, slots)
    while True:
        key = index.slot_keys[slot]
        if key == packed:
            return np.int64(index.slot_values[slot])
        if key == _EMPTY:
            return np.int64(-1)
        slot = (slot + 1) & (slots - 1)


@kernel()
def find_blocks(index, packed):
    """Buffer indices (B,) int32 of packed keys (B,), -1 where there is no such block."""
    found = np.empty(len(packed), np.int32)
    for i in range(len(packed)):
        found[i] = find_block(index, packed[i])
    return found


@kernel()
def insert_blocks(index, packed, values):
    """Add keys that are not in the table yet."""
    slots = len(index.slot_keys)
    for i in range(len(packed)):
        slot = first_slot(packed[i], slots)
        while index.slot_keys[slot] != _EMPTY:
            slot = (slot + 1) & (slots - 1)
        index.slot_keys[slot] = packed[i]
        index.slot_values[slot] = values[i]
