"""One state of a map, which never changes, and mirrors that follow a map by its changes; all queries look at these.

Neither needs Open3D or the map's own process. Blocks are written once, one behind the other, into a pool; a snapshot is
a table of where its blocks lie, so that an old one stays as it was. A full pool is replaced by a larger one with only
the living blocks; the old pool goes when its last snapshot does."""

from __future__ import annotations

import itertools
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import LabelError, MapError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.blocks import BLOCK_VOXELS, KEY_LIMIT, BlockIndex, make_block_index, pack_keys, unpack_keys
from semantic_mapper.mapping.changes import (
    CONFIDENCE_STEPS,
    NONE_CLEARED,
    TSDF_STEPS,
    UNOBSERVED,
    BlockChanges,
    ClearedBlocks,
    oldest_first,
)
from semantic_mapper.mapping.map_file import open_map
from semantic_mapper.types import Bool, Float32, Int64, UInt8

if TYPE_CHECKING:
    from semantic_mapper.mapping.voxel_map import VoxelMap

NEAREST_STEPS = 60  # farther from zero, a voxel is the nearer end of no crossing of the TSDF; as in surface.h
LEAST_SPARE = 256  # blocks that a new pool has room for beyond the living ones; or half of these, if that is more
_LOOKED_AT_AT_ONCE = 512  # blocks

_deliveries = itertools.count()  # that mirrors of this process have taken over; counting takes no lock
COMPUTED, MEASURED = 1, 2  # ``BlockVoxels.weight``: depth was computed, or a sensor measured it


class BlockVoxels(NamedTuple):
    """Voxels of S block slots, in the order [z][y][x]; ``tsdf`` and ``weight`` have the names ``march`` knows."""

    tsdf: NDArray[np.int8]  # (S, 512) int8 signed distance over truncation, times 127
    weight: UInt8  # (S, 512) uint8, 0 where not observed, ``COMPUTED`` where observed, ``MEASURED`` where by a sensor
    label: UInt8  # (S, 512) uint8 class ids, the ignore id where nothing voted or the map is too unsure
    confidence: UInt8  # (S, 512) uint8 probability of the likeliest class, times 255; 0 where nothing voted
    rgb: UInt8  # (S, 512, 3) uint8
    classes: NDArray[np.uint64]  # (S, 4) uint64, a bit for each class id that a surface voxel of the block may have


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class MapSnapshot:
    """A map as it was at one version. Immutable, so any number of threads may query it."""

    # version, epoch: ``VoxelMap``'s of that state.
    version: int
    epoch: int
    voxel_size_m: float  # edge of a voxel
    truncation_voxels: float  # of the TSDF
    label_set: LabelSet  # of the map
    packed: NDArray[np.int64]  # (B,) int64 sorted packed keys of the blocks
    slots: NDArray[np.int32]  # (B,) int32 where each of them lies in ``voxels``
    # (B,) int64; in this process no two contents of a block have the same, in whichever mirror
    serials: NDArray[np.int64]
    versions: NDArray[np.int64]  # (B,) int64 version that each block came with, at most ``version``
    index: BlockIndex  # the same as a table for compiled code
    voxels: BlockVoxels  # memory shared with other snapshots; only ``slots`` of it belong to this one
    scale_known: bool = True  # whether lengths are metres
    cleared: ClearedBlocks = NONE_CLEARED  # which blocks lost surface that frames saw through, and when; the latest
    # (M, 3) int64 voxels where something moves that is left out of the map; see ``with_moving``
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
        """As ``VoxelMap.changes``: what another mirror needs to follow this one. Whole ``MapMirror.apply`` take the
        place of whole versions. ``MapError``: ``since`` is not a version of this map, or a negative ``limit``."""
        later = np.flatnonzero(self.versions > since)
        chosen, version = oldest_first(self.versions[later], since, limit, self.version)
        rows = later[chosen]
        slots, voxels = self.slots[rows], self.voxels
        computed = (voxels.weight[slots] == COMPUTED).astype(np.uint8)
        blocks = self.keys[rows], voxels.tsdf[slots], voxels.label[slots], voxels.confidence[slots], voxels.rgb[slots]
        of_map = since, version, self.version, self.epoch
        return BlockChanges(*of_map, *blocks, self.scale_known, computed, self.cleared.between(since, version))


