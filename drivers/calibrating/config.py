"""Settings of calibration. Every default is documented where it is declared."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from semantic_mapper.config import AtLeastOne, AtLeastZero, Config, Positive


class CalibrationConfig(Config, frozen=True):
    """What is used of the images, and what a result has to be like to be written."""

    coefficients: Literal[4, 5, 8] = 5  # of lens distortion; 8 for wide angles, 4 where few images are to be had
    min_corners: Annotated[int, msgspec.Meta(ge=6)] = 8  # seen, for an image to be used
    min_views: Annotated[int, msgspec.Meta(ge=4)] = 10
    max_views: AtLeastOne = 60  # those beyond say nothing new
    min_tilt_deg: Positive = 15.0  # the board leans so far at least once, both up or down and to a side
    steady_px: AtLeastZero = 1.5  # streams: further than this a corner moves only while the board is not held still
    max_error_px: Positive = 1.0  # RMS reprojection error of the whole
    max_focal_sigma: Positive = 0.005  # one sigma of the focal length, as a share of it
    max_apart_s: AtLeastZero = 0.02  # images of two cameras so far apart in time count as taken at once
    min_instants: Annotated[int, msgspec.Meta(ge=3)] = 8  # at which two cameras see the board at once
    max_position_sigma_m: Positive = 0.003  # one sigma of a camera's place on the rig
