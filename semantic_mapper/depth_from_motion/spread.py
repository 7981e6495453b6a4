"""How far a depth may be off: spreads in planes of the sweep, fitted to procedural rooms.

Both are the exponential of a sum of terms whose factors `research.experiments.depth_spread` fits, so that 68 % of the
errors are within one spread: rooms of training seeds, every second with poses that are off by 0.06 degrees and 1.5 mm.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.depth_from_motion.agreement import Agreement
from semantic_mapper.depth_from_motion.sweep import SweepResult
from semantic_mapper.types import Float32

MATCHED = (-0.19, -0.66, -0.47, 0.32, 0.09, -0.63)
SMOOTHED = (0.02, 0.04, 0.94, 0.33, 0.19, 0.24)
LEAST, MOST = 0.1, 40.0  # planes
AROUND = 9  # pixels a side in which other pixels support one


def spread_of_match(swept: SweepResult, agreement: Agreement) -> Float32:
    """Spread (h, w) in planes of what was matched."""
    return _spread(match_terms(swept, agreement), MATCHED)


def spread_of_surface(
    plane: Float32, smooth: Float32, sigma: Float32, agreement: Agreement, depth_m: Float32
) -> Float32:
    """Spread (h, w) in planes of the surface ``smooth`` that was laid through ``plane``.

    Args:
        plane, smooth: (h, w) planes as matched, and of the surface.
        sigma: (h, w) of `spread_of_match`.
        depth_m: (h, w) of the surface.
    """
    return _spread(surface_terms(plane, smooth, sigma, agreement, depth_m), SMOOTHED)


def match_terms(swept: SweepResult, agreement: Agreement) -> Float32:
    """Terms (h, w, 6) that the logarithm of ``spread_of_match`` is a sum of."""
    agree, visible = agreement.agree.astype(np.float32), agreement.visible.astype(np.float32)
    return _stack(
        np.ones_like(agree),
        np.log(swept.confidence + 0.02),
        np.log1p(agree),
        (visible - agree) / 6,
        (swept.seen < 2).astype(np.float32),
        np.log(agreement.mean_m),
    )


def surface_terms(plane: Float32, smooth: Float32, sigma: Float32, agreement: Agreement, depth_m: Float32) -> Float32:
    """Terms (h, w, 6) that the logarithm of ``spread_of_surface`` is a sum of."""
    around = cv2.blur(1 / sigma**2, (AROUND, AROUND)) ** -0.5
    return _stack(
        np.ones_like(sigma),
        np.log(sigma),
        np.log(around),
        np.log(np.abs(plane - smooth) + 0.1),
        np.log1p(agreement.agree.astype(np.float32)),
        np.log(depth_m),
    )


def _stack(*terms: NDArray[np.floating]) -> Float32:
    return np.stack(terms, axis=-1).astype(np.float32, copy=False)


def _spread(terms: Float32, factors: tuple[float, ...]) -> Float32:
    return np.clip(np.exp(terms @ np.array(factors, np.float32)), LEAST, MOST).astype(np.float32)
