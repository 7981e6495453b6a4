"""The suite AERIAL: arms learn one town from its training views, four of which have labels, and are scored on others.

An *episode* is one town with one choice of labelled views. An arm is a function ``arm(config, episode) -> scores``;
most are a fit that gives a function ``predict(frame) -> ids``, scored by ``scored``. Records are kept by episode, and
``aerial_claims`` judges by them.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from research.evaluation.consistency import label_agreement, matching_pixels
from research.scenes.aerial.views import (
    LOW_RING,
    aerial_camera,
    aerial_views,
    held_out_numbers,
    labelled_numbers,
    low_numbers,
    training_numbers,
)
from research.scenes.sequence import RoomView
from research.scenes.suite import AERIAL_SUITE
from research.suites.claims import Counts, CountTable, Unit
from research.suites.records import SceneRecord
from research.suites.scene_runs import ViewScores, counts_of, run_missing
from research.suites.store import RecordStore
from semantic_mapper.config import AtLeastOne, AtLeastTwo, Config, NotNegative, Positive, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.types import CameraIntrinsics, PosedFrame, UInt8

_T = TypeVar("_T", bound=np.generic)

RECORD_VERSION = 2  # raised by a change of what a record means: older ones are made again
DAY, DARK, LOW, AGREEMENT = "day", "dark", "low", "agreement"  # what is scored
FIT = "fit"  # beside it: CPU time of the fit in milliseconds, and 1

_TEST_VIEWS = len(held_out_numbers())
_TRAIN_VIEWS = len(training_numbers())


class AerialConfig(Config, frozen=True):
    """A run of the suite."""

    towns: Annotated[int, msgspec.Meta(ge=1, le=20)] = 2
    choices: AtLeastOne = 2  # of labelled views in a town
    labelled: AtLeastOne = 4  # views with labels
    width: Annotated[int, msgspec.Meta(ge=16)] = 192  # pixels; pictures are square
    train_views: Annotated[int, msgspec.Meta(ge=2, le=_TRAIN_VIEWS)] = _TRAIN_VIEWS
    test_views: Annotated[int, msgspec.Meta(ge=2, le=_TEST_VIEWS)] = _TEST_VIEWS
    low_views: Annotated[int, msgspec.Meta(ge=2, le=LOW_RING)] = LOW_RING
    score_every: AtLeastOne = 3  # pixels along each side of which one is scored
    voxel_m: Positive = 0.75
    grid_steps: AtLeastOne = 600  # of the photometric fit of a town
    nerf_steps: AtLeastOne = 300  # of logits that are trained jointly with the grid
    unet_steps: AtLeastTwo = 400  # to begin with; doubled until a plateau is reached
    trunk_steps: AtLeastOne = 300  # of features on a town's grid
    irt_steps: AtLeastOne = 500
    mlp_steps: AtLeastOne = 600
    seed: NotNegative = 0  # of the first choice of labelled views, and of networks


AERIAL_TIERS: dict[Literal["cpu", "record"], AerialConfig] = {
    "cpu": AerialConfig(),
    "record": AerialConfig(towns=6, choices=3, width=512),
}


@dataclass(frozen=True, slots=True)
class Episode:
    """One town with one choice of labelled views.

    Args:
        town: Seed.
        choice: Number.
    """

    town: int
    choice: int

    @property
    def number(self) -> int:
        """By which its record is found."""
        return self.town * 1000 + self.choice


Predict = Callable[[PosedFrame, int], UInt8]  # ids of ``thinned`` frames, by image, camera and pose alone
Fit = Callable[[AerialConfig, Episode], Predict]
Arm = Callable[[AerialConfig, Episode], ViewScores]


def episodes(config: AerialConfig) -> list[Episode]:
    """All of a run."""
    towns = AERIAL_SUITE.seeds["test"][: config.towns]
    return [Episode(town, config.seed + choice) for town in towns for choice in range(config.choices)]


def training_frames(config: AerialConfig, episode: Episode) -> list[PosedFrame]:
    """The training views without depth; only the labelled ones have labels."""
    numbers = _spread(training_numbers(), config.train_views)
    labelled = set(labelled_numbers(episode.town, episode.choice, config.labelled, numbers))
    views = town_views(config.width, episode.town, tuple(numbers))
    return [v.frame if v.frame.seq in labelled else replace(v.frame, label=None) for v in views]


def labelled_frames(config: AerialConfig, episode: Episode) -> list[PosedFrame]:
    """The training views that have labels."""
    return [frame for frame in training_frames(config, episode) if frame.label is not None]


def scored_views(config: AerialConfig, episode: Episode, kind: str) -> list[RoomView]:
    """Held-out views of the flight by day or in the dark, or those of the low ring."""
    numbers = (
        _spread(low_numbers(), config.low_views) if kind == LOW else _spread(held_out_numbers(), config.test_views)
    )
    return town_views(config.width, episode.town, tuple(numbers), kind == DARK)


@lru_cache(maxsize=8)
def town_views(width: int, town: int, numbers: tuple[int, ...], dark: bool = False) -> list[RoomView]:
    """Views of a town, which arms ask for again and again."""
    return list(aerial_views(town, numbers, aerial_camera(width), dark=dark))


def thinned(frame: PosedFrame, every: int) -> PosedFrame:
    """A frame of one pixel in ``every`` along each side, with their camera."""
    i, first = frame.intrinsics, (every - 1) // 2
    width, height = (len(range(first, side, every)) for side in (i.width, i.height))
    camera = CameraIntrinsics(i.fx / every, i.fy / every, (i.cx - first) / every, (i.cy - first) / every, width, height)
    label = None if frame.label is None else thin(frame.label, every)
    return replace(frame, rgb=thin(frame.rgb, every), label=label, intrinsics=camera)


def thin(image: NDArray[_T], every: int) -> NDArray[_T]:
    """(H, W, ...) at the pixels of ``thinned``."""
    first = (every - 1) // 2
    return np.ascontiguousarray(image[first::every, first::every])


def scored(fit: Fit) -> Arm:
    """An arm that fits, then answers; its scores tell the CPU time of the fit."""

    def run(config: AerialConfig, episode: Episode) -> ViewScores:
        began = time.process_time()
        predict = fit(config, episode)
        milliseconds = round(1000 * (time.process_time() - began))
        scores = score_episode(config, episode, predict)
        return {**scores, FIT: {0: np.array([[milliseconds, 1]], np.int64)}}

    return run


def score_episode(config: AerialConfig, episode: Episode, predict: Predict) -> ViewScores:
    """Scores of an arm that says a class of every pixel: by day, in the dark, from low, and of views among each
    other."""
    found: dict[str, dict[int, Counts]] = {}
    for kind in (DAY, DARK, LOW):
        views = scored_views(config, episode, kind)
        said = [predict(replace(view.frame, label=None), config.score_every) for view in views]
        found[kind] = {}
        for view, ids in zip(views, said, strict=True):
            matrix = ConfusionMatrix(AERIAL_SUITE.label_set)
            matrix.update(
                thin(view.rendered.label, config.score_every), ids, f"town {episode.town}, view {view.frame.seq}"
            )
            found[kind][view.frame.seq] = matrix.counts
        if kind == DAY:
            found[AGREEMENT] = _agreements(views, said, config.score_every)
    return found


def aerial_digest(config: AerialConfig) -> str:
    """What tells records apart that were made in another way: 16 hex digits."""
    plain = to_plain(config) | {"suite_version": AERIAL_SUITE.version, "record_version": RECORD_VERSION}
    plain = {name: value for name, value in plain.items() if name not in ("towns", "choices")}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def check_aerial(config: AerialConfig) -> None:
    """Refuse settings that no run can follow. Raises ConfigError: which, and what to do."""
    if config.labelled >= config.train_views:
        raise ConfigError(
            f"{config.train_views} training views do not hold {config.labelled} labelled ones besides others; "
            "raise train_views or lower labelled"
        )


def run_aerial(
    config: AerialConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object] = bool
) -> Iterator[tuple[str, Episode]]:
    """Make the records that are missing in ``store``; yields arm and episode before each is run.

    Raises ConfigError: settings that no run can follow.

    Args:
        config: What to run.
        arms: By name.
        store: Records that are there are kept and not made again.
        stopped: Asked before each; once it says so (anything true), the run ends.
    """
    check_aerial(config)
    settings = aerial_digest(config)
    by_number = {episode.number: episode for episode in episodes(config)}
    jobs = ((name, number) for name in arms for number in by_number)

    def score(name: str, number: int) -> ViewScores:
        return arms[name](config, by_number[number])

    for name, number in run_missing(jobs, settings, score, store, stopped):
        yield name, by_number[number]


def aerial_table(config: AerialConfig, names: Sequence[str], store: RecordStore) -> CountTable:
    """Counts of all records that there are, by town and view; those of several choices of labels add up.

    Arms that lack an episode are left out: a part of the choices is no score.
    """
    found: dict[tuple[str, str], dict[Unit, Counts]] = {}
    settings = aerial_digest(config)
    for name in names:
        records = [(e, store.find(SceneRecord, settings, name, e.number)) for e in episodes(config)]
        have = {episode.town for episode, record in records if record is not None}
        lack = {episode.town for episode, record in records if record is None}
        for episode, record in records:
            if record is None or episode.town not in have - lack:
                continue
            for kind, view, counts in counts_of(record):
                table, unit = found.setdefault((name, kind), {}), (episode.town, view)
                table[unit] = table.get(unit, 0) + counts
    return found


def _agreements(views: Sequence[RoomView], said: Sequence[UInt8], every: int) -> dict[int, Counts]:
    """Of each view and the next one of the same flight: how many pixels show one surface, and have one class."""
    found: dict[int, Counts] = {}
    for k, (view, other) in enumerate(itertools.pairwise(views)):
        camera = thinned(view.frame, every).intrinsics
        depth, there = (thin(v.rendered.exact_depth_m, every) for v in (view, other))
        matches = matching_pixels(depth, view.T_world_camera, there, other.T_world_camera, camera)
        same = label_agreement(said[k], said[k + 1], matches, AERIAL_SUITE.label_set.ignore_id)
        found[view.frame.seq] = np.array([[same.agreeing, same.compared]], np.int64)
    return found


def _spread(numbers: Sequence[int], count: int) -> list[int]:
    return [numbers[int(k)] for k in np.linspace(0, len(numbers) - 1, count).round()]
