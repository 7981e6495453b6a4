"""Fusion of one frame in one compiled pass over the blocks it touches: TSDF, colour and class evidence together.

TSDF and colour are the running means of Open3D's ``integrate``. Class evidence is the sum over frames of
``w * log p`` at the pixel a voxel projects to: one vote a voxel a frame, only near the surface, where the field
knows. ``w`` (0..1) trusts near and frontal looks more; see ``make_votes``.

The kernels (``fusion.c``) depend on no order among threads, so a frame gives the same bits every time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.fusion.allocation import Camera
from semantic_mapper.mapping.fusion.depth_bounds import NO_BOUNDS, DepthBounds
from semantic_mapper.mapping.fusion.depth_trust import COMPUTED_CAP, COMPUTED_LOOK, MEASURED
from semantic_mapper.mapping.fusion.evidence import DITHER
from semantic_mapper.mapping.storage.grid_buffers import GridBuffers
from semantic_mapper.types import Bool, Float32, Int32, Int64, UInt8

FULL_TRUST_RANGE_M = 2.0  # a vote from farther counts (2 m / z)^2: a pixel covers that much more surface there
LEAST_COSINE = 0.2  # of the angle between ray and surface normal; grazing looks count this much, never nothing


_BOUNDS = {  # of the settings of a map: what is beyond is a slip of units or digits, and would overflow or never end
    "voxel_size_m": (1e-4, 10.0),
    "truncation_voxels": (1e-3, 100.0),
    "depth_max_m": (1e-3, 1000.0),
    "no_return_range_m": (0.0, 1000.0),
    "initial_blocks": (1, 1 << 27),
    "max_blocks": (1, 1 << 27),
    "max_weight": (1.0, 1e6),
}


class FusionLimits(NamedTuple):
    """Lengths in metres, and the caps.

    Args:
        voxel_size: Edge of a voxel.
        truncation: TSDF truncation.
        depth_max: Farther depth is ignored.
        vote_band: Voxels at most this far from the surface take votes.
        max_weight: Cap of TSDF weight and of votes; beyond it old measurements fade.
    """

    voxel_size: float
    truncation: float
    depth_max: float
    vote_band: float
    max_weight: float


def make_limits(config: VoxelMapConfig) -> FusionLimits:
    """Limits of a map.

    Raises:
        ConfigError: a value that no map can be built with.
    """
    for name, (least, most) in _BOUNDS.items():
        value = getattr(config, name)
        if not least <= value <= most:  # NaN, too
            raise ConfigError(f"voxel_map.{name} must be from {least:g} to {most:g}, got {value}")
    if not (config.vote_discount >= 0 and config.vote_band_voxels >= 0):
        raise ConfigError("voxel_map.vote_discount and vote_band_voxels must not be negative")
    return FusionLimits(
        voxel_size=config.voxel_size_m,
        truncation=config.truncation_voxels * config.voxel_size_m,
        depth_max=config.depth_max_m,
        vote_band=config.vote_band_voxels * config.voxel_size_m,
        max_weight=config.max_weight,
    )


class Votes(NamedTuple):
    """What a frame says of classes.

    Args:
        log_p: (K, L) float32 log probabilities, floored.
        rows: (H, W) int32, which row each pixel takes; looked at only where ``weights`` > 0.
        weights: (H, W) float32 in 0..1.
    """

    log_p: Float32
    rows: NDArray[np.int32]
    weights: Float32


def make_votes(
    probabilities: Float32, rows: NDArray[np.int32], depth: Float32, camera: Camera, depth_max: float
) -> tuple[Votes, int]:
    """Votes of a frame, each of weight ``max(cos, 0.2) * min(1, (2 m / z)^2)``, 0 where none is due.

    Args:
        probabilities: (K, L) float32, each row that is referred to summing to 1.
        rows: (H, W) int32 row of each pixel, -1 = unknown.
        depth: (H, W) float32 metres.

    Returns:
        The votes, and how many known pixels hold probabilities that are not finite, negative or do not sum to 1.
    """
    log_p, proper = np.empty_like(probabilities), np.empty(len(probabilities), np.bool_)
    _log_probability_rows(len(probabilities), probabilities, log_p, proper)
    weights, bad = np.empty(depth.shape, np.float32), np.empty(len(depth), np.int64)
    _vote_weights(len(depth), depth, rows, proper, camera, depth_max, weights, bad)
    return Votes(log_p, rows, weights), int(bad.sum())


def no_votes(height: int, width: int, classes: int) -> Votes:
    """Of a frame without semantics: weights all 0."""
    rows, weights = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    return Votes(np.zeros((1, classes), np.float32), rows, weights)


def fuse_blocks(
    indices: Int32,
    buffers: GridBuffers,
    camera: Camera,
    limits: FusionLimits,
    depth: Float32,
    rgb: UInt8,
    trust: Float32,
    votes: Votes,
    moment: int,
    *,
    measured: bool = True,
    bounds: DepthBounds = NO_BOUNDS,
) -> Int64:
    """Fuse one frame into blocks, in place.

    Args:
        indices: (B,) buffer indices of the blocks, each once.
        buffers: Of the grid.
        camera: Of the frame.
        limits: Of the map.
        depth: (H, W) float32 metres.
        rgb: (H, W, 3) uint8.
        trust: (H, W) float32 fraction of its full weight that each depth counts, or (0, 0): 1.
        votes: Of the frame.
        moment: A number that changes from frame to frame; see ``evidence``.
        measured: Whether a sensor measured the depth; see ``depth_trust``.
        bounds: Of the depth, where what the frame sees through is to be cleared; see ``clearing``.

    Returns:
        (B,) voxels of a surface that were cleared.
    """
    cleared = np.empty(len(indices), np.int64)
    look, cap = (MEASURED, limits.max_weight) if measured else (COMPUTED_LOOK, COMPUTED_CAP)
    args = (indices, buffers, camera, limits, depth, rgb, trust, votes, DITHER, moment, look, cap)
    _fuse_frame_into_blocks(len(indices), *args, bounds, cleared)
    return cleared


@parallel_kernel()
def _log_probability_rows(count: int, probabilities: Float32, logs: Float32, proper: Bool) -> None:
    """Floored log of rows (K, L), and whether each (K,) is of numbers that are not negative and sum to 1."""
    ...


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
    """Weigh votes: |cos| of the angle between ray and surface normal, from four neighbours, times nearness.

    Args:
        height: H.
        depth: (H, W) metres.
        rows: (H, W) row of each pixel, -1 = unknown.
        proper: (K,) of ``_log_probability_rows``.
        camera: Of the frame.
        depth_max: Farther depth is ignored.
        weights: (H, W) to fill.
        bad: (H,) to fill: known pixels of each row of the image whose probabilities are not proper.
    """
    ...


@parallel_kernel(chunks_per_thread=4)
def _fuse_frame_into_blocks(
    count: int,
    indices: Int32,
    buffers: GridBuffers,
    camera: Camera,
    limits: FusionLimits,
    depth: Float32,
    rgb: UInt8,
    trust: Float32,
    votes: Votes,
    dither: Float32,
    moment: int,
    look: float,
    weight_cap: float,
    bounds: DepthBounds,
    cleared: Int64,
) -> None: ...
