"""Which frames become source views, and which source views a query looks at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.config import KeyframeConfig
from semantic_mapper.fields.base import Encoded, EncodedSize
from semantic_mapper.geometry import (
    GUESSED_DEPTHS_M,
    LABELLED_VALUE,
    select_views,
    transform,
    unproject,
    visible_points,
)
from semantic_mapper.localization.places import view_distances
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

ROTATION_DEG = 12.0  # that a frame has turned from every keyframe near it, to become one
COVERAGE_GRID = (12, 16)  # rows, columns of query points whose visibility decides the choice of views
NEARNESS_VALUE = 0.05  # breaks ties towards near views
HERE_M = 6.0  # from the newest keyframe: beyond, others are worth less, by the square of the distance


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame that later frames are rendered from."""

    seq: int
    stamp_ns: int
    T_world_camera: Float64  # (4, 4) float64
    intrinsics: CameraIntrinsics  # of ``depth_m``
    depth_m: Float32  # (h, w) float32, small, 0 = none
    encoded: Encoded  # one view
    labelled: bool = False  # the field was finetuned on this view; such keyframes are never dropped
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

    def wants(self, T_world_camera: Float64, size: EncodedSize | None = None) -> bool:
        """Whether a frame at this pose is far enough from every keyframe of its ``size`` to become one."""
        own = np.array([size in (None, k.encoded.size) for k in self._keyframes], bool)
        moved, turned = pose_distances(self._poses()[own], T_world_camera)
        near = (moved < self._config.translation_m) & (turned < ROTATION_DEG)
        return not near.any()

    def add(self, keyframe: Keyframe) -> None:
        """Keep a keyframe; past capacity an unlabelled one goes: the most redundant one, far ones before near ones."""
        self._keyframes.append(keyframe)
        if len(self._keyframes) > self._config.capacity:
            self._drop_most_redundant()

    def exchange_labelled(self, keyframes: Sequence[Keyframe]) -> None:
        """Put these in the place of those that the field was finetuned on before."""
        self._keyframes = [*keyframes, *(k for k in self._keyframes if not k.labelled)]
        while len(self._keyframes) > self._config.capacity and self._drop_most_redundant():
            pass

    def clear(self) -> None:
        """Forget all: no frame is to be rendered any more."""
        self._keyframes = []

    def move(self, poses: Mapping[tuple[str, int], Float64]) -> int:
        """Give keyframes other poses, by (camera_id, stamp_ns); what was encoded stays. Returns how many have moved."""
        moved = 0
        for i, keyframe in enumerate(self._keyframes):
            pose = poses.get((keyframe.camera_id, keyframe.stamp_ns))
            if pose is not None and not np.array_equal(pose, keyframe.T_world_camera):
                self._keyframes[i] = replace(keyframe, T_world_camera=pose, encoded=keyframe.encoded.at(pose))
                moved += 1
        return moved

    def choose(
        self,
        T_world_camera: Float64,
        intrinsics: CameraIntrinsics,
        depth_m: Float32,
        count: int,
        size: EncodedSize | None = None,
    ) -> list[Keyframe]:
        """Up to ``count`` keyframes, of views of ``size``, that together cover the query frustum; none that see nothing
        of it.

        Greedy: each pick adds most not yet covered points of the query's own surface (its depth, or points at a few
        depths where it has none). Visibility is tested against the keyframes' depth."""
        fitting = [k for k in self._keyframes if size in (None, k.encoded.size)]
        if not fitting or count <= 0:
            return []
        points = _query_points(T_world_camera, intrinsics, depth_m)
        # A keyframe's depth is small and the query's may be guessed: only what stands before a point hides it.
        seen = np.stack(
            [visible_points(points, k.T_world_camera, k.intrinsics, k.depth_m, measured=False) for k in fitting]
        )
        value = np.array([LABELLED_VALUE if k.labelled else 1.0 for k in fitting])
        nearness = np.exp(-_separations(np.array([k.T_world_camera for k in fitting]), T_world_camera))
        return [fitting[i] for i in select_views(seen, value, NEARNESS_VALUE * nearness, count)]

    def _poses(self) -> Float64:
        """(N, 4, 4), oldest first."""
        return np.array([k.T_world_camera for k in self._keyframes]).reshape(-1, 4, 4)

    def _drop_most_redundant(self) -> bool:
        """Drop the one nearest to another; False where all have to stay. What the camera has left behind counts as
        nearer: else a long walk would leave no source views where it is."""
        poses = self._poses()
        spacing = _separations(poses[:, None], poses[None])
        np.fill_diagonal(spacing, np.inf)
        sizes = [k.encoded.size for k in self._keyframes]
        spacing[np.array([[a != b for b in sizes] for a in sizes])] = np.inf  # the one is no source view for the other
        left_m = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
        worth = spacing.min(axis=1) / np.maximum(1.0, left_m / HERE_M) ** 2
        worth[-1] = np.inf  # the newest stays
        worth[[k.labelled for k in self._keyframes]] = np.inf
        if not np.isfinite(worth).any():
            return False
        del self._keyframes[int(worth.argmin())]
        return True


def pose_distances(T_world_a: Float64, T_world_b: Float64) -> tuple[Float64, Float64]:
    """Distances (metres) and angles (degrees) between poses (..., 4, 4); both broadcast."""
    moved, turned = view_distances(T_world_a, T_world_b)
    return moved, np.degrees(turned)


def _separations(T_world_a: Float64, T_world_b: Float64) -> Float64:
    moved, turned = pose_distances(T_world_a, T_world_b)
    return moved + turned / 60.0  # a metre counts like 60 degrees


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
