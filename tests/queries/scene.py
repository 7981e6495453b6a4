"""A known world: a floor z = 0, a table that is a turned box, a cup that is a ball; seen from all round, exactly."""

from __future__ import annotations

from functools import cache

import numpy as np

from semantic_mapper.geometry import look_at
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.blocks import pack_keys
from semantic_mapper.mapping.changes import UNOBSERVED, BlockChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.types import Float32, Float64, UInt8
from tests.mapping.rendered_views import INTRINSICS, frame, plane_depth, ray_directions, small_map, sphere_depth

LABELS = make_label_set("known", ("floor", "table", "cup", "lamp"), ids=(2, 5, 9, 11), ignore_id=0)
FLOOR, TABLE, CUP, LAMP = LABELS.ids
BALL, RADIUS = np.array([0.75, 0.1, 0.2]), 0.2
BOX, HALF, YAW = np.array([-0.1, 0.05, 0.2]), np.array([0.3, 0.2, 0.2]), np.deg2rad(25)
REACH_M = 2.0  # the floor ends there
MIDDLE = np.array([0.3, 0.0, 0.15])


def box_axes() -> Float64:
    """(3, 3) columns are the table's axes."""
    c, s = np.cos(YAW), np.sin(YAW)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def box_depth(T_world_camera: Float64) -> Float32:
    d = ray_directions(INTRINSICS, T_world_camera) @ box_axes()
    o = (T_world_camera[:3, 3] - BOX) @ box_axes()
    with np.errstate(divide="ignore"):
        a, b = (-HALF - o) / d, (HALF - o) / d
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((near < far) & (near > 0), near, 0).astype(np.float32)


def poses(count: int) -> list[Float64]:
    """Cameras on a circle that look down on the scene."""
    turns = 2 * np.pi * np.arange(count) / count
    eyes = [MIDDLE + 1.3 * np.array([np.cos(t), np.sin(t), 0.75 + 0.25 * (i % 3)]) for i, t in enumerate(turns)]
    return [look_at(eye, MIDDLE, np.array([0.0, 0.0, 1.0])) for eye in eyes]


def seen(T_world_camera: Float64) -> tuple[Float32, UInt8]:
    """Depth and class image."""
    layers = (plane_depth(T_world_camera, (0.0, 0.0, 1.0), 0.0), box_depth(T_world_camera))
    layers = np.stack((*layers, sphere_depth(T_world_camera, BALL, RADIUS)))
    first = np.where(layers > 0, layers, np.inf).argmin(axis=0)
    depth = np.take_along_axis(layers, first[None], axis=0)[0]
    depth[depth > REACH_M] = 0
    return depth, np.where(depth > 0, np.array([FLOOR, TABLE, CUP], np.uint8)[first], 0).astype(np.uint8)


def integrate(voxel_map: VoxelMap, pose: Float64, seq: int, *, measured: bool = True, only: int = 0) -> None:
    depth, label = seen(pose)
    probabilities = np.full((*depth.shape, len(LABELS)), 0.1, np.float32)
    np.put_along_axis(probabilities, np.maximum(LABELS.to_channels(label), 0)[..., None], 0.7, axis=2)
    shown = label == only if only else label > 0
    depth = np.where(shown, depth, 0).astype(np.float32) if only else depth
    voxel_map.integrate(frame(pose, seq=seq), depth, probabilities, shown, measured=measured)


@cache
def whole_map() -> VoxelMap:
    """The scene after 14 frames; nobody changes it."""
    voxel_map = small_map(LABELS)
    for seq, pose in enumerate(poses(14)):
        integrate(voxel_map, pose, seq)
    return voxel_map


@cache
def whole() -> MapSnapshot:
    return MapMirror.of(whole_map()).snapshot()


def truth_distance(xyz: Float64) -> Float64:
    """(N, 3): signed distance of points (N, 3) to floor, table and ball."""
    q = np.abs((xyz - BOX) @ box_axes()) - HALF
    table = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    return np.stack((xyz[:, 2], table, np.linalg.norm(xyz - BALL, axis=1) - RADIUS), axis=1)


def surface_of(snapshot: MapSnapshot) -> tuple[Float64, UInt8, UInt8]:
    """Surface points (N, 3) in metres, class ids and confidence bytes (N,)."""
    surface = surface_voxels(snapshot)
    slot = snapshot.slots[surface.row]
    voxels = snapshot.voxels
    xyz = surface.point * snapshot.voxel_size_m
    return xyz, voxels.label[slot, surface.voxel], voxels.confidence[slot, surface.voxel]


def painted(plan: UInt8, since: int, version: int) -> BlockChanges:
    """A level surface a third of a voxel above z = 3 whose voxel (x, y, 3) has class ``plan[x, y]``; sides of 8 n."""
    tsdf = np.empty((*plan.shape, 8), np.int8)
    tsdf[..., :] = np.array([UNOBSERVED, -100, -65, -30, 60, 90, 127, 127], np.int8)
    label = np.zeros(tsdf.shape, np.uint8)
    label[..., 3] = plan
    return voxels_as_changes(tsdf, label, since, version)


def voxels_as_changes(tsdf: np.ndarray, label: UInt8, since: int = 0, version: int = 1) -> BlockChanges:
    """Voxels (X, Y, Z) int8 and uint8, sides of 8 n, from the origin on."""
    keys = np.array(list(np.ndindex(*(side // 8 for side in tsdf.shape))), np.int32)
    assert (np.diff(pack_keys(keys)) > 0).all()

    def cut(values: np.ndarray) -> np.ndarray:
        cubes = [values[tuple(slice(8 * k, 8 * k + 8) for k in key)] for key in keys]
        return np.stack([np.ascontiguousarray(cube.transpose(2, 1, 0)).reshape(512) for cube in cubes])

    label_rows = cut(label)
    confidence = np.where(label_rows > 0, 204, 0).astype(np.uint8)  # 0.8
    return BlockChanges(
        since, version, version, 0, keys, cut(tsdf), label_rows, confidence, np.zeros((len(keys), 512, 3), np.uint8)
    )
