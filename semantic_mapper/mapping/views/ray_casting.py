"""The map seen from a pose, and read at points: a compiled ray caster over the sparse blocks.

Open3D's own ``ray_cast`` is off by half a voxel and can crash when its range buffer overflows; this one walks from
block to block, steps by the TSDF and finds the zero crossing on the interpolated field. There, and at any other point,
the map is read by interpolation over the eight voxels around it, then label and confidence.

With n votes of evidence e, what the votes say together is ``p = softmax(e * n_eff / n)``, where
``n_eff = n / (1 + rho (n - 1))`` for n > 1: views of one place repeat each other's errors, so a hundred of them are
worth at most 1 / rho independent ones. A vote that is trusted less, n < 1, weighs less against others, but where it is
the only one it means what the field said: n_eff = 1. The label is the argmax, its confidence p[label]. Below
``unknown_below`` the label is unknown; the confidence stays that of the likeliest class.

The C code of it is in ``ray_casting.h`` and ``readout.h``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.fusion.allocation import Camera, blocks_in_view, view_bounds
from semantic_mapper.mapping.storage.block_grid import BlockGrid, GridBuffers
from semantic_mapper.mapping.storage.block_index import BlockIndex, unpack_keys
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, Int64, UInt8


class Window(NamedTuple):
    """Part of an image: first row and column, rows and columns."""

    top: int
    left: int
    height: int
    width: int

    def halves(self) -> tuple[Window, Window]:
        """Both halves of its longer side."""
        if self.height > self.width:
            half = self.height // 2
            return self._replace(height=half), self._replace(top=self.top + half, height=self.height - half)
        half = self.width // 2
        return self._replace(width=half), self._replace(left=self.left + half, width=self.width - half)


def cast_view(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig
) -> tuple[Float32, UInt8, NDArray[np.int64], Float32, Bool]:
    """See the map through a camera, up to ``depth_max_m`` away.

    What it may see and is on disk comes back into memory; where there is no room for all of it, for a part of the image
    after the other. (Where even what one pixel may see does not fit, its ray meets the nearest of that.)

    Returns:
        depth (H, W) float32 metres (0 = miss), rgb (H, W, 3) uint8, channel (H, W) int64 (-1 = unknown),
        confidence (H, W) float32, measured (H, W) bool.
    """
    size = (intrinsics.height, intrinsics.width)
    depth, confidence = np.zeros(size, np.float32), np.zeros(size, np.float32)
    rgb, channel = np.zeros((*size, 3), np.uint8), np.full(size, -1, np.int64)
    measured = np.zeros(size, np.bool_)
    for window, seen in _windows(grid, camera, intrinsics, config):
        if len(seen):
            grid.page_in(seen)
        _cast_view_rows(
            window.height,
            camera,
            window,
            config.voxel_size_m,
            config.truncation_voxels,
            config.depth_max_m,
            config.vote_discount,
            config.unknown_below,
            grid.index,
            grid.buffers(),
            depth,
            rgb,
            channel,
            confidence,
            measured,
        )
    return depth, rgb, channel, confidence, measured


def _windows(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig
) -> Iterator[tuple[Window, NDArray[np.int64]]]:
    """Parts of an image that together are all of it, each with packed keys (B,) of what it may see, nearest first.

    One part, and no keys, where nothing is on disk.
    """
    whole = Window(0, 0, intrinsics.height, intrinsics.width)
    if not grid.stored_count:
        yield whole, np.empty(0, np.int64)
        return
    voxel, reach = config.voxel_size_m, config.depth_max_m + config.truncation_voxels * config.voxel_size_m
    waiting = [(whole, grid.keys_between(*view_bounds(camera, intrinsics, voxel, reach)))]
    while waiting:
        window, keys = waiting.pop()
        moved = camera._replace(cx=camera.cx - window.left, cy=camera.cy - window.top)
        seen = blocks_in_view(moved, (window.height, window.width), keys, voxel, reach)
        if len(seen) <= grid.room or window.height * window.width == 1:
            yield window, seen
        else:
            waiting += [(half, unpack_keys(seen)) for half in reversed(window.halves())]


def read_points(
    voxels: Float64,
    index: BlockIndex,
    buffers: GridBuffers,
    label_set: LabelSet,
    vote_discount: float,
    unknown_below: float,
) -> tuple[UInt8, UInt8, Float32, Bool]:
    """Colour, label and confidence at points, and whether their surface was measured.

    Args:
        voxels: (N, 3) float64 world points in units of voxels.
        index, buffers: Of the grid.
        label_set: For the ids.
        vote_discount: rho.
        unknown_below: Confidence below which a label is the ignore id.

    Returns:
        rgb (N, 3) uint8, label (N,) uint8 ids (ignore id = unknown), confidence (N,) float32 (0 = no votes), measured
        (N,) bool, False where depth of a voxel around was computed, or none lies around.
    """
    rgb, channel = np.zeros((len(voxels), 3), np.uint8), np.full(len(voxels), -1, np.int64)
    confidence, measured = np.zeros(len(voxels), np.float32), np.zeros(len(voxels), np.bool_)
    points = np.ascontiguousarray(voxels)
    decision = (vote_discount, unknown_below)
    _read_map_points(len(points), points, index, buffers, *decision, rgb, channel, confidence, measured)
    return rgb, label_set.to_ids(channel), confidence, measured


@parallel_kernel()
def _cast_view_rows(
    rows: int,
    camera: Camera,
    window: Window,
    voxel_size_m: float,
    truncation_voxels: float,
    depth_max_m: float,
    vote_discount: float,
    unknown_below: float,
    index: BlockIndex,
    buffers: GridBuffers,
    depth: Float32,
    rgb: UInt8,
    channel: Int64,
    confidence: Float32,
    measured: Bool,
) -> None:
    """Fill the rows of a window of what ``cast_view`` returns."""
    ...


@parallel_kernel()
def _read_map_points(
    count: int,
    voxels: Float64,
    index: BlockIndex,
    buffers: GridBuffers,
    vote_discount: float,
    unknown_below: float,
    rgb: UInt8,
    channel: Int64,
    confidence: Float32,
    measured: Bool,
) -> None:
    """Fill rgb (N, 3), channel (N,), -1 = unknown, confidence (N,) and measured (N,) of points (N, 3)."""
    ...
