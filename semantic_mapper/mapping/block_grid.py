"""Storage of the map: Open3D's sparse voxel blocks, with numpy views of their buffers and growth in bounded steps.

A block holds 8 x 8 x 8 voxels in the order [z][y][x]; voxel (i, j, k) of block (x, y, z) is the point
``(8 * (x, y, z) + (i, j, k)) * voxel_size_m`` in the world.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.block_index import (
    BlockIndex,
    find_blocks,
    has_room,
    insert_blocks,
    make_block_index,
    pack_keys,
    unpack_keys,
)
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.types import Float32

BLOCK_SIDE = 8
BLOCK_VOXELS = BLOCK_SIDE**3
ATTRIBUTES = ("tsdf", "weight", "color", "evidence", "votes")

_log = structlog.get_logger(__name__)


class GridBuffers(NamedTuple):
    """Zero-copy views of the grid's memory, valid until the next ``BlockGrid.activate``.

    Args:
        keys: (capacity, 3) int32 block coordinates.
        tsdf: (capacity, 512) float32, signed distance over truncation in [-1, 1].
        weight: (capacity, 512) float32, number of depth measurements (capped).
        color: (capacity, 512, 3) float32 in 0..255.
        evidence: (capacity, 512, L) float32, weighted sum of log probabilities.
        votes: (capacity, 512) float32, sum of vote weights.
    """

    keys: NDArray[np.int32]
    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: Float32
    votes: Float32


class BlockGrid:
    """A VoxelBlockGrid that grows by half when full and never past ``max_blocks``.

    Args:
        voxel_size_m: Edge of a voxel.
        classes: L, channels of the class evidence.
        initial_blocks: Capacity at start.
        max_blocks: Capacity at most.
    """

    def __init__(self, voxel_size_m: float, classes: int, initial_blocks: int, max_blocks: int) -> None:
        self._o3d = load_open3d()
        self._max_blocks = max_blocks
        self._voxel_size_m = voxel_size_m
        channels = (1, 1, 3, classes, 1)
        self._block_bytes = 4 * BLOCK_VOXELS * sum(channels) + 12
        self._grid = make_open3d_grid(voxel_size_m, channels, max(1, min(initial_blocks, max_blocks)))
        self._map = self._grid.hashmap()
        self._index = make_block_index(np.empty((0, 3), np.int32), np.empty(0, np.int32))

    @property
    def grid(self) -> Any:
        """The ``open3d.t.geometry.VoxelBlockGrid`` itself."""
        return self._grid

    @property
    def index(self) -> BlockIndex:
        """Block key -> buffer index; valid until the next ``activate``."""
        return self._index

    @property
    def block_count(self) -> int:
        """Blocks in the map."""
        return int(self._map.size())

    @property
    def capacity(self) -> int:
        """Blocks there is memory for."""
        return int(self._map.capacity())

    @property
    def memory_bytes(self) -> int:
        """Bytes held for voxels and block tables, used or not."""
        return self.capacity * self._block_bytes + self._index.slot_keys.nbytes + self._index.slot_values.nbytes

    def buffers(self) -> GridBuffers:
        """Views of the present buffers. Take them anew after every ``activate``: growth moves the memory."""
        tsdf, weight, color, evidence, votes = (self._map.value_tensor(i).numpy() for i in range(len(ATTRIBUTES)))
        n = len(tsdf)
        return GridBuffers(
            keys=self._map.key_tensor().numpy(),
            tsdf=tsdf.reshape(n, BLOCK_VOXELS),
            weight=weight.reshape(n, BLOCK_VOXELS),
            color=color.reshape(n, BLOCK_VOXELS, 3),
            evidence=evidence.reshape(n, BLOCK_VOXELS, -1),
            votes=votes.reshape(n, BLOCK_VOXELS),
        )

    def sorted_blocks(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Keys (B, 3) in lexicographic order and their buffer indices (B,)."""
        indices = self._map.active_buf_indices().numpy().astype(np.int32)
        keys = self._map.key_tensor().numpy()[indices]
        order = np.argsort(pack_keys(keys))
        return keys[order], indices[order]

    def activate(self, packed: NDArray[np.int64]) -> NDArray[np.int32]:
        """Make sure that the blocks of unique packed keys (B,) exist, new ones zeroed; return buffer indices (B,).

        Raises:
            MapError: where the map would exceed ``max_blocks``; nothing has changed then.
        """
        found = find_blocks(self._index, packed)
        new = packed[found < 0]
        if not len(new):
            return found
        needed = self.block_count + len(new)
        if needed > self._max_blocks:
            raise MapError(
                f"the map is full: {self.block_count} blocks, {len(new)} more asked for, limit {self._max_blocks} "
                f"(voxel_map.max_blocks; {self._block_bytes / 1024:.0f} KiB a block). Raise the limit, use larger "
                "voxels, or start a new map; what is in this one stays usable"
            )
        if needed > self.capacity:
            self._grow(needed)
        added = self._add(new)
        self._zero(added)
        return find_blocks(self._index, packed)

    def _grow(self, needed: int) -> None:
        capacity = min(max(needed, self.capacity + self.capacity // 2), self._max_blocks)
        _log.debug("map_grows", blocks=self.block_count, capacity=capacity)
        self._map.reserve(capacity)  # moves the memory and renumbers the blocks
        keys, indices = self.sorted_blocks()
        self._index = make_block_index(keys, indices)

    def _add(self, packed: NDArray[np.int64]) -> NDArray[np.int32]:
        keys = np.ascontiguousarray(unpack_keys(packed))
        indices, inserted = self._map.activate(self._o3d.core.Tensor.from_numpy(keys))
        if not bool(inserted.numpy().all()):  # the index says that they were not there: the two tables disagree
            raise MapError(f"block table and Open3D's hash map disagree about {len(keys)} new blocks; this is a bug")
        added = indices.numpy().astype(np.int32)
        if not has_room(self._index, self.block_count):
            self._index = make_block_index(*self.sorted_blocks())
        else:
            insert_blocks(self._index, packed, added)
        return added

    def _zero(self, added: NDArray[np.int32]) -> None:
        """Open3D hands out memory as its last user left it."""
        for view in self.buffers()[1:]:
            view[added] = 0


def make_open3d_grid(voxel_size_m: float, channels: tuple[int, ...], capacity: int) -> Any:
    """An empty VoxelBlockGrid on the CPU with float32 attributes named as in ``ATTRIBUTES``."""
    o3d = load_open3d()
    names = ATTRIBUTES[: len(channels)]
    dtypes = (o3d.core.float32,) * len(channels)
    shapes = tuple((c,) for c in channels)
    device = o3d.core.Device("CPU:0")
    return o3d.t.geometry.VoxelBlockGrid(names, dtypes, shapes, voxel_size_m, BLOCK_SIDE, capacity, device)
