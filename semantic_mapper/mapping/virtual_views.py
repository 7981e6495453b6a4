"""Virtual views: novel viewpoints that keyframes cover and from where the map has most to learn, and their votes.

A candidate stands where a keyframe stood, or a step to its side in air that one has looked through, and looks at
surface in need of class votes (``surface_patches``). Its score is the need of what it sees, weighted by how many
keyframes see that, too, and by nearness. What was looked at once is not looked at again. TSDF, colour and weight stay
as they are, to the bit, and no block is added."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from semantic_mapper.geometry import invert_pose, look_at, nearest_pixels, scale_intrinsics, transform, visible_points
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.allocation import blocks_in_band, make_camera
from semantic_mapper.mapping.block_grid import GridBuffers
from semantic_mapper.mapping.blocks import pack_keys
from semantic_mapper.mapping.fusion import FULL_TRUST_RANGE_M, make_limits, make_votes, vote_into_blocks
from semantic_mapper.mapping.keyframes import Keyframe
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, Int32, Int64

VOTE_WEIGHT = 0.3  # of a vote, against one of a frame
MAX_VOTES = 0.3  # only voxels with fewer take votes; a frame's vote from up to 2 m, head on, is 1
LEAST_KEYFRAMES = 2  # that must see a surface for a virtual view to look at it
ENOUGH_KEYFRAMES = 4  # more that see a surface add nothing to its score
TARGET_CELL_M = 0.5  # surface in need is gathered in cells of this size ...
TARGETS = 4  # ... of which the neediest this many are looked at, each from where ...
EYES = 6  # ... this many of the keyframes that see it stood, and from ...
STEPS_ASIDE = 2  # ... this many places next to each, ...
STEP_M = 0.25  # ... this far away (one sigma)
NEAREST_M, FARTHEST_M = 0.5, 3.5  # of what is looked at
MARGIN_M = 0.15  # of free space round a place
PATCHES = 2000  # at most, the neediest, that candidates are scored on
CAST_WIDTH = 40  # pixels of the ray casts that tell what hides what
CASTS = 4  # of the best candidates before occlusion
SURFACE_VOXELS = 0.75  # voxels at most this many of their edges from the surface are of it
LEAST_GAIN = 20.0  # voxels without votes, seen from within 2 m and by enough keyframes; less is not worth the time
ALONG_UP = 0.95  # cosine with up, beyond which a view has no clear roll


class SurfacePatches(NamedTuple):
    """N patches of the surface, in the order of their keys."""

    packed: Int64  # (N,) int64 keys of their blocks
    xyz: Float64  # (N, 3) float64 metres in the world, mean of their voxels
    # (N,) float64, sum over their voxels of ``(1 - confidence) / (1 + votes)``: 1 without votes, little where the class
    # is clear, and 0 where there are votes enough
    need: Float64


def surface_patches(voxel_map: VoxelMap) -> SurfacePatches:
    """Patches of the blocks in memory; those on disk are left out."""
    config = voxel_map.config
    with voxel_map.locked() as grid:
        keys, blocks = grid.sorted_blocks()
        near, count = SURFACE_VOXELS / config.truncation_voxels, np.zeros(len(blocks), np.int64)
        total, need = np.zeros((len(blocks), 3)), np.zeros(len(blocks))
        limits = near, config.vote_discount, MAX_VOTES
        _sum_surface_patches(len(blocks), keys, blocks, grid.buffers(), *limits, total, need, count)
    has = count > 0
    xyz = total[has] / count[has, None] * config.voxel_size_m
    return SurfacePatches(pack_keys(keys[has]), xyz, need[has])


class VirtualView(NamedTuple):
    """A viewpoint (4, 4), its score in voxels without votes, and the keys (N,) of the blocks in need that it sees."""

    T_world_camera: Float64
    gain: float
    packed: Int64


class ViewpointChooser:
    """Chooses virtual views of one map, each of something else.

    Deterministic: the same map, keyframes, seed and number of choices before give the same view."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._choices = 0
        self._looked_at = np.empty(0, np.int64)
        self._epoch = 0

    def choose(
        self, voxel_map: VoxelMap, keyframes: Sequence[Keyframe], intrinsics: CameraIntrinsics
    ) -> VirtualView | None:
        """The viewpoint of most gain for a camera, to be rendered from keyframes; None where none has enough of it.
        After a new ``epoch`` of the map all of it may be looked at again."""
        if voxel_map.epoch != self._epoch:
            self._looked_at, self._epoch = np.empty(0, np.int64), voxel_map.epoch
        if len(keyframes) < LEAST_KEYFRAMES:
            return None
        patches = surface_patches(voxel_map)
        patches = _worth_a_look(patches, keyframes, self._looked_at)
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


