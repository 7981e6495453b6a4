"""How class evidence lies in memory, and how a vote is added to it.

``float32`` holds the sum over votes of ``w log p``. ``int16`` holds their *mean* in steps of 1/3500 nat: a floored log
probability is never below ln 1e-4 = -9.2, so a mean fits in 16 bits for good, where a sum would saturate after some
dozens of sure votes, and confidence with it. What readout does to a sum of n votes, ``n_eff / n`` of it with ``n_eff``
below 1 / rho, it does to ``n_eff`` of the mean: half a step is then less than 0.001 nat.

Late and small votes move a mean by less than a step. They are rounded up as often as their fraction says, by a table of
evenly spread numbers that a hash of block, voxel and frame reads from: so many small votes add up to what they say, and
the same frames give the same bits.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel

EVIDENCE_DTYPES: dict[str, type[np.generic]] = {"float32": np.float32, "int16": np.int16}
PROBABILITY_FLOOR = 1e-4  # one confident mistake must not outweigh many modest looks: a vote moves at most ln 1e4
STEPS_PER_NAT = 3500.0  # 9.22 nat below 0 and, for probabilities that sum to a little more than 1, some above

_DITHERS = 4096
_MOST_CLASSES = 256
_order = np.random.default_rng(0).permutation(_DITHERS)
_DITHER = ((np.append(_order, _order[:_MOST_CLASSES]) + 0.5) / _DITHERS).astype(np.float32)  # in 0..1


@kernel(inline=True)
def evidence_scale(evidence, votes):
    """What stored evidence of a voxel with so many votes is multiplied with to be the sum of log probabilities."""
    return np.float64(votes) / STEPS_PER_NAT if evidence.itemsize == 2 else 1.0


@kernel(inline=True)
def stored_evidence(evidence, said, votes, keep):
    """What to store for a sum of log probabilities of so many votes that are about to fade to ``keep`` of them."""
    return np.rint(said / votes * STEPS_PER_NAT) if evidence.itemsize == 2 else said * keep


@kernel(inline=True)
def dither_seed(key, moment):
    """For the votes of one block (3,) at one moment, which is any number that changes from frame to frame."""
    seed = np.int64(key[0]) * np.int64(73856093) + np.int64(key[1]) * np.int64(19349663)
    return seed + np.int64(key[2]) * np.int64(83492791) + np.int64(moment) * np.int64(2654435761)


@kernel(inline=True)
def _dither_at(seed, voxel):
    """Where in the table the numbers of a voxel begin."""
    mixed = (seed + np.int64(voxel) * np.int64(668265263)) * np.int64(-7046029254386353131)
    mixed = (mixed ^ (mixed >> np.int64(29))) * np.int64(-4658895280553007687)
    return (mixed >> np.int64(32)) & np.int64(_DITHERS - 1)


@kernel(inline=True)
def add_vote(evidence, votes, voxel, log_p, row, weight, cap, seed):
    """``e += w log p``; past the cap the old sum shrinks so that the map stays able to change its mind."""
    total = votes[voxel] + weight
    keep = np.float32(1.0)
    if total > cap:
        keep = (cap - weight) / votes[voxel]
        total = cap
    votes[voxel] = total
    if evidence.itemsize == 2:
        share, steps, first = weight / total, np.float32(STEPS_PER_NAT), _dither_at(seed, voxel)
        for c in range(log_p.shape[1]):
            old = np.float32(evidence[voxel, c])
            evidence[voxel, c] = old + np.floor(share * (log_p[row, c] * steps - old) + _DITHER[first + c])
    else:
        for c in range(log_p.shape[1]):
            evidence[voxel, c] = evidence[voxel, c] * keep + weight * log_p[row, c]
