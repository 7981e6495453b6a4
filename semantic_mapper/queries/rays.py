"""What a camera or a ray meets: the map's own way of walking along rays (``ray_casting.march``) on a snapshot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import check_pose
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import find_block, pack_key
from semantic_mapper.mapping.map_types import MapView
from semantic_mapper.mapping.ray_casting import march
from semantic_mapper.queries.checks import as_numbers, check_direction, check_points, check_positive
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

MAX_RANGE_M = 100.0  # beyond, a ray through nothing takes long


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """What N rays meet.

    Args:
        distance_m: (N,) float32 along the ray, 0 where it meets no surface.
        label: (N,) uint8 class ids, the ignore id at misses and where nothing voted.
        confidence: (N,) float32, 0 where ``label`` is the ignore id.
        rgb: (N, 3) uint8.
    """

    distance_m: Float32
    label: UInt8
    confidence: Float32
    rgb: UInt8


def cast_rays(snapshot: MapSnapshot, origins: ArrayLike, directions: ArrayLike, max_m: float = 10.0) -> RayHits:
    """The first surface that each ray meets from its front.

    Args:
        snapshot: The map.
        origins: (N, 3) or (3,) world metres.
        directions: (N, 3) or (3,), of any length; one origin or direction stands for all.
        max_m: How far rays go, at most 100.

    Raises:
        MapError: see ``checks``; shapes that do not go together; a range out of bounds.
    """
    origin = check_points(np.atleast_2d(as_numbers(origins, "origins")), snapshot, "origins")
    direction = np.atleast_2d(check_direction(directions, "directions"))
    if len(origin) != len(direction) and 1 not in (len(origin), len(direction)):
        raise MapError(f"cast_rays: {len(origin)} origins and {len(direction)} directions do not go together")
    count = max(len(origin), len(direction)) if len(origin) and len(direction) else 0
    origin, direction = np.broadcast_to(origin, (count, 3)), np.broadcast_to(direction, (count, 3))
    return _cast(snapshot, origin, direction, max_m)


def ray_cast(
    snapshot: MapSnapshot, T_world_camera: Float64, intrinsics: CameraIntrinsics, max_m: float = 10.0
) -> MapView:
    """The map as a camera would see it up to z = ``max_m``; as ``VoxelMap.ray_cast``, with classes of single voxels.

    Args:
        snapshot: The map.
        T_world_camera: (4, 4) float64.
        intrinsics: Of the view wanted; pixel centres are integers.
        max_m: At most 100.

    Raises:
        PoseError: the pose is not a rigid transform.
        MapError: a camera beyond the reach of a map, or a range out of bounds.
    """
    check_pose(T_world_camera, "ray_cast")
    height, width = intrinsics.height, intrinsics.width
    v, u = np.indices((height, width))
    d_camera = np.stack(
        ((u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(v.shape)), -1
    )
    direction = d_camera.reshape(-1, 3) @ T_world_camera[:3, :3].T  # of unit z: distances along it are depths
    origin = check_points(T_world_camera[None, :3, 3], snapshot, "T_world_camera")
    hits = _cast(snapshot, np.broadcast_to(origin, direction.shape), direction, max_m)
    size = (height, width)
    return MapView(
        hits.distance_m.reshape(size),
        hits.rgb.reshape(*size, 3),
        hits.label.reshape(size),
        hits.confidence.reshape(size),
    )


def _cast(snapshot: MapSnapshot, origin: Float64, direction: Float64, max_m: float) -> RayHits:
    """``origin`` (N, 3) in voxels, ``direction`` (N, 3) in metres a unit of the result."""
    if check_positive(max_m, "max_m") > MAX_RANGE_M:
        raise MapError(f"max_m must be at most {MAX_RANGE_M:g}, got {max_m}")
    step = np.ascontiguousarray(direction / snapshot.voxel_size_m)
    distance, slot, voxel = _march_all(
        np.ascontiguousarray(origin),
        step,
        snapshot.voxels_per_step,
        max_m,
        snapshot.index,
        snapshot.voxels,
        snapshot.label_set.ignore_id,
    )
    label, confidence, rgb = snapshot.read(slot, voxel)
    return RayHits(distance, label, confidence, rgb)


@kernel()
def _march_all(origins, directions, voxels_per_step, max_m, index, voxels, ignore_id):
    """Distance (N,) float32, 0 = miss, and slot (-1 = none) and voxel (N,) that speak for the place that was hit."""
    count = len(origins)
    distance = np.zeros(count, np.float32)
    slots, chosen = np.full(count, -1, np.int64), np.zeros(count, np.int64)
    p = np.empty(3)
    for n in range(count):
        d = march(origins[n], directions[n], voxels_per_step, max_m, index, voxels, p)
        if d > 0:
            for axis in range(3):
                p[axis] = origins[n, axis] + d * directions[n, axis]
            distance[n] = d
            slots[n], chosen[n] = speaker(p, index, voxels, ignore_id)
    return distance, slots, chosen


@kernel()
def speaker(p, index, voxels, ignore_id):
    """Slot (-1 = none) and voxel of the observed corner nearest to a point; of those with a class if any is."""
    x0, y0, z0 = int(np.floor(p[0])), int(np.floor(p[1])), int(np.floor(p[2]))
    best, best_slot, best_voxel, best_voted = -1.0, np.int64(-1), np.int64(0), False
    for corner in range(8):
        x, y, z = x0 + (corner & 1), y0 + ((corner >> 1) & 1), z0 + (corner >> 2)
        slot = find_block(index, pack_key(x >> 3, y >> 3, z >> 3))
        if slot < 0:
            continue
        voxel = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
        if not voxels.weight[slot, voxel]:
            continue
        share = (1 - abs(p[0] - x)) * (1 - abs(p[1] - y)) * (1 - abs(p[2] - z))
        voted = voxels.label[slot, voxel] != ignore_id
        if (voted and not best_voted) or (voted == best_voted and share > best):
            best, best_slot, best_voxel, best_voted = share, slot, np.int64(voxel), voted
    return best_slot, best_voxel
