"""The cameras that training rooms are seen with: other lenses, heights, tilts and sensors than the benchmark's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from research.scenes import CameraPathConfig, NoiseConfig, PoseNoiseConfig
from research.scenes.config import DepthSensorName
from semantic_mapper.config import Config, Fraction, Positive
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import CameraIntrinsics

ASPECT = 0.75
_CLOSE_POINTS = 0.7  # fraction of the way-points of a path of close-ups
_STREAM = 7  # number of the random stream; rooms, paths, shots and poses use others


class CameraDraw(Config, frozen=True):
    """What is drawn once a room.

    A share ``usual`` of the rooms is seen with the benchmark's camera: the lens of an OAK-D held in the hand.
    """

    usual: Fraction = 0.4
    focal: Positive = 0.69  # focal length over width of the usual camera: an OAK-D at 1280 pixels has 882.5
    focal_min: Positive = 0.45
    focal_max: Positive = 1.0
    height_min_m: Positive = 0.4  # of the lowest path: a small robot
    height_max_m: Positive = 1.8
    height_span_m: Positive = 0.3  # between the lowest and the highest point of one path
    roll_deg: Annotated[float, msgspec.Meta(ge=0, le=45)] = 12.0  # standard deviation of the mounting's
    sensors: tuple[DepthSensorName, ...] = ("oak_d", "oak_d", "oak_d", "d435", "d435", "exact")  # one of them
    odometry: Fraction = 0.5  # of the rooms in which poses drift
    close_up: Fraction = 0.4  # of the rooms in which most views look down at a table, counter or shelf from near by


@dataclass(frozen=True, slots=True)
class Camera:
    """One camera and how it is carried."""

    intrinsics: CameraIntrinsics
    path: CameraPathConfig
    noise: NoiseConfig
    pose_noise: PoseNoiseConfig | None


def draw_camera(seed: int, width: int, step_m: float, config: CameraDraw) -> Camera:
    """The camera of the room of ``seed``; everything follows from the arguments.

    Raises ConfigError: bounds that contradict each other, or no sensor.

    Args:
        width: Of the images, pixels.
        step_m: Way between two views.
    """
    if config.focal_min > config.focal_max or config.height_min_m + config.height_span_m > config.height_max_m:
        raise ConfigError("CameraDraw: need focal_min <= focal_max and height_min_m + height_span_m <= height_max_m")
    if not config.sensors:
        raise ConfigError('CameraDraw: sensors is empty; name at least one depth sensor, or "none"')
    rng = np.random.default_rng((_STREAM, seed))
    close_up = _CLOSE_POINTS if rng.uniform() < config.close_up else 0.0
    if rng.uniform() < config.usual:
        path = CameraPathConfig(step_m=step_m, close_up=close_up)
        return Camera(_pinhole(width, config.focal), path, NoiseConfig(), None)
    focal = float(np.exp(rng.uniform(np.log(config.focal_min), np.log(config.focal_max))))
    low = float(rng.uniform(config.height_min_m, config.height_max_m - config.height_span_m))
    roll = float(np.clip(rng.normal(0, config.roll_deg), -2 * config.roll_deg, 2 * config.roll_deg))
    sensor = config.sensors[int(rng.integers(len(config.sensors)))]
    return Camera(
        _pinhole(width, focal),
        CameraPathConfig(
            step_m=step_m, min_height_m=low, max_height_m=low + config.height_span_m, roll_deg=roll, close_up=close_up
        ),
        NoiseConfig(depth=sensor),
        PoseNoiseConfig() if rng.uniform() < config.odometry else None,
    )


def _pinhole(width: int, focal: float) -> CameraIntrinsics:
    height = round(width * ASPECT)
    return CameraIntrinsics(focal * width, focal * width, (width - 1) / 2, (height - 1) / 2, width, height)
