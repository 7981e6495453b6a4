"""How far a matched depth may be off."""

from __future__ import annotations

import numpy as np

from semantic_mapper.depth_from_motion.agreement import Agreement
from semantic_mapper.depth_from_motion.sweep import SweepResult
from semantic_mapper.types import Float32


def estimate_spread(swept: SweepResult, agreement: Agreement, step: float, sources: int) -> Float32:
    """One-sigma spread (h, w) in metres of the depth that was matched.

    Args:
        step: Between two planes, 1 / metres.
    """
    planes = 0.5 + 2.0 * np.exp(-8 * swept.confidence) / (1 + agreement.agree)
    return (agreement.mean_m**2 * step * planes).astype(np.float32)
