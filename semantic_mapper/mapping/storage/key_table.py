"""Packed key -> version of the blocks on disk: 32 to 64 bytes a block, where a dict takes 115, and asked for many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.types import Int64

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
        found = np.empty(len(keys), np.int64)
        key_table_find(self._keys, self._versions, np.ascontiguousarray(keys), found)
        return found

    def items(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Keys (B,) and versions (B,), in no order that means anything."""
        used = np.flatnonzero(self._keys != ABSENT)
        return self._keys[used], self._versions[used]

    def put(self, keys: NDArray[np.int64], versions: NDArray[np.int64]) -> None:
        """Set the versions (B,) of keys (B,), new or not."""
        if 2 * (self._count + len(keys)) > len(self._keys):
            held = self.items()
            self._keys, self._versions = _slots(1 << int(4 * (self._count + len(keys)) - 1).bit_length())
            key_table_put(self._keys, self._versions, *held)
        keys, versions = np.ascontiguousarray(keys), np.ascontiguousarray(versions)
        self._count += key_table_put(self._keys, self._versions, keys, versions)

    def remove(self, keys: NDArray[np.int64]) -> None:
        """Forget keys (B,); those that are not there do no harm."""
        self._count -= key_table_remove(self._keys, self._versions, np.ascontiguousarray(keys))


def _slots(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return np.full(count, ABSENT, np.int64), np.full(count, ABSENT, np.int64)


@kernel
def key_table_find(slot_keys: Int64, slot_versions: Int64, keys: Int64, found: Int64) -> None:
    """Versions of keys."""
    ...


@kernel
def key_table_put(slot_keys: Int64, slot_versions: Int64, keys: Int64, versions: Int64) -> int:
    """Returns how many are new."""
    ...


@kernel
def key_table_remove(slot_keys: Int64, slot_versions: Int64, keys: Int64) -> int:
    """Returns how many were there."""
    ...
