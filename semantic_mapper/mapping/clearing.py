"""Free space clears: a surface that a frame sees through loses its weight, and is gone after a few such frames.

A voxel is part of a surface where its TSDF is below ``LARGEST_CLEARED_TSDF``. A frame sees through it where its pixel
is measured, of the eight around at most ``MOST_HOLES`` are not, and all that is measured in its surroundings lies well
behind it. The surroundings reach as far as voxel and pose may be off (``ASIDE_VOXELS``, ``ASIDE_PER_M``), so that thin
things, depth edges and grazing views are safe; the margin grows with voxels and depth (``MARGIN_VOXELS``,
``MARGIN_PER_M``). Pixels without depth, beyond ``depth_max``, near the edge of the image, or of computed depth clear
nothing.

Each such frame halves the weight of the voxel, of which ``MOST_KEPT`` stays at most. Where less than one measurement is
left, the voxel becomes free and loses its votes: three frames clear any surface, one what a single frame saw. What is
seen through in every second frame or less, as by mirrors, stays.

Blocks of the truncation band are cleared while they are fused (``fusion.c``). This module clears the others in view.
The numbers stand in ``kernels/src/see_through.h``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from semantic_mapper.kernels import kernel, parallel_kernel
from semantic_mapper.mapping.allocation import Camera
from semantic_mapper.mapping.block_grid import BlockGrid, GridBuffers
from semantic_mapper.mapping.blocks import find_blocks, pack_keys, unpack_keys
from semantic_mapper.types import Float32, Int32, Int64, UInt8

_CELLS = 320  # along the longer side of an image, at least; a cell has 2 x 2 pixels at 640 x 480
_COARSE = 8  # cells a side of those of ``farthest``
_LEVELS = 6  # squares of up to 64 cells a side


class FusionLimits(NamedTuple):
    """Lengths in metres, and the caps."""

    voxel_size: float
    truncation: float  # of the TSDF
    depth_max: float  # farther depth is ignored
    vote_band: float  # voxels at most this far from the surface take votes
    max_weight: float  # cap of TSDF weight and of votes; beyond it old measurements fade


class Scene(NamedTuple):
    """A frame as kernels take it, and the limits of the map."""

    camera: Camera
    limits: FusionLimits
    depth: Float32  # (H, W) metres
    rgb: UInt8  # (H, W, 3)


class DepthBounds(NamedTuple):
    """Least and greatest depth of parts of an image that is cut into square cells, for any square at once: the least of
    a square of pixels is that of the largest 2^level squares that fit, put into each of its corners."""

    # (levels, h, w) float32 metres: of the 2^level x 2^level cells from each one on; inf where there is no depth. No
    # levels: nothing is to be cleared.
    nearest: Float32
    farthest: Float32  # (ceil(h / 8), ceil(w / 8)) float32 metres, of 8 x 8 cells; 0 where there is no depth
    cell: int  # pixels a side


NO_BOUNDS = DepthBounds(np.empty((0, 0, 0), np.float32), np.empty((0, 0), np.float32), 1)


def depth_bounds(depth: Float32, depth_max_m: float, before: DepthBounds = NO_BOUNDS) -> DepthBounds:
    """Bounds of depth (H, W) in metres; beyond ``depth_max_m`` nothing is measured. They take the memory of ``before``,
    which nobody uses any more, where the size is the same: new memory of 2 MB costs as much as filling it."""
    cell = max(1, max(depth.shape) // _CELLS)
    h, w = depth.shape[0] // cell, depth.shape[1] // cell
    bounds = before
    if before.cell != cell or before.nearest.shape != (_LEVELS, h, w):
        farthest = np.empty((-(-h // _COARSE), -(-w // _COARSE)), np.float32)
        bounds = DepthBounds(np.empty((_LEVELS, h, w), np.float32), farthest, cell)
    _bound_depth(depth, depth_max_m, bounds)
    return bounds


def clear_in_view(
    grid: BlockGrid, band: Int64, scene: Scene, bounds: DepthBounds, version: int
) -> Iterator[tuple[Int64, Int64]]:
    """Clear what a frame with a sensor's depth sees through outside of the truncation ``band`` (B,), sorted packed
    keys, in place, under the map's lock: keys (B,) of changed blocks, which get ``version``, and voxels of each."""
    packed = _candidates(grid, band, scene, bounds)
    for start in range(0, len(packed), grid.room):
        part = packed[start : start + grid.room]
        seen, _ = _clear(grid.page_in(part), grid.buffers(), scene, bounds, changes=False)
        if seen.any():  # only these count as changed
            changing = part[seen > 0]
            blocks = grid.activate(changing)
            _, cleared = _clear(blocks, grid.buffers(), scene, bounds, changes=True)
            grid.mark_changed(blocks, version)
            yield changing, cleared


def _candidates(grid: BlockGrid, band: Int64, scene: Scene, bounds: DepthBounds) -> Int64:
    """Packed keys (B,), sorted, of blocks outside of the band that hold a surface, in front of some depth."""
    considered = grid.may_hold_surface()
    inside = find_blocks(grid.index, band)
    considered[inside[inside >= 0]] = 0
    keys = grid.buffers().keys
    slots = np.flatnonzero(_before_depth(keys, considered, scene, bounds)).astype(np.int32)
    slots = slots[grid.hold_surface(slots)]
    stored = grid.stored_surface
    if not len(stored):
        return np.sort(pack_keys(keys[slots]))
    stored = stored[~np.isin(stored, band)]
    before = _before_depth(unpack_keys(stored), np.ones(len(stored), np.uint8), scene, bounds)
    return np.sort(np.concatenate((pack_keys(keys[slots]), stored[before > 0])))


def _before_depth(keys: Int32, considered: UInt8, scene: Scene, bounds: DepthBounds) -> UInt8:
    found = np.empty(len(keys), np.uint8)
    _blocks_before_depth(len(keys), keys, considered, scene.camera, scene.limits.voxel_size, bounds, found)
    return found


def _clear(
    blocks: Int32, buffers: GridBuffers, scene: Scene, bounds: DepthBounds, *, changes: bool
) -> tuple[Int64, Int64]:
    seen, cleared = np.empty(len(blocks), np.int64), np.empty(len(blocks), np.int64)
    _clear_blocks(len(blocks), blocks, buffers, scene, bounds, changes, seen, cleared)
    return seen, cleared


@parallel_kernel()
def _blocks_before_depth(
    count: int, keys: Int32, considered: UInt8, camera: Camera, voxel_size: float, bounds: DepthBounds, found: UInt8
) -> None:
    """Which of the blocks (B, 3) that are ``considered`` (B,) may have a voxel in front of the depth: (B,) to fill."""


@parallel_kernel(chunks_per_thread=4)
def _clear_blocks(
    count: int,
    indices: Int32,
    buffers: GridBuffers,
    scene: Scene,
    bounds: DepthBounds,
    changes: bool,
    seen: Int64,
    cleared: Int64,
) -> None:
    """Weaken voxels that the frame sees through where ``changes``; count them, and those that were cleared: (B,)."""


# Serial: it takes less time than to wake another thread would.
@kernel
def _bound_depth(depth: Float32, depth_max: float, bounds: DepthBounds) -> None:
    """Fill the bounds."""
