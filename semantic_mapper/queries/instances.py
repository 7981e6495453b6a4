"""Countable things in a map, with ids that stay with them while the map grows."""

from __future__ import annotations

import threading
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.mapping.changes import CONFIDENCE_STEPS
from semantic_mapper.queries.checks import check_direction
from semantic_mapper.queries.components import Components, find_components
from semantic_mapper.queries.oriented_box import OrientedBox, upright_box
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import Float64

MIN_VOXELS = 30  # 120 cm^2 of surface at 2 cm: less is mostly stray votes
LEAST_OVERLAP = 0.1  # of an instance's voxels must be found again in what it became


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """One thing: a connected piece of surface of one class.

    Args:
        id: Above 0; stays with the thing from update to update, and is never given to another.
        class_id, class_name: Of the label set.
        confidence: Mean over its voxels.
        centroid: (3,) float64 mean of its surface points, world metres.
        box: Upright box round its surface points.
        voxels: (N, 3) int32 coordinates of its surface voxels; centres at ``voxels * voxel_size_m``.
    """

    id: int
    class_id: int
    class_name: str
    confidence: float
    centroid: Float64
    box: OrientedBox
    voxels: NDArray[np.int32]


class InstanceTracker:
    """Finds the instances of one map again and again.

    An instance is what an earlier one became where it holds the most of that one's voxels, and at least a tenth. Of
    several that became one, the oldest id stays; of a split, the part with the most voxels keeps the id. Matching looks
    at the last update alone: a thing that was not found in it comes back under a new id. Safe to call from several
    threads.

    Args:
        stuff: Names of classes that are no things; by default ``labels.STUFF_NAMES``.
        min_voxels: Smaller pieces are left out.
        up: (3,) direction in the world along which boxes stand.

    Raises:
        MapError: ``min_voxels`` below 1, or ``up`` without a direction.
    """

    def __init__(
        self,
        stuff: Collection[str] = STUFF_NAMES,
        min_voxels: int = MIN_VOXELS,
        up: ArrayLike = (0.0, 0.0, 1.0),
    ) -> None:
        if min_voxels < 1:
            raise MapError(f"min_voxels must be at least 1, got {min_voxels}")
        self._stuff = frozenset(stuff)
        self._min_voxels = min_voxels
        self._up = check_direction(up, "up")
        if self._up.shape != (3,):
            raise MapError(f"up: expected shape (3,), got {np.shape(up)}")
        self._next_id = 1
        self._packed = np.empty(0, np.int64)  # blocks with instances at the last update, sorted
        self._owner = np.empty((0, 512), np.int64)  # id of each of their voxels, 0 = none
        self._lock = threading.Lock()

    def update(self, snapshot: MapSnapshot) -> tuple[Instance, ...]:
        """The instances of the map as it is now, by ascending id."""
        found = find_components(snapshot, snapshot.label_set.thing_ids(self._stuff), self._min_voxels)
        with self._lock:
            ids = self._match(snapshot, found)
            self._remember(snapshot, found, ids)
        order = np.argsort(found.component, kind="stable")
        ends = np.cumsum(np.bincount(found.component, minlength=len(ids)))
        parts = np.split(order, ends[:-1]) if len(ids) else []
        things = [self._describe(snapshot, found, part, int(i)) for part, i in zip(parts, ids, strict=True)]
        return tuple(sorted(things, key=lambda thing: thing.id))

    def _match(self, snapshot: MapSnapshot, found: Components) -> NDArray[np.int64]:
        """Id (C,) of each component."""
        old = self._owners(snapshot, found)
        sizes = np.bincount(self._owner[self._owner > 0])
        ids = np.zeros(int(found.component.max(initial=-1)) + 1, np.int64)
        pairs, counts = np.unique(np.stack((old, found.component)), axis=1, return_counts=True)
        for i in np.unique(old[old > 0]):  # ascending, so that the oldest of several has its component first
            overlaps = np.where(pairs[0] == i, counts, 0)
            best = int(np.argmax(overlaps))
            successor = pairs[1, best]
            if overlaps[best] >= LEAST_OVERLAP * sizes[i] and ids[successor] == 0:
                ids[successor] = i
        new = np.flatnonzero(ids == 0)
        ids[new] = self._next_id + np.arange(len(new))
        self._next_id += len(new)
        return ids

    def _owners(self, snapshot: MapSnapshot, found: Components) -> NDArray[np.int64]:
        """Id that each voxel (N,) had at the last update, 0 = none."""
        if not len(self._packed):
            return np.zeros(len(found.voxel), np.int64)
        packed = snapshot.packed[found.row]
        at = np.minimum(np.searchsorted(self._packed, packed), len(self._packed) - 1)
        return np.where(self._packed[at] == packed, self._owner[at, found.voxel], 0)

    def _remember(self, snapshot: MapSnapshot, found: Components, ids: NDArray[np.int64]) -> None:
        used, block = np.unique(found.row, return_inverse=True)
        self._packed = snapshot.packed[used]
        self._owner = np.zeros((len(used), 512), np.int64)
        self._owner[block, found.voxel] = ids[found.component]

    def _describe(self, snapshot: MapSnapshot, found: Components, part: NDArray[np.int64], number: int) -> Instance:
        row, voxel = found.row[part], found.voxel[part]
        class_id = int(found.label[part[0]])
        xyz = found.point[part] * snapshot.voxel_size_m
        confidence = snapshot.voxels.confidence[snapshot.slots[row], voxel].mean(dtype=np.float64) / CONFIDENCE_STEPS
        within = np.stack((voxel & 7, (voxel >> 3) & 7, voxel >> 6), axis=1)
        labels = snapshot.label_set
        return Instance(
            number,
            class_id,
            labels.names[labels.ids.index(class_id)],
            float(confidence),
            xyz.mean(axis=0),
            upright_box(xyz, self._up),
            snapshot.keys[row] * 8 + within.astype(np.int32),
        )
