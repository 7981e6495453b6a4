"""The nearest surface of a class, by a search over blocks from near to far: nothing to rebuild when the map changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import key_part
from semantic_mapper.mapping.changes import CONFIDENCE_STEPS
from semantic_mapper.queries.checks import check_point
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import neighbour_slots, surface_offset
from semantic_mapper.types import Float64


@dataclass(frozen=True, slots=True, eq=False)
class NearestSurface:
    """A place of the class that was asked for.

    Args:
        xyz: (3,) float64 point of the surface, world metres.
        distance_m: From the point of the question.
        confidence: Probability of the class there.
    """

    xyz: Float64
    distance_m: float
    confidence: float


def nearest(
    snapshot: MapSnapshot, class_name: str, point: ArrayLike, min_confidence: float = 0.0
) -> NearestSurface | None:
    """The surface point of a class that is nearest to a point; ``None`` where the map has no surface of that class.

    Args:
        snapshot: The map.
        class_name: As in the map's label set.
        point: (3,) world metres.
        min_confidence: Places that are less sure of the class do not count; 0..1.

    Raises:
        LabelError: no such class; lists those there are.
        MapError: see ``checks.check_points``; or no such confidence.
    """
    class_id = snapshot.label_set.id_of(class_name)
    p = check_point(point, snapshot)
    if not 0 <= min_confidence <= 1:
        raise MapError(f"min_confidence must be 0..1, got {min_confidence}")
    xyz, least = np.empty(3), np.uint8(np.ceil(min_confidence * CONFIDENCE_STEPS - 1e-9))
    table = (snapshot.packed, snapshot.slots, snapshot.index, snapshot.voxels)
    slot, voxel, distance = _search(p, class_id, least, *table, xyz)
    if slot < 0:
        return None
    confidence = float(snapshot.voxels.confidence[slot, voxel]) / CONFIDENCE_STEPS
    return NearestSurface(xyz * snapshot.voxel_size_m, float(distance) * snapshot.voxel_size_m, confidence)


@kernel()
def _bounds(p, class_id, packed, slots, classes):
    """Rows of the blocks that may have surface of a class, and the square of the least distance it may have."""
    rows, bounds = np.empty(len(packed), np.int64), np.empty(len(packed), np.float64)
    count = 0
    bit = np.uint64(1) << np.uint64(class_id & 63)
    for n in range(len(packed)):
        if classes[slots[n], class_id >> 6] & bit:
            bound = 0.0
            for axis in range(3):
                first = key_part(packed[n], axis) * 8.0
                gap = max(first - 0.5 - p[axis], p[axis] - first - 7.5, 0.0)
                bound += gap * gap
            rows[count], bounds[count] = n, bound
            count += 1
    return rows[:count], bounds[:count]


@kernel()
def _search(p, class_id, least, packed, slots, index, voxels, xyz):
    """Slot and voxel of the nearest surface voxel of a class, and its distance; slot -1 = none. Writes ``xyz`` (3,).

    Blocks are gone through in the order of the least distance that their surface may have, until that is more than
    what was found. The first alone leaves few of the others to be put in order.
    """
    rows, bounds = _bounds(p, class_id, packed, slots, voxels.classes)
    near, offset, q = np.empty(6, np.int64), np.empty(3), np.empty(3)
    best, best_slot, best_voxel = np.inf, np.int64(-1), np.int64(-1)
    order = np.full(min(len(rows), 1), np.argmin(bounds) if len(rows) else 0)
    for _ in range(2):
        for i in order:
            if bounds[i] > best:
                break
            slot, key = np.int64(slots[rows[i]]), packed[rows[i]]
            x, y, z = key_part(key, 0), key_part(key, 1), key_part(key, 2)
            neighbour_slots(x, y, z, index, near)
            for voxel in range(512):
                if voxels.label[slot, voxel] != class_id or voxels.confidence[slot, voxel] < least:
                    continue
                if not surface_offset(slot, voxel, near, voxels, offset):
                    continue
                q[0], q[1], q[2] = x * 8 + (voxel & 7), y * 8 + ((voxel >> 3) & 7), z * 8 + (voxel >> 6)
                q += offset
                d = (q[0] - p[0]) ** 2 + (q[1] - p[1]) ** 2 + (q[2] - p[2]) ** 2
                if d < best:
                    best, best_slot, best_voxel = d, slot, np.int64(voxel)
                    xyz[:] = q
        left = np.flatnonzero(bounds <= best)
        order = left[np.argsort(bounds[left], kind="mergesort")]
    return best_slot, best_voxel, np.sqrt(best)
