"""Where to look next without moving: novel viewpoints that keyframes cover and from where the map has most to learn.

A candidate stands where a keyframe stood, or a step beside it in air that a keyframe has looked through, and looks at
surface that is in need of class votes (``surface_patches``). Its score is the need of what it sees, weighted by how
many keyframes see that, too, and by its nearness, as votes are. What was looked at once is not looked at again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VirtualViewConfig
from semantic_mapper.geometry import invert_pose, look_at, nearest_pixels, scale_intrinsics, transform
from semantic_mapper.mapping.fusion.fuse import FULL_TRUST_RANGE_M
from semantic_mapper.mapping.keyframes import Keyframe
from semantic_mapper.mapping.views.surface_patches import SurfacePatches, surface_patches
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float64
from semantic_mapper.view_selection import visible_points

ENOUGH_KEYFRAMES = 4  # more that see a surface add nothing to its score
TARGET_CELL_M = 0.5  # surface in need is gathered in cells of this size ...
TARGETS = 4  # ... of which the neediest this many are looked at, each from where ...
EYES = 6  # ... this many of the keyframes that see it stood, and from ...
STEPS_ASIDE = 2  # ... this many places beside each, ...
STEP_M = 0.25  # ... this far away (one sigma)
NEAREST_M, FARTHEST_M = 0.5, 3.5  # of what is looked at
MARGIN_M = 0.15  # of free space round a place
PATCHES = 2000  # at most, the neediest, that candidates are scored on
CAST_WIDTH = 40  # pixels of the ray casts that tell what hides what
CASTS = 4  # of the best candidates before occlusion
LEAST_GAIN = 20.0  # voxels without votes, seen from within 2 m and by enough keyframes; less is not worth the time
ALONG_UP = 0.95  # cosine with up, beyond which a view has no clear roll


class VirtualView(NamedTuple):
    """A viewpoint, and what speaks for it.

    Args:
        T_world_camera: (4, 4) float64.
        gain: Its score, in voxels without votes.
        packed: (N,) int64 keys of the blocks in need that it sees.
    """

    T_world_camera: Float64
    gain: float
    packed: NDArray[np.int64]


class VirtualLook(NamedTuple):
    """A virtual view that was rendered and fused.

    Args:
        view: Its viewpoint.
        source_seqs: Of the keyframes that it was rendered from.
        blocks: That its votes went to.
    """

    view: VirtualView
    source_seqs: tuple[int, ...]
    blocks: int


class ViewpointChooser:
    """Chooses virtual views of one map, each of something else.

    Deterministic: the same map, keyframes, seed and number of choices before give the same view.

    Args:
        config: How many keyframes must see what is looked at.
        seed: Of the places beside the keyframes.
    """

    def __init__(self, config: VirtualViewConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._choices = 0
        self._looked_at = np.empty(0, np.int64)
        self._epoch = 0

    def choose(
        self, voxel_map: VoxelMap, keyframes: Sequence[Keyframe], intrinsics: CameraIntrinsics
    ) -> VirtualView | None:
        """The viewpoint of most gain; None where none has enough of it.

        Args:
            voxel_map: Whose surface is looked at. After a new ``epoch`` all of it may be looked at again.
            keyframes: To render from.
            intrinsics: Of the virtual camera.
        """
        if voxel_map.epoch != self._epoch:
            self._looked_at, self._epoch = np.empty(0, np.int64), voxel_map.epoch
        if len(keyframes) < self._config.keyframes:
            return None
        patches = surface_patches(voxel_map, self._config.max_votes)
        patches = _worth_a_look(patches, keyframes, self._config.keyframes, self._looked_at)
        if patches.need.sum() < LEAST_GAIN:
            return None
        rng = np.random.default_rng([self._seed, self._choices])
        small = scale_intrinsics(intrinsics, CAST_WIDTH, round(CAST_WIDTH * intrinsics.height / intrinsics.width))
        best: VirtualView | None = None
        for pose in _promising(_candidates(patches, keyframes, rng), patches, small):
            view = _as_seen(pose, patches, voxel_map, small)
            if view is not None and view.gain >= (LEAST_GAIN if best is None else best.gain):
                best = view
        if best is not None:
            self._choices += 1
            self._looked_at = np.union1d(self._looked_at, best.packed)
        return best


def in_free_space(points: Float64, keyframes: Sequence[Keyframe]) -> NDArray[np.bool_]:
    """Which points (P, 3) lie in air that a keyframe has looked through, ``MARGIN_M`` before what it saw: (P,)."""
    free = np.zeros(len(points), np.bool_)
    for k in keyframes:
        p = transform(invert_pose(k.T_world_camera), points)
        inside, row, column = nearest_pixels(p, k.intrinsics)
        free |= inside & (k.depth_m[row, column] > p[:, 2] + MARGIN_M)
    return free


def _worth_a_look(
    patches: SurfacePatches, keyframes: Sequence[Keyframe], least: int, looked_at: NDArray[np.int64]
) -> SurfacePatches:
    """The neediest patches that enough keyframes see and that were not looked at; need times fraction of views."""
    fresh = np.flatnonzero((patches.need > 0) & ~np.isin(patches.packed, looked_at))
    points = patches.xyz[fresh]
    count = np.zeros(len(points), np.int64)
    for k in keyframes:
        near = ((points - k.T_world_camera[:3, 3]) ** 2).sum(1) < FARTHEST_M**2
        count += near & visible_points(points, k.T_world_camera, k.intrinsics, k.depth_m, measured=True)
    need = np.where(count >= least, np.minimum(count, ENOUGH_KEYFRAMES) / ENOUGH_KEYFRAMES * patches.need[fresh], 0)
    some = np.sort(np.argsort(-need, kind="stable")[:PATCHES])
    some = some[need[some] > 0]
    return SurfacePatches(patches.packed[fresh[some]], points[some], need[some])


def _candidates(patches: SurfacePatches, keyframes: Sequence[Keyframe], rng: np.random.Generator) -> list[Float64]:
    """Poses (4, 4) from places in free space to the centres of where need is greatest."""
    poses: list[Float64] = []
    for target in _targets(patches):
        distance = [float(np.linalg.norm(k.T_world_camera[:3, 3] - target)) for k in keyframes]
        seeing = [
            i
            for i in np.argsort(distance, kind="stable")
            if visible_points(
                target[None], keyframes[i].T_world_camera, keyframes[i].intrinsics, keyframes[i].depth_m, measured=True
            )[0]
        ]
        for i in seeing[:EYES]:
            at = keyframes[i].T_world_camera[:3, 3]
            aside = at + rng.normal(0, STEP_M, (STEPS_ASIDE, 3))
            up = -keyframes[i].T_world_camera[:3, 1]
            for eye in (at, *aside[in_free_space(aside, keyframes)]):
                far = float(np.linalg.norm(target - eye))
                if NEAREST_M <= far <= FARTHEST_M and abs((target - eye) @ up) < ALONG_UP * far:
                    poses.append(look_at(eye, target, up))
    return poses


def _targets(patches: SurfacePatches) -> Float64:
    """Of the neediest cells, the neediest first, the patches (T, 3) in the middle of their need."""
    cells = np.floor(patches.xyz / TARGET_CELL_M).astype(np.int64)
    _, inverse = np.unique(cells, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    total = np.bincount(inverse, patches.need)
    targets: list[Float64] = []
    for cell in np.argsort(-total, kind="stable")[:TARGETS]:
        xyz, need = patches.xyz[inverse == cell], patches.need[inverse == cell]
        middle = need @ xyz / need.sum()
        targets.append(xyz[((xyz - middle) ** 2).sum(1).argmin()])
    return np.stack(targets)


def _promising(poses: list[Float64], patches: SurfacePatches, intrinsics: CameraIntrinsics) -> list[Float64]:
    """Those of most gain if nothing hid anything, the best first."""
    gain = np.zeros(len(poses))
    for i, pose in enumerate(poses):
        p = transform(invert_pose(pose), patches.xyz)
        gain[i] = (nearest_pixels(p, intrinsics)[0] * _worth(p[:, 2], patches)).sum()
    return [poses[i] for i in np.argsort(-gain, kind="stable")[:CASTS]]


def _as_seen(
    pose: Float64, patches: SurfacePatches, voxel_map: VoxelMap, intrinsics: CameraIntrinsics
) -> VirtualView | None:
    """A candidate with the gain of what nothing hides from it; None where it stands in or at a surface."""
    depth = voxel_map.ray_cast(pose, intrinsics).depth_m
    if ((depth > 0) & (depth < MARGIN_M)).any():
        return None
    p = transform(invert_pose(pose), patches.xyz)
    _, row, column = nearest_pixels(p, intrinsics)
    seen = visible_points(patches.xyz, pose, intrinsics, depth, measured=True) & (depth[row, column] > 0)
    return VirtualView(pose, float((seen * _worth(p[:, 2], patches)).sum()), patches.packed[seen])


def _worth(z: Float64, patches: SurfacePatches) -> Float64:
    """What patches (N,) at depth ``z`` (N,) count: as far as votes from there do."""
    nearness = np.minimum(1, (FULL_TRUST_RANGE_M / np.maximum(z, NEAREST_M)) ** 2)
    return np.where(z <= FARTHEST_M, nearness * patches.need, 0)
