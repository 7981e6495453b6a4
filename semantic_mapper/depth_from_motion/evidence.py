"""What is known of each pixel of a view before the network looks at it, without a unit of length.

Inverse depths are fractions of the sweep's largest one, and enter as logarithms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.depth_from_motion.agreement import Agreement
from semantic_mapper.depth_from_motion.sweep import SweepResult
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, UInt8

UInt16 = NDArray[np.uint16]

CANDIDATES = slice(5, 11)  # channels of depths that the network chooses from: `Evidence` says which
MEMBRANE, HINT_CHANNELS, COST_CHANNELS = 7, slice(10, 13), slice(24, 37)
CHANNELS = 37
LEAST_INVERSE = 0.01  # fraction of the sweep's largest inverse depth; nothing is farther away


class Matched(NamedTuple):
    """What matching found of a view.

    Args:
        inverse_depth: (D,) of the sweep's planes.
        swept, agreement: Of each pixel.
        surface: (h, w) the membrane through it, in planes.
    """

    inverse_depth: Float32
    swept: SweepResult
    agreement: Agreement
    surface: Float32


def gather_evidence(
    reference: PreparedView, matched: Matched, source_count: int, hint: DepthEstimate | None
) -> Float32:
    """Channels (37, h, w) of ``reference``.

    0-2 colour; 3-4 direction of the ray; 5-10 depths: averaged with neighbours that agree, as matched, of the membrane,
    of the second-best plane, of the plane that matches best by itself, of the hint; 11-12 whether there is a hint, and
    how sure it is; 13-18 confidence, cost, sources that see it, neighbours that agree, that see it, sources in all;
    19-23 width of the minimum of the costs; 24-36 costs beside it.

    Args:
        source_count: Views that were swept.
        hint: As the sweep had it.
    """
    inverse_depth, swept, agreement, surface = matched
    size = reference.gray.shape
    first, last = float(inverse_depth[0]), float(inverse_depth[-1])
    step = float(inverse_depth[1] - inverse_depth[0])
    second, winner = np.empty(size, np.float32), np.empty(size, np.float32)
    interval, out = np.empty((4, *size), np.float32), np.empty((CHANNELS, *size), np.float32)
    describe_costs(size[0], swept.path_sum, swept.cost, second, winner, interval, out[COST_CHANNELS])

    def logarithm(plane: Float32) -> Float32:
        return np.log(np.maximum((first + plane * step) / last, LEAST_INVERSE))

    out[0:3] = reference.rgb.transpose(2, 0, 1) * np.float32(1 / 255) - np.float32(0.5)
    k = reference.intrinsics
    out[3] = (np.arange(size[1], dtype=np.float32) - np.float32(k.cx)) / np.float32(k.fx)
    out[4] = ((np.arange(size[0], dtype=np.float32) - np.float32(k.cy)) / np.float32(k.fy))[:, None]
    out[5] = np.log(np.maximum(1 / (agreement.mean_m * last), LEAST_INVERSE))
    out[6], out[7] = logarithm(swept.plane), logarithm(surface)
    out[8], out[9] = logarithm(second), logarithm(winner)
    out[HINT_CHANNELS] = _hint_channels(hint, last, out[7])
    out[13], out[14] = swept.confidence, swept.match / 48
    out[15], out[16] = swept.seen / 4, agreement.agree / 6
    out[17], out[18] = agreement.visible / 6, source_count / 4
    out[19] = out[5] - out[6]
    out[20:24] = interval / 16
    return out


def _hint_channels(hint: DepthEstimate | None, last: float, otherwise: Float32) -> Float32:
    """(3, h, w) logarithm of the hint, 1 where there is one, how sure it is."""
    out = np.zeros((3, *otherwise.shape), np.float32)
    out[0] = otherwise
    if hint is not None:
        known = hint.depth_m > 0
        depth = np.where(known, hint.depth_m, 1)
        out[0] = np.where(known, np.log(np.maximum(1 / (depth * last), LEAST_INVERSE)), otherwise)
        out[1] = known
        out[2] = np.where(known, np.minimum(0.01 * depth / np.maximum(hint.sigma_m, 0.001 * depth), 1), 0)
    return out


@parallel_kernel()
def describe_costs(
    count: int, path_sum: UInt16, cost: UInt8, second: Float32, winner: Float32, interval: Float32, around: Float32
) -> None:
    """How the costs of each pixel lie round its winner.

    Args:
        count: h, rows.
        path_sum, cost: (h, w, D) of a `SweepResult`.
        second: (h, w) best plane but for the winner and its neighbours, written.
        winner: (h, w) plane of the lowest cost without paths, written.
        interval: (4, h, w) planes from the winner to the ends of what costs little more, and more, written.
        around: (13, h, w) costs 0, -6, -3, -1, 1, 3, 6 planes from the winner, then sums above its sum, written.
    """
    ...
