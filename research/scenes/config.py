"""Settings and seed ranges of the procedural rooms."""

from __future__ import annotations

from typing import Literal

from semantic_mapper.config import Config, Fraction

SUITE_VERSION = 3  # part of every seed: a change that alters a room raises it

TRAIN_SEEDS = range(0, 100_000)
VALIDATION_SEEDS = range(100_000, 100_020)
TEST_SEEDS = range(200_000, 200_020)

Programme = Literal["bedroom", "living", "office", "kitchen", "bathroom", "studio"]
Style = Literal["rooms", "turned"]
DepthSensorName = Literal["oak_d", "d435", "kinect", "exact", "none"]


class RoomConfig(Config, frozen=True):
    """What a room may look like; the seed decides within these bounds."""

    style: Style = "rooms"  # "turned": rooms of ``scenes.turned``, which nothing is trained on
    template: Programme | None = None  # None: the seed decides
    min_side_m: float = 3.0
    max_side_m: float = 6.0
    min_height_m: float = 2.35
    max_height_m: float = 3.0
    clutter: float = 1.0  # scales the number of small objects, 0 = none
    camouflage: Fraction = (
        0.3  # of the rooms, for each pair of classes of ``materials.CAMOUFLAGE``: one material for both
    )
    people: Fraction = 0.0  # of the rooms with people or animals (the ignore id); half of them move
    # Of the rooms, that hold what benchmark rooms lack: pieces of other sizes, doors that stand open, counters round a
    # corner, tables of any height, refrigerators of any finish, arms before the camera. See ``furniture.varied``.
    variety: Fraction = 0.0
    shadow_resolution: int = 96  # pixels a side of each face of a light's shadow cube


class CameraPathConfig(Config, frozen=True):
    """How the hand that holds the camera moves."""

    step_m: float = 0.08  # mean way between two frames
    min_height_m: float = 1.2
    max_height_m: float = 1.65
    clearance_m: float = 0.3  # to walls and furniture
    tremor_m: float = 0.004
    tremor_deg: float = 0.6
    roll_deg: float = 0.0  # by which the camera is mounted askew
    close_up: Fraction = 0.0  # of the way-points: 0.4 to 1.1 m from a table, counter or shelf, looking at what is on it


class NoiseConfig(Config, frozen=True):
    """The camera: its depth sensor, and how far it departs from a perfect one in colour.

    Values that say "up to" or "standard deviation" are drawn once a sequence or once a frame, see ``shots``.
    """

    depth: DepthSensorName = "oak_d"  # "exact": no error; "none": no depth sensor, frames carry no depth
    exposure_stops: float = 0.4  # standard deviation of the exposure's drift, in stops
    white_balance: float = 0.12  # standard deviation of the red and blue gains' drift, natural logarithm
    auto_exposure: float = 0.6  # share of the way to an evenly exposed picture that the camera goes by itself
    look: float = 1.0  # strength of random contrast and saturation, 0 = neutral; a few sequences are nearly grey
    shot_noise: float = 0.0005  # variance of linear light per unit of it, at ISO factor 1
    read_noise: float = 0.003  # standard deviation in linear light, at ISO factor 1
    max_vignetting: float = 0.35  # loss of light in the corners, up to
    max_lens_blur_px: float = 0.7  # standard deviation of the lens's blur, up to; for a width of 320
    max_blur_way_m: float = 0.01  # way of the camera while the shutter is open, up to; one radian counts as 0.35 m
    rough: float = 0.2  # fraction of the sequences that have up to three times the blur and six times the noise


class PoseNoiseConfig(Config, frozen=True):
    """Odometry: a random walk, put right a little by each loop closure."""

    translation_share: float = 0.0075  # drift per metre of way
    rotation_deg_per_m: float = 0.15
    closure_frames: int = 60  # a loop closure jumps back towards the truth after this many frames; 0 = never
    closure_share: float = 0.7  # of the error that a loop closure takes away