class MapMirror:
    """Follows a map by its changes and hands out snapshots of it. Safe to use from several threads."""

    def __init__(self, voxel_size_m: float, truncation_voxels: float, label_set: LabelSet) -> None:
        none = np.empty(0, np.int64)
        slots = np.empty(0, np.int32)
        index = make_block_index(unpack_keys(none), slots)
        self._snapshot = MapSnapshot(
            0, 0, voxel_size_m, truncation_voxels, label_set, none, slots, none, none, index, _new_pool(LEAST_SPARE)
        )
        self._next = self._snapshot  # ahead of it while a new epoch of the map is not complete
        self._used = 0
        self._lock = threading.Lock()

    @classmethod
    def of(cls, voxel_map: VoxelMap) -> MapMirror:
        """Mirror of a live or loaded map as it is now; further ``changes`` since its version may be applied."""
        mirror = cls(voxel_map.config.voxel_size_m, voxel_map.config.truncation_voxels, voxel_map.label_set)
        mirror.apply(voxel_map.changes(0))
        return mirror

    @classmethod
    def load(cls, path: Path) -> MapMirror:
        """Mirror of a saved map, without its class evidence in memory; ``MapError`` as of ``VoxelMap.load``."""
        with open_map(path) as reader:
            saved, config = reader.manifest, reader.manifest.config
            mirror = cls(config.voxel_size_m, config.truncation_voxels, saved.label_set)
            try:
                mirror._next = replace(mirror._next, voxels=_new_pool(saved.blocks))
            except MemoryError as error:
                raise MapError(f"{path}: no memory for its {saved.blocks:,} blocks: {error}") from error
            for changes in reader.changes():
                mirror.apply(changes)
        return mirror

    @property
    def version(self) -> int:
        """What to ask the map's next ``changes`` with."""
        return self._next.version

    @property
    def is_whole(self) -> bool:
        """Whether the snapshot has all that was applied: not while blocks of a new epoch of the map are missing."""
        return self._next is self._snapshot

    def snapshot(self) -> MapSnapshot:
        """The present state; stays as it is whatever is applied later."""
        return self._snapshot

    def apply(self, changes: BlockChanges) -> MapSnapshot:
        """Take over changes and return the present state; after a new epoch, the last one of the old epoch until all
        has come.

        ``MapError``: changes that do not continue the mirror's version, or damaged ones; ``LabelError``: a class id
        that is not in the label set. The mirror is as it was then."""
        packed = _check(changes, self._snapshot.label_set)
        with self._lock:
            old = self._next
            if not changes.since <= old.version <= changes.version:
                raise MapError(
                    f"changes from version {changes.since} to {changes.version} do not continue a mirror at version "
                    f"{old.version}; ask the map for its changes since {old.version}"
                )
            staying = ~np.isin(old.packed, packed) & (changes.epoch == old.epoch)
            merged = np.concatenate((old.packed[staying], packed))
            pool, kept = self._make_room(old, old.slots[staying], len(packed))
            slots = np.concatenate((kept, np.arange(self._used, self._used + len(packed), dtype=np.int32)))
            _write(pool, self._used, changes, old.label_set.ignore_id)
            self._used += len(packed)
            fresh = (next(_deliveries) << 32) + np.arange(len(packed))
            serials = np.concatenate((old.serials[staying], fresh))
            versions = np.concatenate((old.versions[staying], np.full(len(packed), changes.version)))
            order = np.argsort(merged)
            merged, slots = merged[order], slots[order]
            index = make_block_index(unpack_keys(merged), slots)
            self._next = replace(
                old,
                version=changes.version,
                epoch=changes.epoch,
                packed=merged,
                slots=slots,
                serials=serials[order],
                versions=versions[order],
                index=index,
                voxels=pool,
                scale_known=changes.scale_known,
                cleared=old.cleared.followed_by(changes.cleared.between(old.version, changes.version)),
            )
            if changes.epoch == self._snapshot.epoch or changes.version >= changes.newest:
                self._snapshot = self._next
            return self._snapshot

    def _make_room(self, old: MapSnapshot, kept: NDArray[np.int32], more: int) -> tuple[BlockVoxels, NDArray[np.int32]]:
        """A pool with room for ``more`` blocks behind those in use, and where in it those in slots ``kept`` lie."""
        if self._used + more <= len(old.voxels.tsdf):
            return old.voxels, kept
        living = len(kept) + more
        pool = _new_pool(living + max(living // 2, LEAST_SPARE))
        for mine, theirs in zip(pool, old.voxels, strict=True):
            mine[: len(kept)] = theirs[kept]
        self._used = len(kept)
        return pool, np.arange(len(kept), dtype=np.int32)


def _new_pool(blocks: int) -> BlockVoxels:
    flat = (blocks, BLOCK_VOXELS)
    tsdf, rgb, classes = np.empty(flat, np.int8), np.empty((*flat, 3), np.uint8), np.empty((blocks, 4), np.uint64)
    weight, label, confidence = (np.empty(flat, np.uint8) for _ in range(3))
    return BlockVoxels(tsdf, weight, label, confidence, rgb, classes)


def _write(pool: BlockVoxels, start: int, changes: BlockChanges, ignore_id: int) -> None:
    # Part by part: what is computed of all voxels of a large map does not fit in memory. Classes are those of voxels
    # that lie near enough to a surface to be one of its own (``surface_voxels``).
    for first in range(0, len(changes.keys), _LOOKED_AT_AT_ONCE):
        rows = slice(first, min(first + _LOOKED_AT_AT_ONCE, len(changes.keys)))
        to = slice(start + rows.start, start + rows.stop)
        label, tsdf = changes.label[rows], changes.tsdf[rows]
        computed = 0 if changes.computed is None else changes.computed[rows]
        pool.tsdf[to], pool.label[to] = tsdf, label
        pool.confidence[to], pool.rgb[to] = changes.confidence[rows], changes.rgb[rows]
        pool.weight[to] = np.where(tsdf != UNOBSERVED, np.where(computed, COMPUTED, MEASURED), 0)
        at = np.flatnonzero((label != ignore_id) & (tsdf <= NEAREST_STEPS) & (tsdf >= -NEAREST_STEPS))
        has_class = np.zeros((len(tsdf), 256), np.bool_)
        has_class[at // BLOCK_VOXELS, label.ravel()[at]] = True
        pool.classes[to] = np.packbits(has_class, axis=1, bitorder="little").view("<u8")


def _check(changes: BlockChanges, label_set: LabelSet) -> NDArray[np.int64]:
    """Packed keys of changes that may come from a network."""
    blocks, where = len(changes.keys), f"changes up to version {changes.version}"
    forms: dict[str, tuple[Any, tuple[int, ...]]] = {"keys": (np.int32, (3,)), "tsdf": (np.int8, (BLOCK_VOXELS,))}
    forms |= dict.fromkeys(("label", "confidence", "computed"), (np.uint8, (BLOCK_VOXELS,)))
    forms |= {"rgb": (np.uint8, (BLOCK_VOXELS, 3))}
    for name, (dtype, tail) in forms.items():
        array: NDArray[np.generic] | None = getattr(changes, name)
        shape = (blocks, *tail)
        if array is not None and (array.dtype != dtype or array.shape != shape):
            got = f"{array.dtype.name} {array.shape}"
            raise MapError(f"{where}: {name} must be {np.dtype(dtype).name} {shape}, got {got}")
    if blocks and not -KEY_LIMIT <= changes.keys.min() <= changes.keys.max() < KEY_LIMIT:
        raise MapError(f"{where}: block coordinates beyond {KEY_LIMIT}")
    packed = pack_keys(changes.keys)
    if len(np.unique(packed)) != blocks:
        raise MapError(f"{where}: a block comes twice")
    if not np.isin(changes.label, [*label_set.ids, label_set.ignore_id]).all():
        foreign = sorted({int(i) for i in np.unique(changes.label)} - {*label_set.ids, label_set.ignore_id})
        raise LabelError(
            f"{where}: class ids {foreign} are not in label set '{label_set.name}'; the mirror was made for another map"
        )
    return packed
