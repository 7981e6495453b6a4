"""Analytic depth images: what a camera sees of a plane or a sphere, exactly."""

from __future__ import annotations

import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.geometry import look_at, unproject
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

INTRINSICS = CameraIntrinsics(130.0, 128.0, 80.3, 58.9, 160, 120)
LABELS = make_label_set("three", ("table", "cup", "wall"), ids=(5, 9, 2), ignore_id=0)


def small_map(labels: LabelSet = LABELS, **changes: float) -> VoxelMap:
    return VoxelMap(VoxelMapConfig(**{"unknown_below": 0.0, **changes}), labels)  # type: ignore[arg-type]


def ray_directions(intrinsics: CameraIntrinsics, T_world_camera: Float64) -> Float64:
    """(H, W, 3) world directions with unit z in the camera."""
    ones = np.ones((intrinsics.height, intrinsics.width), np.float32)
    return unproject(ones, intrinsics) @ T_world_camera[:3, :3].T


def plane_depth(
    T_world_camera: Float64,
    normal: tuple[float, float, float],
    offset: float,
    intrinsics: CameraIntrinsics = INTRINSICS,
) -> Float32:
    """Depth of the plane ``normal . p = offset``; 0 where the ray does not meet it."""
    n = np.array(normal) / np.linalg.norm(normal)
    along = ray_directions(intrinsics, T_world_camera) @ n
    z = (offset - T_world_camera[:3, 3] @ n) / np.where(along == 0, np.nan, along)
    return np.where(z > 0, z, 0).astype(np.float32)


def sphere_depth(T_world_camera: Float64, center: Float64, radius: float) -> Float32:
    d = ray_directions(INTRINSICS, T_world_camera)
    o = T_world_camera[:3, 3] - center
    a, b, c = (d * d).sum(-1), 2 * d @ o, o @ o - radius**2
    root = b * b - 4 * a * c
    z = (-b - np.sqrt(np.maximum(root, 0))) / (2 * a)
    return np.where(root > 0, z, 0).astype(np.float32)


def frame(
    T_world_camera: Float64 | None = None,
    *,
    seq: int = 0,
    intrinsics: CameraIntrinsics = INTRINSICS,
    rgb: int | None = None,
) -> PosedFrame:
    """A frame whose colours are a gradient, or one grey value."""
    size = (intrinsics.height, intrinsics.width)
    if rgb is None:
        v, u = np.indices(size)
        image = np.stack((u % 256, (2 * v) % 256, (u + v) % 256), axis=-1).astype(np.uint8)
    else:
        image = np.full((*size, 3), rgb, np.uint8)
    pose = np.eye(4) if T_world_camera is None else T_world_camera
    return PosedFrame(1000 + seq, seq, "test", image, None, None, intrinsics, pose)


def sure(channel: int, p: float = 0.8, labels: LabelSet = LABELS) -> Float32:
    """(H, W, L) probabilities: ``p`` for one channel everywhere, the rest shared."""
    out = np.full((INTRINSICS.height, INTRINSICS.width, len(labels)), (1 - p) / (len(labels) - 1), np.float32)
    out[..., channel] = p
    return out


def around(center: Float64, distance: float, count: int) -> list[Float64]:
    """Poses that look at ``center`` from all round, at three heights."""
    poses = []
    for i in range(count):
        angle, height = 2 * np.pi * i / count, (-0.6, 0.0, 0.6)[i % 3]
        eye = center + distance * np.array([np.cos(angle), np.sin(angle), height])
        poses.append(look_at(eye, center, np.array([0.0, 0.0, 1.0])))
    return poses
