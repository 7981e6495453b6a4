"""Settings of a benchmark run. ``research/docs/benchmarks.md`` says what each protocol does."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal

import msgspec

from research.scenes import SUITE_VERSION, CameraPathConfig, RoomConfig
from research.scenes.config import DepthSensorName, Style
from research.scenes.suite import ROOMS_SUITE
from semantic_mapper.config import (
    AtLeastOne,
    AtLeastTwo,
    AtLeastZero,
    Config,
    Fraction,
    MapperConfig,
    NotNegative,
    Positive,
    SamplingConfig,
    VoxelMapConfig,
    to_plain,
)
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import MAX_SOURCE_VIEWS
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig, StepConfig
from semantic_mapper.types import CameraIntrinsics

RECORD_VERSION = 9  # raised by a change of what a record means or how views are rendered: older ones are made again

FOCAL_PER_WIDTH = 882.5 / 1280  # an OAK-D at 1280 pixels
MAP_WIDTH = 320

Split = Literal["test", "val"]
Protocol = Literal["generalize", "finetune", "scratch"]
SourceChoice = Literal["near", "wide", "cover"]
CurrentFrame = Literal["clean", "hard"]
GivenDepth = Literal["on", "computed", "off"]
Tier = Literal["cpu", "gpu"]


class TierConfig(Config, frozen=True):
    """Resolution and samples; ``cpu`` runs everywhere, ``gpu`` is the full size."""

    width: Annotated[int, msgspec.Meta(ge=16)] = 160  # pixels; height is three quarters of it
    rays_per_chunk: AtLeastOne = 2048
    guided: SamplingConfig = SamplingConfig()  # where depth is given
    blind: SamplingConfig = SamplingConfig(guided=32, free_space=0)  # without: uniform in inverse depth


TIERS: dict[Tier, TierConfig] = {
    "cpu": TierConfig(),
    "gpu": TierConfig(
        width=320,
        rays_per_chunk=8192,
        guided=SamplingConfig(guided=16, free_space=2),
        blind=SamplingConfig(mode="reference", coarse=64, fine=64, guided=64, free_space=0),  # 64 while fitting
    ),
}


class CameraConfig(Config, frozen=True):
    """The camera of the query and source views; by default an OAK-D in a hand. Maps are always made with that one."""

    focal_per_width: Positive = FOCAL_PER_WIDTH
    min_height_m: Positive = CameraPathConfig().min_height_m
    max_height_m: Positive = CameraPathConfig().max_height_m
    roll_deg: float = 0.0
    sensor: DepthSensorName = "oak_d"


class SequenceConfig(Config, frozen=True):
    """The walk through each room, and which of its frames are queries."""

    frames: AtLeastTwo = 80
    step_m: Positive = 0.08  # way (a turn of 1 rad counts as 0.35 m) between frames
    query_pairs: AtLeastOne = 2  # spread evenly over the sequence
    pair_gap: AtLeastOne = 4  # the second view of a pair is this many frames on
    style: Style = "rooms"  # "turned": of a generator that nothing is trained on
    camouflage: Fraction = RoomConfig().camouflage  # chance that a pair of classes shares one material
    camera: CameraConfig = CameraConfig()


class SpacingConfig(Config, frozen=True):
    """How far source views are from the query and from each other, in metres between camera centres."""

    from_query_m: float = 0.0
    to_query_m: float = float("inf")
    apart_m: float = 0.0


SPACINGS: dict[SourceChoice, SpacingConfig] = {  # "cover": the mapper's own choice of keyframes
    "near": SpacingConfig(from_query_m=0.05, to_query_m=0.5, apart_m=0.05),
    "wide": SpacingConfig(from_query_m=0.5, apart_m=0.2),
}


class SceneBudget(Config, frozen=True):
    """How a field is fitted to one room, for ``finetune`` and ``scratch``."""

    keyframes: AtLeastTwo = 12  # labelled
    unlabelled: NotNegative = 0  # further frames of the room, which bring their images (and depth) as source views
    guard: NotNegative = 3  # frames on either side of a query that are no keyframes
    labelled_sources: bool = True  # fitting and queries: the keyframes bring their labels to fields that take some
    seconds: AtLeastZero = 120.0  # wall clock; 0 = only steps count
    steps: NotNegative = 0  # 0 = only seconds count
    learning_rate: Positive = FinetuneConfig().learning_rate
    encoder_rate: Fraction = FinetuneConfig().encoder_rate  # see ``FinetuneConfig``
    frozen_encoder_fraction: Fraction = FinetuneConfig().frozen_encoder_fraction  # see ``FinetuneConfig``
    patience: NotNegative = 0  # see ``FinetuneConfig``; by default a budget is spent to its end
    shares: tuple[float, ...] = (0.0625, 0.125, 0.25, 0.5, 1.0)  # of the budget; a run, and a point of the curve, each


class SuiteConfig(Config, frozen=True):
    """A run of the benchmark."""

    split: Split = "test"
    rooms: NotNegative = 0  # the first this many of the split; 0 = all
    protocol: Protocol = "generalize"
    views: Annotated[int, msgspec.Meta(ge=1, le=MAX_SOURCE_VIEWS)] = 8  # source views of a query
    sources: SourceChoice = "near"
    own_image: bool = True  # generalize: the query's own image is the last of the source views, as in the mapper
    current: CurrentFrame = (
        "clean"  # "hard": query images with blur, noise, 2 stops too dark, a narrow lens, or too close
    )
    # What fields are given: the sensor's; computed from the pictures of the walk, at twice the size; or none.
    depth: GivenDepth = "on"
    tier: TierConfig = TierConfig()
    sequence: SequenceConfig = SequenceConfig()
    scene: SceneBudget = SceneBudget()
    map_frames: AtLeastOne = 40  # of a room that are mapped for the map-level figures
    # That they are mapped with: every point has its class, so that figures compare
    mapper: MapperConfig = MapperConfig(voxel_map=VoxelMapConfig(unknown_below=0.0))
    seed: NotNegative = 0


def own_image_suite(suite: SuiteConfig) -> SuiteConfig:
    """The same run with maps of each frame's own image alone: votes of voxels are all that joins views."""
    keyframes = msgspec.structs.replace(suite.mapper.keyframes, source_views=1)
    return msgspec.structs.replace(suite, mapper=msgspec.structs.replace(suite.mapper, keyframes=keyframes))


