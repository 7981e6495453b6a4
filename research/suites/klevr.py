"""The suite KLEVR: arms that learn classes from the labelled views of training scenes, scored on novel scenes.

An arm is a function ``arm(config) -> ArmScores``, found in ``klevr_images`` and ``klevr_nesf``. Its records are kept by
scene, and ``klevr_claims`` are judged by them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import torch

from research.scenes.klevr import Variant, klevr_camera, klevr_views
from research.scenes.suite import KLEVR_SUITE
from research.suites.claims import Counts, CountTable, Training, Unit
from research.suites.plateau import PLATEAU
from research.suites.records import SceneRecord
from research.suites.scoring import as_rows
from research.suites.store import RecordStore
from semantic_mapper.config import AtLeastOne, AtLeastTwo, Config, NotNegative, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.training.views import frame_rays
from semantic_mapper.types import Float32, PosedFrame, UInt8

RECORD_VERSION = 4  # raised by a change of what a record means: older ones are made again
TRAIN_CAMERAS, TEST_CAMERAS, POINTS = "train cameras", "test cameras", "points"

VIEW_ARMS = {"nesf-5-views": 5, "nesf-25-views": 25}  # arms whose densities are fitted to fewer views
FEW_SCENES = (12, 6)  # of training and novel, for these

_MAPS_STREAM, _SCORED_STREAM = 11, 12


class KlevrConfig(Config, frozen=True):
    """A run of the suite."""

    train_scenes: AtLeastOne = 40
    novel_scenes: Annotated[int, msgspec.Meta(ge=2, le=20)] = 12
    width: Annotated[int, msgspec.Meta(ge=16)] = 72  # pixels; pictures are square
    views: AtLeastTwo = 100  # of a scene
    train_views: AtLeastOne = 70  # the first of them; the others are test cameras
    label_maps: AtLeastOne = 9  # of a training scene
    scored_views: AtLeastOne = 4  # of a novel scene, by train cameras, and as many by test cameras
    variant: Variant = "upright"
    unet_steps: AtLeastOne = 6000  # to begin with
    mlp_steps: AtLeastOne = 1500
    grid_steps: AtLeastOne = 600  # of the fit of a scene's density
    nesf_steps: AtLeastOne = 2400  # of one scene each, to begin with
    doublings: NotNegative = 2  # at most, of the steps of an arm until its plateau; without one it is not judged
    nesf_width: AtLeastOne = 8
    seed: NotNegative = 0


KLEVR_TIERS: dict[Literal["cpu", "record"], KlevrConfig] = {
    "cpu": KlevrConfig(),
    "record": KlevrConfig(train_scenes=100, novel_scenes=20, width=256, views=300, train_views=210),
}

KLEVR_SEEDS = {"cpu": 1, "record": 3}  # of a run

SceneScores = Mapping[int, Mapping[str, ConfusionMatrix]]  # by seed of the novel scene and by what is scored


class ArmScores(NamedTuple):
    """What an arm says of the novel scenes, what the last fifth of its steps brought in mIoU, and these steps; None =
    none that are doubled until a plateau."""

    scenes: SceneScores
    last_fifth: float | None = None
    steps: int | None = None


Arm = Callable[[KlevrConfig], ArmScores]


def check_klevr(config: KlevrConfig) -> None:
    """Refuse settings that no run can follow. Raises ConfigError: which, and what to do."""
    test_views = config.views - config.train_views
    if test_views < config.scored_views or config.train_views < max(config.scored_views, config.label_maps):
        raise ConfigError(
            f"{config.train_views} train and {test_views} test cameras do not hold {config.scored_views} scored views "
            f"each and {config.label_maps} label maps; raise views or train_views"
        )


def train_seeds(config: KlevrConfig) -> range:
    """Seeds of the training scenes."""
    return KLEVR_SUITE.seeds["train"][: config.train_scenes]


def novel_seeds(config: KlevrConfig) -> range:
    """Seeds of the novel scenes."""
    return KLEVR_SUITE.seeds["test"][: config.novel_scenes]


def scenes_of_arm(config: KlevrConfig, name: str) -> KlevrConfig:
    """The run as an arm sees it: ``VIEW_ARMS`` have fewer scenes."""
    if name not in VIEW_ARMS:
        return config
    few = [min(few, count) for few, count in zip(FEW_SCENES, (config.train_scenes, config.novel_scenes), strict=True)]
    return msgspec.structs.replace(config, train_scenes=few[0], novel_scenes=few[1])


def label_map_numbers(config: KlevrConfig, scene: int) -> list[int]:
    """Frames of a training scene that bring their label image: of its train cameras, drawn once a seed."""
    rng = np.random.default_rng((config.seed, scene, _MAPS_STREAM))
    return sorted(int(n) for n in rng.permutation(config.train_views)[: config.label_maps])


def scored_numbers(config: KlevrConfig, scene: int) -> dict[str, list[int]]:
    """Frames of a novel scene that are scored, by kind of camera, drawn once a seed."""
    rng = np.random.default_rng((config.seed, scene, _SCORED_STREAM))
    train = rng.permutation(config.train_views)[: config.scored_views]
    test = config.train_views + rng.permutation(config.views - config.train_views)[: config.scored_views]
    return {TRAIN_CAMERAS: sorted(map(int, train)), TEST_CAMERAS: sorted(map(int, test))}


def scene_frames(config: KlevrConfig, scene: int, numbers: Sequence[int]) -> list[PosedFrame]:
    """Frames of a scene with exact depth and labels."""
    views = klevr_views(scene, numbers, klevr_camera(config.width), variant=config.variant)
    return [view.frame for view in views]


def labelled_frames(config: KlevrConfig) -> list[PosedFrame]:
    """The label maps of all training scenes."""
    return [f for s in train_seeds(config) for f in scene_frames(config, s, label_map_numbers(config, s))]


def score_images(config: KlevrConfig, predict: Callable[[PosedFrame], UInt8]) -> dict[int, dict[str, ConfusionMatrix]]:
    """Scores of the images of novel scenes: ``predict`` gives ids (H, W)."""
    found: dict[int, dict[str, ConfusionMatrix]] = {}
    for scene in novel_seeds(config):
        numbers = scored_numbers(config, scene)
        found[scene] = {kind: confusion(scene_frames(config, scene, n), predict) for kind, n in numbers.items()}
    return found


def klevr_digest(config: KlevrConfig) -> str:
    """What tells records apart that were made in another way: 16 hex digits."""
    plain = to_plain(config) | {"suite_version": KLEVR_SUITE.version, "record_version": RECORD_VERSION}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def run_klevr(
    config: KlevrConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object] = bool
) -> Iterator[str]:
    """Make the records that are missing in ``store``, arm by arm; yields the name of each arm before it is run.

    Raises ConfigError: settings that no run can follow.

    Args:
        config: What to run.
        arms: By name.
        store: Records that are there are kept and not made again.
        stopped: Asked before each arm; once it says so (anything true), the run ends.
    """
    check_klevr(config)
    settings = klevr_digest(config)
    for name, arm in arms.items():
        own = scenes_of_arm(config, name)
        if all(store.find(SceneRecord, settings, name, scene) for scene in novel_seeds(own)):
            continue
        if stopped():
            return
        yield name
        scores = arm(own)
        for scene, confusions in scores.scenes.items():
            rows = {kind: as_rows(matrix) for kind, matrix in confusions.items()}
            store.add(SceneRecord(settings, name, scene, rows, scores.last_fifth, scores.steps))


def klevr_scores(
    configs: Sequence[KlevrConfig], names: Sequence[str], store: RecordStore
) -> tuple[CountTable, Training]:
    """Counts of the records that there are, and how their arms were trained.

    Args:
        configs: One a seed; what they say of a scene adds up.
        names: Of arms.
        store: Records.
    """
    table: dict[tuple[str, str], dict[Unit, Counts]] = {}
    unfinished: set[str] = set()
    steps: dict[str, set[int]] = {}
    for name, config in product(names, configs):
        for scene in novel_seeds(config):
            record = store.find(SceneRecord, klevr_digest(config), name, scene)
            if record is None:
                continue
            if record.last_fifth is not None and abs(record.last_fifth) >= PLATEAU:
                unfinished.add(name)
            if record.steps is not None:
                steps.setdefault(name, set()).add(record.steps)
            for kind, rows in record.confusions.items():
                units = table.setdefault((name, kind), {})
                units[0, scene] = units.get((0, scene), 0) + np.array(rows, np.int64)
    return table, Training(unfinished, steps)


def surface_points(config: KlevrConfig, scene: int, numbers: Sequence[int] | None = None) -> tuple[Float32, UInt8]:
    """Points (N, 3) of the surface with their true ids (N,): what frames show, without numbers what the scored train
    cameras of a novel scene do."""
    numbers = scored_numbers(config, scene)[TRAIN_CAMERAS] if numbers is None else numbers
    frames = scene_frames(config, scene, numbers)
    rays = frame_rays(frames, config.width)
    hit = np.flatnonzero(rays.depth_m > 0)
    batch = rays.rays(hit, 0.0)
    xyz = batch.origin + batch.direction * torch.from_numpy(rays.depth_m[hit])[:, None]
    return xyz.numpy(), np.concatenate([f.label.ravel() for f in frames if f.label is not None])[hit]


def confusion(frames: Sequence[PosedFrame], predict: Callable[[PosedFrame], UInt8]) -> ConfusionMatrix:
    """Of all pixels of the frames; ``predict`` gives ids (H, W)."""
    total = ConfusionMatrix(KLEVR_SUITE.label_set)
    for frame in frames:
        assert frame.label is not None
        total.update(frame.label, predict(frame), f"frame {frame.seq}")
    return total
