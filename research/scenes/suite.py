"""The suites of generated scenes: which classes and seeds each has, and how its frames come about."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from research.scenes.aerial.town import AERIAL_VERSION, make_town
from research.scenes.aerial.views import aerial_views
from research.scenes.config import SUITE_VERSION, TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS
from research.scenes.klevr import KLEVR_VERSION, klevr_views, make_klevr
from research.scenes.room import make_room
from research.scenes.scene import Scene
from research.scenes.sequence import RoomView, room_views
from research.scenes.streets.layout import STREETS_VERSION, make_streets_street
from research.scenes.streets.views import street_views
from semantic_mapper.labels import CARLA, KITTI360, KLEVR, ROOMS, LabelSet
from semantic_mapper.types import CameraIntrinsics


@dataclass(frozen=True, slots=True)
class Suite:
    """Generated scenes of one kind. Everything is a pure function of (name, version, seed, frame).

    Args:
        name: Of the suite.
        version: Part of every seed; a change that alters a scene raises it.
        label_set: Of all label images.
        seeds: Of the scenes, by split.
        make_scene: The scene of a seed.
        views: The first ``count`` frames of the scene of a seed by a camera, with exact truth: ``views(seed, count,
            intrinsics)``.
    """

    name: str
    version: int
    label_set: LabelSet
    seeds: Mapping[str, range]
    make_scene: Callable[[int], Scene]
    views: Callable[[int, int, CameraIntrinsics], Iterator[RoomView]]


ROOMS_SUITE = Suite(
    "rooms",
    SUITE_VERSION,
    ROOMS,
    {"train": TRAIN_SEEDS, "val": VALIDATION_SEEDS, "test": TEST_SEEDS},
    make_room,
    room_views,
)
KLEVR_SUITE = Suite(
    "klevr",
    KLEVR_VERSION,
    KLEVR,
    {"train": range(1_000), "val": range(100_000, 100_020), "test": range(200_000, 200_020)},
    make_klevr,
    lambda seed, count, intrinsics: klevr_views(seed, range(count), intrinsics),
)
AERIAL_SUITE = Suite(
    "aerial",
    AERIAL_VERSION,
    CARLA,
    {"train": range(1_000), "val": range(100_000, 100_020), "test": range(200_000, 200_020)},
    lambda seed: make_town(seed).scene,
    lambda seed, count, intrinsics: aerial_views(seed, range(count), intrinsics),
)
STREETS_SUITE = Suite(
    "streets",
    STREETS_VERSION,
    KITTI360,
    {"train": range(1_000), "val": range(100_000, 100_020), "test": range(200_000, 200_020)},
    lambda seed: make_streets_street(seed).scene,
    lambda seed, count, intrinsics: street_views(seed, range(count), intrinsics),
)
SUITES = {suite.name: suite for suite in (ROOMS_SUITE, KLEVR_SUITE, AERIAL_SUITE, STREETS_SUITE)}
