"""A thing that is put into frames of a recording, as if it had stood there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64, PosedFrame

BEHIND_M = 0.1  # a frame sees through a point where it measures at least this much more than its depth
COLOR = (200, 30, 160)


class Thing(NamedTuple):
    """A box or an upright cylinder.

    Args:
        T_thing_world: (4, 4), z up in the thing, its centre at 0.
        half_m: Half of its sides (3,); of a cylinder the first is its radius.
        is_round: A cylinder.
    """

    T_thing_world: Float64
    half_m: Float64
    is_round: bool

    def hit(self, camera: Float64, rays: Float64) -> Float64:
        """Where rays (N, 3) from a point (3,) in the world enter it, in lengths of the ray; inf = never."""
        origin, rays = transform(self.T_thing_world, camera), rays @ self.T_thing_world[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = (np.stack((-self.half_m, self.half_m)) - origin)[:, None] / rays  # (2, N, 3)
            enter, leave = ends.min(axis=0), ends.max(axis=0)
            if self.is_round:
                a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ origin[:2]
                root = np.sqrt(b * b - a * ((origin[:2] ** 2).sum() - self.half_m[0] ** 2))  # NaN: passes by
                enter = np.stack(((-b - root) / a, enter[:, 2]), axis=1)
                leave = np.stack(((-b + root) / a, leave[:, 2]), axis=1)
            near, far = enter.max(axis=1), leave.min(axis=1)
        return np.where((near < far) & (near > 0), near, np.inf)


def with_thing(frame: PosedFrame, thing: Thing, class_id: int) -> PosedFrame:
    """The frame as if the thing had stood there, in front of what it hides; of a class where the frame has labels."""
    k, depth = frame.intrinsics, frame.depth_m
    assert depth is not None
    v, u = np.indices(depth.shape)
    rays = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(depth.shape)), axis=-1).reshape(-1, 3)
    z = thing.hit(frame.T_world_camera[:3, 3], rays @ frame.T_world_camera[:3, :3].T).reshape(depth.shape)
    hides = np.isfinite(z) & ((depth == 0) | (z < depth))
    rgb = np.where(hides[..., None], np.array(COLOR, np.uint8), frame.rgb)
    label = None if frame.label is None else np.where(hides, class_id, frame.label).astype(np.uint8)
    return replace(frame, depth_m=np.where(hides, z, depth).astype(np.float32), rgb=rgb, label=label)


def place_thing(frame: PosedFrame, up: Float64, half_m: Sequence[float], is_round: bool) -> Thing:
    """In the middle of a view, before what is there."""
    assert frame.depth_m is not None
    h, w = frame.depth_m.shape
    middle = frame.depth_m[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3]
    z = 0.65 * float(np.median(middle[middle > 0]))
    x = np.cross(up, frame.T_world_camera[:3, 2])
    x /= np.linalg.norm(x)
    T_world_thing = np.eye(4)
    T_world_thing[:3, :3] = np.stack((x, np.cross(up, x), up), axis=1)
    T_world_thing[:3, 3] = transform(frame.T_world_camera, np.array([0.0, 0.0, z]))
    return Thing(invert_pose(T_world_thing), np.array(half_m), is_round)


def sees_through(frame: PosedFrame, xyz: Float64) -> NDArray[np.bool_]:
    """Which points (N, 3) of the world lie well in front of what a frame measures at their pixel."""
    assert frame.depth_m is not None
    k = frame.intrinsics
    p = transform(invert_pose(frame.T_world_camera), xyz)
    z = np.maximum(p[:, 2], 1e-6)
    u, v = np.rint(k.fx * p[:, 0] / z + k.cx), np.rint(k.fy * p[:, 1] / z + k.cy)
    inside = (p[:, 2] > 0.2) & (u >= 0) & (v >= 0) & (u < k.width) & (v < k.height)
    depth = frame.depth_m[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
    return inside & (depth <= VoxelMapConfig().depth_max_m) & (depth > p[:, 2] + BEHIND_M)


def map_frame(voxel_map: VoxelMap, frame: PosedFrame) -> None:
    """Fuse a frame, with its labels as votes where it has any."""
    assert frame.depth_m is not None
    labels = voxel_map.label_set
    if frame.label is None:
        voxel_map.integrate(frame, frame.depth_m, None)
        return
    rows = labels.to_channels(frame.label, "label").astype(np.int32)
    rows[(rows < 0) | (rows >= len(labels))] = -1
    table = np.full((len(labels), len(labels)), 0.1 / (len(labels) - 1), np.float32)
    np.fill_diagonal(table, 0.9)
    voxel_map.integrate(frame, frame.depth_m, table, rows=rows)
