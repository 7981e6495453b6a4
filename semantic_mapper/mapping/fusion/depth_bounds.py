"""How near and how far the depth of each part of an image is, in tables that answer for any square at once.

The least depth of a square of pixels is the least of four entries, whatever its size: those of the largest square of
2^level cells a side that fits, put into each of its corners. The loops are in ``clearing.c``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semantic_mapper.kernels import kernel
from semantic_mapper.types import Float32

_CELLS = 320  # along the longer side of an image, at least; a cell has 2 x 2 pixels at 640 x 480
_COARSE = 8  # cells a side of those of ``farthest``
_LEVELS = 6  # squares of up to 64 cells a side


class DepthBounds(NamedTuple):
    """Least and greatest depth of parts of an image that is cut into square cells.

    Args:
        nearest: (levels, h, w) float32 metres: of the 2^level x 2^level cells from each one on; inf where there is no
            depth. No levels: nothing is to be cleared.
        farthest: (ceil(h / 8), ceil(w / 8)) float32 metres, of 8 x 8 cells; 0 where there is no depth.
        cell: Pixels a side.
    """

    nearest: Float32
    farthest: Float32
    cell: int


NO_BOUNDS = DepthBounds(np.empty((0, 0, 0), np.float32), np.empty((0, 0), np.float32), 1)


def depth_bounds(depth: Float32, depth_max_m: float, before: DepthBounds = NO_BOUNDS) -> DepthBounds:
    """Bounds of depth (H, W) in metres; what is farther than ``depth_max_m`` is not measured.

    They take the memory of ``before``, which nobody looks at any more, where the size is the same: new memory of 2 MB
    costs as much as filling it.
    """
    cell = max(1, max(depth.shape) // _CELLS)
    h, w = depth.shape[0] // cell, depth.shape[1] // cell
    bounds = before
    if before.cell != cell or before.nearest.shape != (_LEVELS, h, w):
        farthest = np.empty((-(-h // _COARSE), -(-w // _COARSE)), np.float32)
        bounds = DepthBounds(np.empty((_LEVELS, h, w), np.float32), farthest, cell)
    _bound_depth(depth, depth_max_m, bounds)
    return bounds


# Serial: it takes less time than to wake another thread would.
@kernel
def _bound_depth(depth: Float32, depth_max: float, bounds: DepthBounds) -> None:
    """Fill the bounds."""
    ...
