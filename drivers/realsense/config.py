"""Settings of a RealSense camera."""

from typing import Annotated, Literal

import msgspec

import semantic_mapper.config
from semantic_mapper.config import AtLeastOne

Preset = Literal["as-is", "default", "hand", "high_accuracy", "high_density", "medium_density"]


class Config(semantic_mapper.config.Config, frozen=True):
    """A RealSense: one colour camera, and depth aligned to it. It has no odometry: poses come from elsewhere."""

    # serial number, as `semantic-mapper doctor --cameras` shows it; empty = the only one that is connected
    device: str = ""
    width: AtLeastOne = 640  # of the colour images; sizes and rates are those that the device offers
    height: AtLeastOne = 480
    fps: Annotated[int, msgspec.Meta(ge=1, le=300)] = 30
    depth: bool = True
    depth_width: AtLeastOne = 848  # of the images that depth is computed from
    depth_height: AtLeastOne = 480
    # The stereo matcher's preset. This one would rather leave a pixel without depth than guess: a map has other views.
    preset: Preset = "high_accuracy"
    ir_dots: bool = True  # the dot projector: depth on bare walls