def check_suite(suite: SuiteConfig) -> None:
    """Refuse settings that no run can follow. Raises ConfigError: which, and what to do."""
    seeds = ROOMS_SUITE.seeds[suite.split]
    if not 0 <= suite.rooms <= len(seeds):
        raise ConfigError(f"rooms: split '{suite.split}' has {len(seeds)} rooms, {suite.rooms} are requested; 0 = all")
    if suite.depth == "on" and suite.sequence.camera.sensor == "none":
        raise ConfigError("sequence.camera: a camera without a depth sensor gives no depth; --depth off or computed")
    if suite.depth == "computed" and suite.current == "hard":
        raise ConfigError("--depth computed needs a walk; --current hard has single images: ask for one of them")
    if suite.protocol == "generalize":
        return
    scene = suite.scene
    if scene.seconds <= 0 and scene.steps <= 0:
        raise ConfigError(f"protocol {suite.protocol} needs a budget: set seconds, steps, or both")
    if not scene.shares or min(scene.shares) <= 0 or max(scene.shares) != 1:
        raise ConfigError(f"scene.shares must lie in (0, 1] and end at 1.0, the whole budget; got {list(scene.shares)}")


def suite_seeds(suite: SuiteConfig) -> list[int]:
    """Seeds of the rooms, in order."""
    seeds = ROOMS_SUITE.seeds[suite.split]
    return list(seeds[: suite.rooms] if suite.rooms else seeds)


def camera_of_width(width: int, focal_per_width: float = FOCAL_PER_WIDTH) -> CameraIntrinsics:
    """The benchmark's camera: an OAK-D's field of view, 4:3."""
    height = width * 3 // 4
    focal = focal_per_width * width
    return CameraIntrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def fit_config(suite: SuiteConfig, share: float) -> FinetuneConfig:
    """How a field is fitted to one room with a share of the budget."""
    scene = suite.scene
    sampling = suite.tier.blind if suite.depth == "off" else suite.tier.guided
    return FinetuneConfig(
        seconds=scene.seconds * share,
        steps=max(1, round(scene.steps * share)) if scene.steps else 0,
        width=suite.tier.width,
        learning_rate=scene.learning_rate,
        encoder_rate=scene.encoder_rate,
        patience=scene.patience,
        frozen_encoder_fraction=scene.frozen_encoder_fraction,
        step=StepConfig(
            sampling=sampling,
            samples_without_depth=suite.tier.blind.guided,
            known_labels=scene.labelled_sources,
        ),
        seed=suite.seed,
        grid=GridFitConfig(held_out=0),  # all keyframes count; query views are others
    )


def settings_digest(suite: SuiteConfig, part: Literal["views", "map"]) -> str:
    """What tells records apart that were made in another way: 16 hex digits.

    Which rooms are requested plays no part, nor do settings that this part of the run does not look at.
    """
    plain = to_plain(suite)
    for key in ("split", "rooms"):
        del plain[key]
    if part == "map":
        plain = {key: plain[key] for key in ("depth", "map_frames", "mapper")} | {"step_m": suite.sequence.step_m}
        if suite.sequence.camouflage != RoomConfig().camouflage:  # left out otherwise: older records stay valid
            plain["camouflage"] = suite.sequence.camouflage
        if suite.sequence.style != RoomConfig().style:
            plain["style"] = suite.sequence.style
        plain["instances"] = "ranked by confidence and size"
    else:
        del plain["map_frames"], plain["mapper"]
        if suite.sequence.style == RoomConfig().style:
            del plain["sequence"]["style"]
        if suite.protocol == "generalize":
            del plain["scene"]
            plain["spacing"] = repr(SPACINGS.get(suite.sources))
        else:
            del plain["sources"], plain["own_image"]
            plain["fit"] = to_plain(fit_config(suite, 1.0))  # with its defaults, which may change
    plain |= {"part": part, "suite_version": SUITE_VERSION, "record_version": RECORD_VERSION}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
