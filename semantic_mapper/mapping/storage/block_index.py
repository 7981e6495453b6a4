"""Block key -> buffer index, as an open-addressing table that compiled kernels can read (``block_index.h``).

A block key is the block's integer coordinate
(x, y, z); three of them packed into one int64 sort like the triple.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semantic_mapper.kernels import kernel
from semantic_mapper.types import Int32, Int64

KEY_BITS = 21
KEY_LIMIT = 1 << (KEY_BITS - 1)  # |coordinate| must stay below: 167 km at 2 cm voxels
_KEY_MASK = (1 << KEY_BITS) - 1
_EMPTY = -1


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
    ...


@kernel
def _find_block_indices(index: BlockIndex, packed: Int64, found: Int32) -> None: ...
