"""How far rendered depth is off, in sums that add up over images and rooms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.types import Float32


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Sums over the pixels that were compared.

    Args:
        relative_sum: Of |rendered - true| / true.
        square_sum: Of (rendered - true)^2, square metres.
        count: Pixels.
    """

    relative_sum: float = 0.0
    square_sum: float = 0.0
    count: int = 0

    @property
    def abs_rel(self) -> float | None:
        """Mean of |rendered - true| / true; None where nothing was compared."""
        return self.relative_sum / self.count if self.count else None

    @property
    def rmse_m(self) -> float | None:
        """Root of the mean square error in metres; None where nothing was compared."""
        return float(np.sqrt(self.square_sum / self.count)) if self.count else None

    def __add__(self, other: DepthErrors) -> DepthErrors:
        return DepthErrors(
            self.relative_sum + other.relative_sum, self.square_sum + other.square_sum, self.count + other.count
        )


def depth_errors(truth_m: Float32, rendered_m: Float32, known: NDArray[np.bool_]) -> DepthErrors:
    """Compare two depth images where the truth has depth and the rendering knows something.

    Raises ShapeError: the shapes differ.

    Args:
        truth_m, rendered_m: (H, W) float32 z in metres; 0 of the truth = no surface.
        known: (H, W) bool, where ``rendered_m`` means something.
    """
    if not truth_m.shape == rendered_m.shape == known.shape:
        raise ShapeError(f"depth to compare: shapes {truth_m.shape}, {rendered_m.shape} and {known.shape} differ")
    compared = (truth_m > 0) & known
    truth = truth_m[compared].astype(np.float64)
    error = rendered_m[compared].astype(np.float64) - truth
    return DepthErrors(float((np.abs(error) / truth).sum()), float((error**2).sum()), int(compared.sum()))
