"""One state of a mirrored map, which never changes: what all queries look at."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.storage.block_index import BlockIndex, unpack_keys
from semantic_mapper.mapping.storage.changes import (
    CONFIDENCE_STEPS,
    NONE_CLEARED,
    TSDF_STEPS,
    BlockChanges,
    ClearedBlocks,
    oldest_first,
)
from semantic_mapper.types import Bool, Float32, Float64, Int64, UInt8

COMPUTED, MEASURED = 1, 2  # ``BlockVoxels.weight``: depth was computed, or a sensor measured it


class BlockVoxels(NamedTuple):
    """Voxels of S block slots, in the order [z][y][x]; ``tsdf`` and ``weight`` have the names ``march`` knows.

    Args:
        tsdf: (S, 512) int8 signed distance over truncation, times 127.
        weight: (S, 512) uint8, 0 where not observed, ``COMPUTED`` where observed, ``MEASURED`` where by a sensor.
        label: (S, 512) uint8 class ids, the ignore id where nothing voted or the map is too unsure.
        confidence: (S, 512) uint8 probability of the likeliest class, times 255; 0 where nothing voted.
        rgb: (S, 512, 3) uint8.
        classes: (S, 4) uint64, a bit for each class id that a surface voxel of the block may have.
    """

    tsdf: NDArray[np.int8]
    weight: UInt8
    label: UInt8
    confidence: UInt8
    rgb: UInt8
    classes: NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class MapSnapshot:
    """A map as it was at one version. Immutable, so any number of threads may query it.

    Args:
        version, epoch: ``VoxelMap``'s of that state.
        voxel_size_m: Edge of a voxel.
        truncation_voxels: Of the TSDF.
        label_set: Of the map.
        packed: (B,) int64 sorted packed keys of the blocks.
        slots: (B,) int32 where each of them lies in ``voxels``.
        serials: (B,) int64; in this process no two contents of a block have the same, in whichever mirror.
        versions: (B,) int64 version that each block came with, at most ``version``.
        index: The same as a table for compiled code.
        voxels: Memory shared with other snapshots; only ``slots`` of it belong to this one.
        scale_known: Whether lengths are metres.
        cleared: Which blocks lost surface that frames saw through, and when; the latest.
        moving: (M, 3) int64 voxels where something moves that is left out of the map; see ``with_moving``.
    """

    version: int
    epoch: int
    voxel_size_m: float
    truncation_voxels: float
    label_set: LabelSet
    packed: NDArray[np.int64]
    slots: NDArray[np.int32]
    serials: NDArray[np.int64]
    versions: NDArray[np.int64]
    index: BlockIndex
    voxels: BlockVoxels
    scale_known: bool = True
    cleared: ClearedBlocks = NONE_CLEARED
    moving: Int64 = field(default_factory=lambda: np.empty((0, 3), np.int64))

    @property
    def block_count(self) -> int:
        """Blocks of 8^3 voxels."""
        return len(self.packed)

    @property
    def keys(self) -> NDArray[np.int32]:
        """(B, 3) block coordinates in lexicographic order."""
        return unpack_keys(self.packed)

    def with_moving(self, points: Float32) -> MapSnapshot:
        """This state with what moves at points (N, 3), world metres, as ``mapping.moving.MovingSpace`` has them."""
        if not len(points):
            return self
        return replace(self, moving=np.unique(np.floor(points / self.voxel_size_m + 0.5).astype(np.int64), axis=0))

    def read(self, slot: NDArray[np.int64], voxel: NDArray[np.int64]) -> tuple[UInt8, Float32, UInt8]:
        """Label (N,), confidence (N,) and rgb (N, 3) of voxels (N,); ignore id, 0 and black where ``slot`` is -1."""
        there, voxels = slot >= 0, self.voxels
        label = np.where(there, voxels.label[slot, voxel], self.label_set.ignore_id).astype(np.uint8)
        steps = np.where(there, voxels.confidence[slot, voxel], 0)
        rgb = np.where(there[:, None], voxels.rgb[slot, voxel], 0).astype(np.uint8)
        return label, (steps / np.float32(CONFIDENCE_STEPS)).astype(np.float32), rgb

    def measured(self, slot: NDArray[np.int64], voxel: NDArray[np.int64]) -> Bool:
        """Whether a sensor measured voxels (N,); False where ``slot`` is -1."""
        return (slot >= 0) & (self.voxels.weight[slot, voxel] == MEASURED)

    @property
    def voxels_per_step(self) -> float:
        """Length of one step of the quantised TSDF, in voxels."""
        return self.truncation_voxels / TSDF_STEPS

    def changes(self, since: int, limit: int = 0) -> BlockChanges:
        """As ``VoxelMap.changes``: what another mirror needs to follow this one.

        Whole ``MapMirror.apply`` take the place of whole versions, so ``limit`` stops only between two of them.

        Raises:
            MapError: ``since`` is not a version of this map, or a negative ``limit``.
        """
        if not 0 <= since <= self.version or limit < 0:
            raise MapError(
                f"changes since version {since}, limit {limit}: versions go from 0 to {self.version}, and a limit is "
                "not negative; a mirror of another map restarts from version 0"
            )
        later = np.flatnonzero(self.versions > since)
        chosen, version = oldest_first(self.versions[later], limit, self.version)
        rows = later[chosen]
        slots, voxels = self.slots[rows], self.voxels
        return BlockChanges(
            since,
            version,
            self.version,
            self.epoch,
            self.keys[rows],
            voxels.tsdf[slots],
            voxels.label[slots],
            voxels.confidence[slots],
            voxels.rgb[slots],
            self.scale_known,
            (voxels.weight[slots] == COMPUTED).astype(np.uint8),
            self.cleared.between(since, version),
        )


class BlockAges:
    """Follows the snapshots of a map; what was there in the first one counts as changed then."""

    def __init__(self) -> None:
        self._packed = np.empty(0, np.int64)
        self._serials = np.empty(0, np.int64)
        self._changed_s = np.empty(0, np.float64)

    def follow(self, snapshot: MapSnapshot, now_s: float) -> Float64:
        """Seconds (B,) since each block of a snapshot last changed, as seen here.

        Args:
            snapshot: A later one than before, of whichever mirror.
            now_s: When the map was like this, on any one clock.
        """
        changed_s = np.full(snapshot.block_count, now_s)
        if len(self._packed):
            row = np.minimum(np.searchsorted(self._packed, snapshot.packed), len(self._packed) - 1)
            same = (self._packed[row] == snapshot.packed) & (self._serials[row] == snapshot.serials)
            changed_s[same] = self._changed_s[row[same]]
        self._packed, self._serials, self._changed_s = snapshot.packed, snapshot.serials, changed_s
        return now_s - changed_s
