"""Adding the voxels of one map to another: sums of what both have measured, resampled where their voxels differ.

Weights and votes are sums, the rest means by weight or by votes; the caps are those of fusion, except that where votes
pass theirs, old and new fade alike. Maps whose voxels do not coincide are interpolated first, between the eight
voxels around each new one, over those that were observed and only where these outweigh the others. Across a depth edge
the nearest voxel is taken: in between there would be a surface that nobody saw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import MapError
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_grid import BLOCK_SIDE, BlockGrid, GridBuffers
from semantic_mapper.mapping.blocks import BlockIndex, BlockValues, empty_blocks, pack_keys, unpack_keys
from semantic_mapper.types import Float64, Int32, Int64

MERGED_AT_ONCE = 128  # blocks
SNAP_VOXELS = 1e-6  # a shift nearer than this to whole voxels is one: metres have been rounded on their way here
SNAP_ROTATION = 1e-9  # likewise for rotations by quarter turns


class VoxelTransform(NamedTuple):
    """Points of map b to map a, in voxels: ``a = R @ b + t``."""

    R: Float64
    t: Float64


def voxel_transform(T_a_b: Float64, voxel_size_m: float) -> VoxelTransform:
    """In units of voxels, and exact where it maps voxels onto voxels."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3] / voxel_size_m
    if np.abs(R - np.rint(R)).max() < SNAP_ROTATION:
        R = np.rint(R)
        if np.abs(t - np.rint(t)).max() < SNAP_VOXELS:
            t = np.rint(t)
    return VoxelTransform(np.ascontiguousarray(R), np.ascontiguousarray(t))


def check_fit(config_a: VoxelMapConfig, labels_a: LabelSet, config_b: VoxelMapConfig, labels_b: LabelSet) -> None:
    """Refuse maps of another voxel size or other classes (colours and name do not matter): ``MapError``."""
    if config_a.voxel_size_m != config_b.voxel_size_m:
        sizes = f"{config_a.voxel_size_m:g} and {config_b.voxel_size_m:g}"
        raise MapError(f"maps of different voxel_map.voxel_size_m ({sizes}) cannot be merged; make one of them again")
    a, b = (set(zip(labels.ids, labels.names, strict=True)) for labels in (labels_a, labels_b))
    if a != b or labels_a.ids != labels_b.ids or labels_a.ignore_id != labels_b.ignore_id:
        differing = ", ".join(f"{i} {name}" for i, name in sorted(a ^ b)) or "their order, or the ignore id"
        raise MapError(
            f"maps with different classes cannot be merged: label sets '{labels_a.name}' ({len(labels_a)} classes) and "
            f"'{labels_b.name}' ({len(labels_b)}) differ in {differing}; make both with the same weights"
        )


def add_blocks(target: BlockGrid, source: BlockGrid, T_target_source: VoxelTransform, cap: float, version: int) -> None:
    """Add all that ``source`` has measured to ``target``, a grid of the same voxels and classes, ``MERGED_AT_ONCE``
    blocks at a time. ``cap`` is of weights and of votes, ``version`` that of the blocks that change."""
    R_source_target = np.ascontiguousarray(T_target_source.R.T)
    for wanted, needed in _parts(overlaps(source.all_packed(), T_target_source)):
        grid = source.holding(needed)
        moved = empty_blocks(len(wanted), source.classes)
        _resample_blocks(
            len(wanted), unpack_keys(wanted), R_source_target, T_target_source.t, grid.index, grid.buffers(), moved
        )
        holds = np.flatnonzero((moved.weight > 0).any(axis=1))  # votes come with weight
        if len(holds):
            blocks = target.activate(wanted[holds])
            _add_block_values(len(blocks), blocks, target.buffers(), moved.take(holds), cap)
            target.mark_changed(blocks, version)


def copy_blocks(target: BlockGrid, source: BlockGrid, version: int) -> None:
    """Make ``target``, which is empty and of the same classes, hold what ``source`` has measured, as of ``version``."""
    packed = source.all_packed()
    for start in range(0, len(packed), MERGED_AT_ONCE):
        part = packed[start : start + MERGED_AT_ONCE]
        values = source.read(part)
        holds = np.flatnonzero((values.weight > 0).any(axis=1))
        target.mark_changed(target.fill(part[holds], values.take(holds)), version)


def overlaps(sources: Int64, T_target_source: VoxelTransform) -> Int64:
    """Pairs (P, 2) of packed keys, sorted: a block of the target and a source block that may say something of it."""
    corners = np.array([[x, y, z] for x in (-1, BLOCK_SIDE) for y in (-1, BLOCK_SIDE) for z in (-1, BLOCK_SIDE)])
    ends = (unpack_keys(sources)[:, None] * BLOCK_SIDE + corners) @ T_target_source.R.T + T_target_source.t
    # A source block speaks for what lies strictly between: less than a voxel outside of its own voxels 0..7.
    first = np.floor((np.floor(ends.min(axis=1)) + 1) / BLOCK_SIDE).astype(np.int64)
    last = np.floor((np.ceil(ends.max(axis=1)) - 1) / BLOCK_SIDE).astype(np.int64)
    most = int((last - first).max(initial=0)) + 1
    pairs: list[Int64] = []
    for step in np.ndindex(most, most, most):
        inside = (first + step <= last).all(axis=1)
        keys = (first[inside] + step).astype(np.int32)
        pairs.append(np.stack((pack_keys(keys), sources[inside]), axis=1))
    joined = np.concatenate(pairs)
    return joined[np.lexsort((joined[:, 1], joined[:, 0]))]


def _parts(pairs: Int64) -> Iterator[tuple[Int64, Int64]]:
    """The blocks of the target, some at a time, each time with the source blocks that they need."""
    wanted, starts = np.unique(pairs[:, 0], return_index=True)
    ends = np.append(starts[1:], len(pairs))
    for start in range(0, len(wanted), MERGED_AT_ONCE):
        stop = min(start + MERGED_AT_ONCE, len(wanted))
        yield wanted[start:stop], np.unique(pairs[starts[start] : ends[stop - 1], 1])


@parallel_kernel()
def _resample_blocks(
    count: int, keys: Int32, R: Float64, t: Float64, index: BlockIndex, buffers: GridBuffers, moved: BlockValues
) -> None:
    """Interpolate a source at voxels of other blocks (B, 3): p is the source's ``R @ (p - t)``, voxels."""


@parallel_kernel()
def _add_block_values(count: int, blocks: Int32, buffers: GridBuffers, added: BlockValues, cap: float) -> None:
    """Add blocks ``added`` to those with buffer indices ``blocks`` (B,), in place."""
