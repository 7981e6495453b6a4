"""Settings of a video file or stream."""

from typing import Literal

from semantic_mapper import config
from semantic_mapper.config import AtLeastZero, Positive


class Config(config.Config, frozen=True):
    """One video. It has to be of the size of its calibration."""

    source: str = ""  # video file, or rtsp://..., http://...; has to be given
    calibration: str = ""  # file; see drivers/calibration.py
    uncalibrated: bool = False  # images as the lens gives them, for calibrating only
    # A file. Its images are stamped with the time within it; "recorded" gives them in that rhythm, "fast" at once.
    pace: Literal["recorded", "fast"] = "recorded"
    # A stream. "container": by the sender's clock, whose distance to ours the quickest images give; "arrival": as the
    # images come in. Neither knows how long the quickest one was on its way: that is `latency_s`.
    stamps: Literal["container", "arrival"] = "container"
    latency_s: AtLeastZero = 0.0
    open_timeout_s: Positive = 5.0
    stall_s: Positive = 3.0  # without an image for so long, the stream counts as stalled and is connected again
