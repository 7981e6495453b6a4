"""A mirror that others follow as they would follow the map itself, without asking the map a second time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.changes import BlockChanges, oldest_first
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.snapshot import MapSnapshot


class MirrorRelay:
    """Feeds a mirror and passes its changes on. One thread may ``apply``; all else is for any thread.

    Args:
        mirror: An empty one, which is fed through this relay alone.
    """

    def __init__(self, mirror: MapMirror) -> None:
        self._mirror = mirror
        # And of each block the version that it came with. Replaced as one, since other threads read both.
        self._state = mirror.snapshot(), np.empty(0, np.int64)

    def snapshot(self) -> MapSnapshot:
        """The present state of the mirror."""
        return self._state[0]

    def apply(self, changes: BlockChanges) -> MapSnapshot:
        """See ``MapMirror.apply``."""
        old, old_versions = self._state
        snapshot = self._mirror.apply(changes)
        if snapshot is old:  # a new epoch is not complete yet
            return snapshot
        count = snapshot.block_count
        # Of a new epoch as many versions as there are, so that ``limit`` finds some to stop at.
        versions = old.version + 1 + np.arange(count) * (snapshot.version - old.version) // max(count, 1)
        if snapshot.epoch == old.epoch:
            versions[np.searchsorted(snapshot.packed, old.packed)] = old_versions
            versions[np.searchsorted(snapshot.packed, pack_keys(changes.keys))] = snapshot.version
        self._state = snapshot, versions
        return snapshot

    def changes(self, since: int, limit: int = 0) -> BlockChanges:
        """As ``VoxelMap.changes``, as far as the mirror has come; whole deliveries take the place of whole versions.

        Raises:
            MapError: ``since`` is not a version of this map, or a negative ``limit``.
        """
        snapshot, versions = self._state
        if not 0 <= since <= snapshot.version or limit < 0:
            raise MapError(
                f"changes since version {since}, limit {limit}: versions go from 0 to {snapshot.version}, and a limit "
                "is not negative; a mirror of another map starts anew from version 0"
            )
        later: NDArray[np.int64] = np.flatnonzero(versions > since)
        chosen, version = oldest_first(versions[later], limit, snapshot.version)
        rows = later[chosen]
        slots, voxels = snapshot.slots[rows], snapshot.voxels
        return BlockChanges(
            since,
            version,
            snapshot.version,
            snapshot.epoch,
            snapshot.keys[rows],
            voxels.tsdf[slots],
            voxels.label[slots],
            voxels.confidence[slots],
            voxels.rgb[slots],
        )
