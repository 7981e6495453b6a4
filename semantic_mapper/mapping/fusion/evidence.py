"""How class evidence lies in memory, and how a vote is added to it; the C code of it is in ``evidence.h``.

``float32`` holds the sum over votes of ``w log p``. ``int16`` holds their *mean* in steps of 1/3500 nat: a floored log
probability is never below ln 1e-4 = -9.2, so a mean fits in 16 bits for good, where a sum would saturate after some
dozens of sure votes, and confidence with it. What readout does to a sum of n votes, ``n_eff / n`` of it with ``n_eff``
below 1 / rho, it does to ``n_eff`` of the mean: half a step is then less than 0.001 nat.

Late and small votes move a mean by less than a step. They are rounded up as often as their fraction says, by a table of
evenly spread numbers that a hash of block, voxel and frame reads from: that many small votes add up to what they say,
and the same frames give the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.types import Float32

EVIDENCE_DTYPES: dict[str, type[np.generic]] = {"float32": np.float32, "int16": np.int16}
PROBABILITY_FLOOR = 1e-4  # one confident mistake must not outweigh many modest looks: a vote moves at most ln 1e4
STEPS_PER_NAT = 3500.0  # 9.22 nat below 0 and, for probabilities that sum to a little more than 1, some above

_DITHERS = 4096
_MOST_CLASSES = 256
_order = np.random.default_rng(0).permutation(_DITHERS)
DITHER: Float32 = ((np.append(_order, _order[:_MOST_CLASSES]) + 0.5) / _DITHERS).astype(np.float32)  # in 0..1


@kernel
def add_votes_in_turn(
    evidence: NDArray[Any], votes: Float32, log_p: Float32, weights: Float32, cap: float, dither: Float32, seed: int
) -> None:
    """Add votes one after the other, in place, to one voxel: what fusion does to each.

    Args:
        evidence: (1, 1, L) float32 or int16.
        votes: (1, 1), sum of vote weights.
        log_p: (N, L) floored log probabilities.
        weights: (N,) of the votes, greater than 0.
        cap: Of ``votes``; beyond it old votes fade, so that the map stays able to change its mind.
        dither: ``DITHER``.
        seed: Where the numbers of the first vote are taken from; the others follow.
    """
    ...
