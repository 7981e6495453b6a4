"""Settings and seed ranges of the procedural rooms."""

from __future__ import annotations

from typing import Literal

from semantic_mapper.config import Config

SUITE_VERSION = 1  # part of every seed: a change that alters a room raises it

TRAIN_SEEDS = range(0, 100_000)
VALIDATION_SEEDS = range(100_000, 100_020)
TEST_SEEDS = range(200_000, 200_020)

Programme = Literal["bedroom", "living", "office", "kitchen", "bathroom", "studio"]


class RoomConfig(Config, frozen=True):
    """What a room may look like; the seed decides within these bounds."""

    programme: Programme | None = None  # None: drawn from the seed
    min_side_m: float = 3.0
    max_side_m: float = 6.0
    min_height_m: float = 2.35
    max_height_m: float = 3.0
    clutter: float = 1.0  # scales the number of small objects, 0 = none
    shadow_resolution: int = 128  # pixels a side of each face of a light's shadow cube


class CameraPathConfig(Config, frozen=True):
    """How the hand that holds the camera moves."""

    step_m: float = 0.08  # mean way between two frames
    min_height_m: float = 1.2
    max_height_m: float = 1.65
    clearance_m: float = 0.3  # to walls and furniture
    tremor_m: float = 0.004
    tremor_deg: float = 0.6


class NoiseConfig(Config, frozen=True):
    """A simple depth and colour camera."""

    depth_sigma: float = 0.0015  # standard deviation of depth = depth_sigma * z^2
    edge_hole_rate: float = 0.6  # share of pixels at depth edges that have no depth
    edge_ratio: float = 0.06  # a step of depth larger than this share of z is an edge
    max_depth_m: float = 8.0
    gain_stops: float = 0.25  # standard deviation of the exposure in stops
    rgb_sigma: float = 2.0  # read noise in grey levels
