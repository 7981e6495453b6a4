"""Fusion of one frame in one compiled pass over the blocks it touches: TSDF, colour and class evidence together.

TSDF and colour are the running means of Open3D's ``integrate``. Class evidence is the mean by weight of ``-log p`` at
the pixel a voxel projects to: one vote a voxel a frame, only near the surface. The weight (0..1) trusts near and
frontal looks more; see ``make_votes``. The result does not depend on threads.

Depth of a sensor weighs ``MEASURED`` in the TSDF; computed depth at most ``COMPUTED_LOOK``, and all of it together at
most ``COMPUTED_CAP``: so the weight of a voxel says whether its surface was measured. It changes nothing measured."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig, convert_config, to_plain
from semantic_mapper.errors import FrameError, ShapeError
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.allocation import Camera
from semantic_mapper.mapping.block_grid import GridBuffers
from semantic_mapper.mapping.clearing import NO_BOUNDS, DepthBounds, FusionLimits, Scene
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Int32, Int64, UInt16

MEASURED = 1.0
COMPUTED_LOOK = 1 / 32
COMPUTED_CAP = 31 / 32
SURFACE_WEIGHT = 4 * COMPUTED_LOOK  # from which on a voxel is part of the surface: four sure looks, or more unsure ones
FULL_TRUST_RANGE_M = 2.0  # a vote from farther counts (2 m / z)^2: a pixel covers that much more surface there
EVIDENCE_STEPS = 4096  # a nat: evidence is a whole number of such steps, below 16 nats
PROBABILITY_FLOOR = 1e-4  # one confident mistake must not outweigh many modest looks: a vote moves at most ln 1e4


def make_limits(config: VoxelMapConfig) -> FusionLimits:
    """Limits of a map; ``ConfigError`` where no map can be built with a value."""
    convert_config(to_plain(config), VoxelMapConfig, "voxel_map")  # structs made in Python are not checked
    return FusionLimits(
        voxel_size=config.voxel_size_m,
        truncation=config.truncation_voxels * config.voxel_size_m,
        depth_max=config.depth_max_m,
        vote_band=config.vote_band_voxels * config.voxel_size_m,
        max_weight=config.max_weight,
    )


class Votes(NamedTuple):
    """What a frame says of classes."""

    evidence: UInt16  # (K, L) ``evidence_of`` probabilities, floored
    rows: Int32  # (H, W) which row each pixel takes; looked at only where ``weights`` > 0
    weights: Float32  # (H, W) in 0..1


def make_votes(
    probabilities: Float32, rows: Int32, depth: Float32, camera: Camera, depth_max: float
) -> tuple[Votes, int]:
    """Votes of a frame, each of weight ``max(cos, 0.2) * min(1, (2 m / z)^2)``, 0 where none is due; and how many known
    pixels hold what is no probability. Rows of ``probabilities`` (K, L) by pixel: ``rows`` (H, W) int32, -1 = unknown;
    ``depth`` (H, W) in metres."""
    evidence, proper = np.empty(probabilities.shape, np.uint16), np.empty(len(probabilities), np.bool_)
    _evidence_of_rows(len(probabilities), probabilities, evidence, proper)
    weights, bad = np.empty(depth.shape, np.float32), np.empty(len(depth), np.int64)
    _vote_weights(len(depth), depth, rows, proper, camera, depth_max, weights, bad)
    return Votes(evidence, rows, weights), int(bad.sum())


def evidence_of(log_p: Float32) -> UInt16:
    """Evidence (..., L) as it is stored, of log probabilities (..., L): ``-log_p`` in steps, 16 nats at most."""
    return np.rint(np.clip(-EVIDENCE_STEPS * log_p, 0, 65535)).astype(np.uint16)


def checked_depth(
    depth_m: Float32, trust: Float32 | None, intrinsics: CameraIntrinsics, where: str
) -> tuple[Float32, Float32]:
    """Depth (H, W) as one piece of memory, without what is not trusted, and its weights as ``fuse_blocks`` takes them.

    ``ShapeError``: depth or weights do not fit the intrinsics, are not float32, or weights are not in 0..1."""
    size = f"{intrinsics.height} {intrinsics.width}"
    _expect(depth_m, size, np.float32, f"{where}: depth_m")
    if trust is None:
        return np.ascontiguousarray(depth_m), np.empty((0, 0), np.float32)
    _expect(trust, size, np.float32, f"{where}: trust")
    if not ((trust >= 0) & (trust <= 1)).all():
        raise ShapeError(f"{where}: trust must be 0 ... 1 everywhere")
    return np.where(trust > 0, depth_m, np.float32(0)), np.ascontiguousarray(trust)


def frame_votes(
    depth: Float32,
    probabilities: Float32,
    known: Bool | None,
    rows: Int32 | None,
    trust: Float32,
    camera: Camera,
    depth_max_m: float,
    classes: int,
    where: str,
) -> Votes:
    """Votes of a frame, however its probabilities were given (``VoxelMap.integrate``); each weighs what the depth under
    it does, where ``trust`` says so. ``ShapeError``: something does not fit the depth (H, W), or is of another dtype;
    ``FrameError``: invalid probabilities."""
    size = f"{depth.shape[0]} {depth.shape[1]}"
    if rows is None:
        _expect(probabilities, f"{size} {classes}", np.float32, f"{where}: probabilities")
        rows = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
        if known is not None:
            _expect(known, size, np.bool_, f"{where}: known")
            rows[~known] = -1
    else:
        _expect(probabilities, f"K {classes}", np.float32, f"{where}: probabilities")
        _expect(rows, size, np.int32, f"{where}: rows")
        if known is not None or rows.min() < -1 or rows.max() >= len(probabilities):
            raise ShapeError(f"{where}: rows must be -1 ... {len(probabilities) - 1}, and known None")
    table = np.ascontiguousarray(probabilities).reshape(-1, classes)
    votes, bad = make_votes(table, np.ascontiguousarray(rows), depth, camera, depth_max_m)
    if bad:
        raise FrameError(f"{where}: probabilities of {bad} known pixels are NaN, negative or do not sum to 1")
    return votes._replace(weights=votes.weights * trust) if trust.size else votes


def _expect(array: NDArray[np.generic], shape: str, dtype: type[np.generic], name: str) -> None:
    expect_shape(array, shape, name)
    if array.dtype != dtype:
        raise ShapeError(f"{name}: expected dtype {np.dtype(dtype).name}, got {array.dtype.name}")


def fuse_blocks(
    indices: Int32,
    buffers: GridBuffers,
    scene: Scene,
    trust: Float32,
    votes: Votes,
    *,
    measured: bool = True,
    bounds: DepthBounds = NO_BOUNDS,
) -> Int64:
    """Fuse one frame into blocks (B,), each once, in place; returns how many surface voxels of each were cleared (B,).

    ``trust`` (H, W) float32 is the fraction of its weight that each depth counts, or (0, 0): 1. ``bounds`` are of the
    depth, where what the frame sees through is to be cleared; see ``clearing``."""
    cleared = np.empty(len(indices), np.int64)
    look, cap = (MEASURED, scene.limits.max_weight) if measured else (COMPUTED_LOOK, COMPUTED_CAP)
    _fuse_frame_into_blocks(len(indices), indices, buffers, scene, trust, votes, look, cap, bounds, cleared)
    return cleared


@parallel_kernel()
def _evidence_of_rows(count: int, probabilities: Float32, evidence: UInt16, proper: Bool) -> None:
    """Evidence of rows (K, L), floored, and whether each (K,) is of numbers that are not negative and sum to 1."""


@parallel_kernel()
def _vote_weights(
    height: int,
    depth: Float32,
    rows: Int32,
    proper: Bool,
    camera: Camera,
    depth_max: float,
    weights: Float32,
    bad: Int64,
) -> None:
    """Weigh votes (H, W): |cos| of the angle between ray and surface normal, from four neighbours, times nearness;
    ``bad`` (H,) counts known pixels of each image row whose row of the table is not ``proper`` (K,)."""


@parallel_kernel(chunks_per_thread=4)
def _fuse_frame_into_blocks(
    count: int,
    indices: Int32,
    buffers: GridBuffers,
    scene: Scene,
    trust: Float32,
    votes: Votes,
    look: float,
    weight_cap: float,
    bounds: DepthBounds,
    cleared: Int64,
) -> None: ...


@parallel_kernel()
def vote_into_blocks(
    count: int,
    indices: Int32,
    buffers: GridBuffers,
    camera: Camera,
    limits: FusionLimits,
    depth: Float32,
    votes: Votes,
    max_votes: float,
) -> None:
    """Vote as ``fuse_blocks`` does, at measured voxels with fewer than ``max_votes``, and change nothing else."""