def in_free_space(points: Float64, keyframes: Sequence[Keyframe]) -> Bool:
    """Which points (P, 3) lie in air that a keyframe has looked through, ``MARGIN_M`` before what it saw: (P,)."""
    free = np.zeros(len(points), np.bool_)
    for k in keyframes:
        p = transform(invert_pose(k.T_world_camera), points)
        inside, row, column = nearest_pixels(p, k.intrinsics)
        free |= inside & (k.depth_m[row, column] > p[:, 2] + MARGIN_M)
    return free


def _worth_a_look(patches: SurfacePatches, keyframes: Sequence[Keyframe], looked_at: Int64) -> SurfacePatches:
    """The neediest patches that enough keyframes see and that were not looked at; need times fraction of views."""
    fresh = np.flatnonzero((patches.need > 0) & ~np.isin(patches.packed, looked_at))
    points = patches.xyz[fresh]
    count = np.zeros(len(points), np.int64)
    for k in keyframes:
        near = ((points - k.T_world_camera[:3, 3]) ** 2).sum(1) < FARTHEST_M**2
        count += near & _is_seen(points, k)
    seen = np.minimum(count, ENOUGH_KEYFRAMES) / ENOUGH_KEYFRAMES
    need = np.where(count >= LEAST_KEYFRAMES, seen * patches.need[fresh], 0)
    some = np.sort(np.argsort(-need, kind="stable")[:PATCHES])
    some = some[need[some] > 0]
    return SurfacePatches(patches.packed[fresh[some]], points[some], need[some])


def _candidates(patches: SurfacePatches, keyframes: Sequence[Keyframe], rng: np.random.Generator) -> list[Float64]:
    """Poses (4, 4) from places in free space to the centres of where need is greatest."""
    poses: list[Float64] = []
    for target in _targets(patches):
        distance = [float(np.linalg.norm(k.T_world_camera[:3, 3] - target)) for k in keyframes]
        seeing = [i for i in np.argsort(distance, kind="stable") if _is_seen(target[None], keyframes[i])[0]]
        for i in seeing[:EYES]:
            at = keyframes[i].T_world_camera[:3, 3]
            aside = at + rng.normal(0, STEP_M, (STEPS_ASIDE, 3))
            up = -keyframes[i].T_world_camera[:3, 1]
            for eye in (at, *aside[in_free_space(aside, keyframes)]):
                far = float(np.linalg.norm(target - eye))
                if NEAREST_M <= far <= FARTHEST_M and abs((target - eye) @ up) < ALONG_UP * far:
                    poses.append(look_at(eye, target, up))
    return poses


def _is_seen(points: Float64, k: Keyframe) -> Bool:
    return visible_points(points, k.T_world_camera, k.intrinsics, k.depth_m, measured=True)


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
    seen = [transform(invert_pose(pose), patches.xyz) for pose in poses]
    gain = np.array([(nearest_pixels(p, intrinsics)[0] * _worth(p[:, 2], patches)).sum() for p in seen])
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


def add_votes(
    voxel_map: VoxelMap,
    T_world_camera: Float64,
    intrinsics: CameraIntrinsics,
    depth_m: Float32,
    table: tuple[Float32, Int32],
) -> int:
    """Give the map's surface the class votes of one view (4, 4), one a voxel; returns the blocks near its surface.

    A vote weighs ``VOTE_WEIGHT`` times what that of a frame would, and only voxels with fewer than ``MAX_VOTES`` take
    it. ``frames`` does not count the view, ``version`` does. ``depth_m`` (H, W) float32 is z of the map's surface, 0 =
    none; ``table`` has probabilities (K, L) float32, and the row (H, W) int32 that each pixel takes, -1 = unknown."""
    limits, camera = make_limits(voxel_map.config), make_camera(intrinsics, T_world_camera)
    votes, _ = make_votes(*table, depth_m, camera, limits.depth_max)
    votes = votes._replace(weights=votes.weights * np.float32(VOTE_WEIGHT))
    with voxel_map.locked() as grid:
        budget = voxel_map.config.max_blocks  # no block is added
        packed = blocks_in_band(depth_m, camera, limits.voxel_size, limits.truncation, limits.depth_max, budget)
        packed = packed[np.isin(packed, grid.all_packed())]
        for blocks in voxel_map.changing(packed) if len(packed) else ():
            vote_into_blocks(len(blocks), blocks, grid.buffers(), camera, limits, depth_m, votes, MAX_VOTES)
    return len(packed)


@parallel_kernel()
def _sum_surface_patches(
    blocks_count: int,
    keys: Int32,
    blocks: Int32,
    buffers: GridBuffers,
    near: float,
    vote_discount: float,
    max_votes: float,
    total: Float64,
    need: Float64,
    count: Int64,
) -> None:
    """Sums over the surface voxels, of a TSDF up to ``near``, of blocks with keys (B, 3) and buffer indices (B,): of
    positions in voxels (B, 3), need as of ``SurfacePatches`` (B,), and how many (B,)."""
