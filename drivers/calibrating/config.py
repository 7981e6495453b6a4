"""Settings of calibration. Every default is documented where it is declared."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from semantic_mapper.config import Config, Positive


class CalibrationConfig(Config, frozen=True):
    """The lens model, and what a result has to be like to be written."""

    coefficients: Literal[4, 5, 8] = 5  # of lens distortion; 8 for wide angles, 4 where few images are to be had
    min_views: Annotated[int, msgspec.Meta(ge=4)] = 10
    max_error_px: Positive = 1.0  # RMS reprojection error of the whole
