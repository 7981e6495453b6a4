"""Which frames become source views, and which source views a query looks at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from semantic_mapper.config import KeyframeConfig
from semantic_mapper.coverage import GUESSED_DEPTHS_M, LABELLED_VALUE, cover, sees
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.geometry import invert_pose_torch, transform, unproject
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

COVERAGE_GRID = (12, 16)  # rows, columns of query points whose visibility decides the choice of views
NEARNESS_VALUE = 0.05  # breaks ties towards near views


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that later frames are rendered from.

    Args:
        seq, stamp_ns: Of the frame.
        T_world_camera: (4, 4) float64.
        intrinsics: Of ``depth_m``.
        depth_m: (h, w) float32, small, 0 = none.
        encoded: One view.
        labelled: The field was finetuned on this view; such keyframes are never dropped.
        camera_id: Of the frame.
    """

    seq: int
    stamp_ns: int
    T_world_camera: Float64
    intrinsics: CameraIntrinsics
    depth_m: Float32
    encoded: EncodedViews
    labelled: bool = False
    camera_id: str = ""


class KeyframeStore:
    """A bounded set of keyframes."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._keyframes: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        """All keyframes, oldest first."""
        return tuple(self._keyframes)

    def wants(self, T_world_camera: Float64) -> bool:
        """Whether a frame at this pose has moved or turned enough, from every keyframe, to become one."""
        for keyframe in self._keyframes:
            moved, turned = pose_distance(keyframe.T_world_camera, T_world_camera)
            if moved < self._config.translation_m and turned < self._config.rotation_deg:
                return False
        return True

    def add(self, keyframe: Keyframe) -> None:
        """Keep a keyframe; past capacity the most redundant unlabelled one goes."""
        self._keyframes.append(keyframe)
        if len(self._keyframes) > self._config.capacity:
            self._drop_most_redundant()

    def move(self, poses: Mapping[tuple[str, int], Float64]) -> int:
        """Give keyframes other poses; what was encoded of them stays. Returns how many have moved.

        Args:
            poses: (camera_id, stamp_ns) -> T_world_camera (4, 4); keyframes that are not named stay where they are.
        """
        moved = 0
        for i, keyframe in enumerate(self._keyframes):
            pose = poses.get((keyframe.camera_id, keyframe.stamp_ns))
            if pose is not None and not np.array_equal(pose, keyframe.T_world_camera):
                T_camera_world = invert_pose_torch(torch.tensor(pose, dtype=torch.float32)[None])
                encoded = replace(keyframe.encoded, T_camera_world=T_camera_world)
                self._keyframes[i] = replace(keyframe, T_world_camera=pose, encoded=encoded)
                moved += 1
        return moved

    def choose(
        self, T_world_camera: Float64, intrinsics: CameraIntrinsics, depth_m: Float32, count: int
    ) -> list[Keyframe]:
        """Up to ``count`` keyframes that together cover the query frustum; none that see nothing of it.

        Greedy: each pick adds most not yet covered points of the query's own surface (its depth, or points at a few
        depths where it has none). Visibility is tested against the keyframes' depth.

        Args:
            T_world_camera: (4, 4) pose of the query.
            intrinsics: Of ``depth_m``.
            depth_m: (H, W) float32, 0 = none.
        """
        if not self._keyframes or count <= 0:
            return []
        points = _query_points(T_world_camera, intrinsics, depth_m)
        # A keyframe's depth is small and the query's may be guessed: only what stands before a point hides it.
        seen = np.stack(
            [sees(points, k.T_world_camera, k.intrinsics, k.depth_m, measured=False) for k in self._keyframes]
        )
        value = np.array([LABELLED_VALUE if k.labelled else 1.0 for k in self._keyframes])
        nearness = np.array([_nearness(k.T_world_camera, T_world_camera) for k in self._keyframes])
        return [self._keyframes[i] for i in cover(seen, value, NEARNESS_VALUE * nearness, count)]

    def _drop_most_redundant(self) -> None:
        poses = [k.T_world_camera for k in self._keyframes]
        spacing = np.full(len(poses), np.inf)
        for i, pose in enumerate(poses[:-1]):  # the newest stays
            if not self._keyframes[i].labelled:
                spacing[i] = min(_separation(pose, p) for j, p in enumerate(poses) if j != i)
        if np.isfinite(spacing).any():
            del self._keyframes[int(spacing.argmin())]


def pose_distance(T_world_a: Float64, T_world_b: Float64) -> tuple[float, float]:
    """Distance (metres) and angle (degrees) between two poses."""
    moved = float(np.linalg.norm(T_world_a[:3, 3] - T_world_b[:3, 3]))
    cosine = (np.trace(T_world_a[:3, :3].T @ T_world_b[:3, :3]) - 1) / 2
    return moved, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _separation(T_world_a: Float64, T_world_b: Float64) -> float:
    moved, turned = pose_distance(T_world_a, T_world_b)
    return moved + turned / 60.0  # a metre counts like 60 degrees


def _nearness(T_world_a: Float64, T_world_b: Float64) -> float:
    return float(np.exp(-_separation(T_world_a, T_world_b)))


def _query_points(T_world_camera: Float64, intrinsics: CameraIntrinsics, depth_m: Float32) -> Float64:
    """World points (P, 3) on a grid of the query image."""
    rows = np.linspace(0, intrinsics.height - 1, COVERAGE_GRID[0]).round().astype(int)
    columns = np.linspace(0, intrinsics.width - 1, COVERAGE_GRID[1]).round().astype(int)
    unit = unproject(np.ones_like(depth_m), intrinsics)[np.ix_(rows, columns)].reshape(-1, 3)
    depth = depth_m[np.ix_(rows, columns)].reshape(-1).astype(np.float64)
    measured = unit[depth > 0] * depth[depth > 0, None]
    blind = unit[depth <= 0]
    guesses = [blind * z for z in GUESSED_DEPTHS_M]
    return transform(T_world_camera, np.concatenate((measured, *guesses)))
