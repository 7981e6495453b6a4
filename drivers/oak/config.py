"""Settings of an OAK camera."""

from typing import Annotated, Literal

import msgspec

import semantic_mapper.config
from semantic_mapper.config import Fraction

Socket = Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D", "CAM_E", "CAM_F"]
Preset = Literal["default", "face", "high_detail", "robotics", "accuracy", "density", "fast_accuracy", "fast_density"]
Width = Annotated[int, msgspec.Meta(ge=64, multiple_of=16)]  # what the device's warp engine writes
Height = Annotated[int, msgspec.Meta(ge=48, multiple_of=2)]


class Config(semantic_mapper.config.Config, frozen=True):
    """An OAK: one colour camera, depth of a stereo pair aligned to it, odometry where it is requested."""

    # Its id (MXID), its IP address (PoE), or its USB path, as ``doctor --cameras`` shows. Empty = the only one.
    device: str = ""
    rgb: Socket = "CAM_A"  # the camera that gives the images; depth and intrinsics are its
    left: Socket = "CAM_B"  # of the stereo pair
    right: Socket = "CAM_C"
    width: Width = 640  # of the images, undistorted; another ratio than the sensor's crops
    height: Height = 480
    fps: Annotated[float, msgspec.Meta(ge=0.01, le=120)] = 20.0
    depth: bool = True  # False for boards without a stereo pair
    stereo_width: Width = 640  # of the images that depth and odometry are computed from
    stereo_height: Height = 400
    # DepthAI's preset of the stereo matcher. This one rather leaves a pixel without depth than guesses.
    stereo_preset: Preset = "fast_accuracy"
    ir_dots: Fraction = 0.0  # power of the dot projector ("Pro" boards): depth on bare walls; disturbs odometry
    # Visual-inertial odometry (DepthAI's Basalt, on this machine; needs stereo and an IMU) as the images' own pose.
    odometry: bool = False
    # JSON file (as DepthAI writes it) in place of the calibration that is stored on the device.
    calibration: str = ""

    def __post_init__(self) -> None:
        if self.odometry and not self.depth:
            raise ValueError("odometry needs the stereo pair: set depth = true, or odometry = false")
        if len({self.left, self.right}) < 2:
            raise ValueError(f"left and right are the same socket ({self.left})")
