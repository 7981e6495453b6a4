"""Settings of a stereo pair."""

from typing import Any

import msgspec

from semantic_mapper import config
from semantic_mapper.config import AtLeastOne, Positive


class Config(config.Config, frozen=True):
    """One device that gives the images of two cameras side by side. Their size is that of the calibration."""

    device: str = ""  # /dev/v4l/by-id/..., a video file, or a URL; has to be given
    calibration: str = ""  # folder of `semantic-mapper calibrate --stereo`; has to be given
    # Of the images that come out; narrower ones are matched faster. Never wider than the camera gives them.
    width: AtLeastOne = 640
    min_depth_m: Positive = 0.4  # nearer surfaces are not matched; halving it doubles the work
    max_depth_m: Positive = 8.0  # beyond it a quarter of a pixel is too many centimetres
    # Further settings of the driver that reads the device (drivers/v4l2/config.py, drivers/opencv/config.py).
    source: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(f"min_depth_m = {self.min_depth_m:g} must be below max_depth_m = {self.max_depth_m:g}")
