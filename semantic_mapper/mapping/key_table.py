"""Packed key -> version of the blocks on disk: 32 to 64 bytes a block, where a dict takes 115, and asked for many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import first_slot

ABSENT = -1  # packed keys and versions are never negative
_LEAST_SLOTS = 64


class KeyTable:
    """Open addressing; at most half of the slots are used. It never shrinks."""

    def __init__(self) -> None:
        self._count = 0
        self._keys, self._versions = _slots(_LEAST_SLOTS)

    def __len__(self) -> int:
        return self._count

    def find(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Versions (B,) of keys (B,), ``ABSENT`` where there is none."""
        return _find(self._keys, self._versions, keys)

    def items(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Keys (B,) and versions (B,), in no order that means anything."""
        used = np.flatnonzero(self._keys != ABSENT)
        return self._keys[used], self._versions[used]

    def put(self, keys: NDArray[np.int64], versions: NDArray[np.int64]) -> None:
        """Set the versions (B,) of keys (B,), new or not."""
        if 2 * (self._count + len(keys)) > len(self._keys):
            held = self.items()
            self._keys, self._versions = _slots(1 << int(4 * (self._count + len(keys)) - 1).bit_length())
            _put(self._keys, self._versions, *held)
        self._count += _put(self._keys, self._versions, keys, versions)

    def remove(self, keys: NDArray[np.int64]) -> None:
        """Forget keys (B,); those that are not there do no harm."""
        self._count -= _remove(self._keys, self._versions, keys)


def _slots(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return np.full(count, ABSENT, np.int64), np.full(count, ABSENT, np.int64)


@kernel(inline=True)
def _slot_of(slot_keys, key):
    """Where a key is, or where it would go."""
    last = len(slot_keys) - 1
    slot = first_slot(key, len(slot_keys))
    while slot_keys[slot] != ABSENT and slot_keys[slot] != key:
        slot = (slot + 1) & last
    return slot


@kernel()
def _find(slot_keys, slot_versions, keys):
    found = np.empty(len(keys), np.int64)
    for i in range(len(keys)):
        found[i] = slot_versions[_slot_of(slot_keys, keys[i])]
    return found


@kernel()
def _put(slot_keys, slot_versions, keys, versions):
    """Returns how many are new."""
    new = 0
    for i in range(len(keys)):
        slot = _slot_of(slot_keys, keys[i])
        new += slot_keys[slot] == ABSENT
        slot_keys[slot] = keys[i]
        slot_versions[slot] = versions[i]
    return new


@kernel()
def _remove(slot_keys, slot_versions, keys):
    """Returns how many were there. What comes after a gap moves up, so that no search ends too early."""
    gone, last = 0, len(slot_keys) - 1
    for i in range(len(keys)):
        gap = _slot_of(slot_keys, keys[i])
        if slot_keys[gap] == ABSENT:
            continue
        gone += 1
        slot = (gap + 1) & last
        while slot_keys[slot] != ABSENT:
            first = first_slot(slot_keys[slot], len(slot_keys))
            if ((slot - first) & last) >= ((slot - gap) & last):  # its search begins at the gap or before
                slot_keys[gap], slot_versions[gap] = slot_keys[slot], slot_versions[slot]
                gap = slot
            slot = (slot + 1) & last
        slot_keys[gap] = slot_versions[gap] = ABSENT
    return gone
