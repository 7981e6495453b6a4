"""Settings of a V4L2 camera."""

from typing import Annotated

import msgspec

from semantic_mapper import config
from semantic_mapper.config import NotNegative, Positive
from semantic_mapper.drivers.v4l2.ioctls import HIGHEST, LOWEST

_MAX_EXPOSURE_MS = HIGHEST // 10  # the control counts tenths of a millisecond


class Config(config.Config, frozen=True):
    """One camera. The size of its images is that of its calibration."""

    device: str = ""  # /dev/v4l/by-id/..., as `semantic-mapper doctor --cameras` lists it; has to be given
    calibration: str = ""  # file; see drivers/calibration.py
    uncalibrated: bool = False  # images as the lens gives them, for calibrating only
    width: NotNegative = 0  # uncalibrated: of the requested images; 0 = as the device has it
    height: NotNegative = 0
    fps: Annotated[float, msgspec.Meta(ge=0.01, le=1000)] = 30.0  # requested; what the device gives instead is reported
    # Pixel requested format, four letters. MJPG passes USB at full rate; YUYV has no artefacts. Empty = as set.
    fourcc: Annotated[str, msgspec.Meta(pattern=r"^(.{4}|)\Z")] = "MJPG"
    # 0 = automatic; a short one blurs less while the robot moves
    exposure_ms: Annotated[float, msgspec.Meta(ge=0, le=_MAX_EXPOSURE_MS)] = 0.0
    white_balance_k: Annotated[int, msgspec.Meta(ge=0, le=HIGHEST)] = 0  # colour temperature in kelvin; 0 = automatic
    gain: Annotated[int, msgspec.Meta(ge=-1, le=HIGHEST)] = -1  # in the device's own units; -1 = as it is
    # Any other control by the name that the device gives it, in small letters with _ (focus_absolute); see
    # `v4l2-ctl --list-ctrls`. A lens that focuses by itself changes its focal length: fix it.
    controls: dict[str, Annotated[int, msgspec.Meta(ge=LOWEST, le=HIGHEST)]] = msgspec.field(default_factory=dict)
    stall_s: Positive = 2.0  # without an image for so long, the stream counts as stalled and is restarted

    def __post_init__(self) -> None:
        if bool(self.width) != bool(self.height):
            raise ValueError("give both width and height, or neither")
