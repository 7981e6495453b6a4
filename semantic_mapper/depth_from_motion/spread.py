"""How far a match may be off, in planes of the sweep: how firmly the membrane follows it.

The spread is the exponential of a sum of terms whose factors `benchmarks.depth_spread` fits, so that 68 % of the errors
are within it: rooms of training seeds, every second with poses that are off by 0.06 degrees and 1.5 mm.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.depth_from_motion.agreement import Agreement
from semantic_mapper.depth_from_motion.sweep import SweepResult
from semantic_mapper.types import Float32

MATCHED = (-0.19, -0.66, -0.47, 0.32, 0.09, -0.63)
FITTED_NEAR_M = 0.4  # nearest plane of the sweep that they were fitted with
LEAST, MOST = 0.1, 40.0  # planes


def spread_of_match(swept: SweepResult, agreement: Agreement, near_m: float) -> Float32:
    """Spread (h, w) in planes of what was matched.

    Args:
        near_m: Depth of the sweep's nearest plane.
    """
    terms = match_terms(swept, agreement, near_m)
    return np.clip(np.exp(terms @ np.array(MATCHED, np.float32)), LEAST, MOST).astype(np.float32)


def match_terms(swept: SweepResult, agreement: Agreement, near_m: float) -> Float32:
    """Terms (h, w, 6) that the logarithm of ``spread_of_match`` is a sum of."""
    agree, visible = agreement.agree.astype(np.float32), agreement.visible.astype(np.float32)
    terms = (
        np.ones_like(agree),
        np.log(swept.confidence + 0.02),
        np.log1p(agree),
        (visible - agree) / 6,
        (swept.seen < 2).astype(np.float32),
        np.log(agreement.mean_m * (FITTED_NEAR_M / near_m)),
    )
    return np.stack(terms, axis=-1).astype(np.float32, copy=False)
