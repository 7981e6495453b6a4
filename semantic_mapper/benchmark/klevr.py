"""The suite KLEVR: arms that learn classes from the labelled views of training scenes, scored on novel scenes.

An arm is a function ``arm(config) -> {scene: {score: ConfusionMatrix}}``. ``ARMS`` names them; its records are kept by
scene, and the claims are judged by them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.benchmark.claims import Claim, Score, Scores
from semantic_mapper.benchmark.records import SceneRecord
from semantic_mapper.benchmark.scoring import as_rows, from_rows
from semantic_mapper.benchmark.store import RecordStore
from semantic_mapper.config import AtLeastOne, AtLeastTwo, Config, NotNegative, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.log_events import get_logger
from semantic_mapper.scenes.klevr import Variant, klevr_camera, klevr_views
from semantic_mapper.scenes.suite import KLEVR_SUITE
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig
from semantic_mapper.types import PosedFrame, UInt8

_log = get_logger(__name__)

RECORD_VERSION = 2  # raised by a change of what a record means: older ones are made again
TRAIN_CAMERAS, TEST_CAMERAS, POINTS = "train cameras", "test cameras", "points"

VIEW_ARMS = {"nesf-5-views": 5, "nesf-25-views": 25}  # arms whose densities are fitted to fewer views
FEW_SCENES = (12, 6)  # of training and novel, for these

_MAPS_STREAM, _SCORED_STREAM = 11, 12
_PLATEAU = 0.005  # of mIoU in the last fifth of the steps: with more, there are to be twice as many steps
_MOST_DOUBLINGS = 2
_CHECKED_SCENES = 8  # of training, at test cameras: where the plateau is looked for


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
    unet_steps: AtLeastOne = 3000  # to begin with; doubled until a plateau is reached
    mlp_steps: AtLeastOne = 1500
    grid_steps: AtLeastOne = 600  # of the fit of a scene's density
    nesf_steps: AtLeastOne = 2400  # of one scene each
    nesf_width: AtLeastOne = 8
    seed: NotNegative = 0


KLEVR_TIERS: dict[Literal["cpu", "record"], KlevrConfig] = {
    "cpu": KlevrConfig(),
    "record": KlevrConfig(train_scenes=100, novel_scenes=20, width=256, views=300, train_views=210),
}

KLEVR_SEEDS = {"cpu": 1, "record": 3}  # of a run

SceneScores = Mapping[int, Mapping[str, ConfusionMatrix]]  # by seed of the novel scene and by what is scored
Arm = Callable[[KlevrConfig], SceneScores]


def check_klevr(config: KlevrConfig) -> None:
    """Refuse settings that no run can follow.

    Raises:
        ConfigError: which, and what to do.
    """
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


def scene_frames(config: KlevrConfig, scene: int, numbers: list[int] | range) -> list[PosedFrame]:
    """Frames of a scene with exact depth and labels."""
    views = klevr_views(scene, numbers, klevr_camera(config.width), variant=config.variant)
    return [view.frame for view in views]


def labelled_frames(config: KlevrConfig) -> list[PosedFrame]:
    """The label maps of all training scenes."""
    return [f for s in train_seeds(config) for f in scene_frames(config, s, label_map_numbers(config, s))]


def score_images(config: KlevrConfig, predict: Callable[[PosedFrame], UInt8]) -> SceneScores:
    """Scores of an arm that classifies single images: ``predict`` gives ids (H, W)."""
    found: dict[int, dict[str, ConfusionMatrix]] = {}
    for scene in novel_seeds(config):
        numbers = scored_numbers(config, scene)
        found[scene] = {kind: _confusion(scene_frames(config, scene, n), predict) for kind, n in numbers.items()}
    return found


def color_arm(config: KlevrConfig) -> SceneScores:
    """What the colour of a pixel alone says of its class: a small network on RGB."""
    frames, label_set = labelled_frames(config), KLEVR_SUITE.label_set
    torch.manual_seed(config.seed)
    net = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, len(label_set)))
    rgb = np.concatenate([f.rgb.reshape(-1, 3) for f in frames])
    channel = np.concatenate([label_set.to_channels(f.label).ravel() for f in frames if f.label is not None])
    rng, optimiser = np.random.default_rng(config.seed), torch.optim.Adam(net.parameters(), 3e-3)
    for _ in range(config.mlp_steps):
        pick = rng.integers(len(rgb), size=8192)
        loss = functional.cross_entropy(net(_color_input(rgb[pick])), torch.from_numpy(channel[pick]))
        optimiser.zero_grad()
        loss.backward()  # pyright: ignore[reportUnknownMemberType]
        optimiser.step()

    def predict(frame: PosedFrame) -> UInt8:
        with torch.inference_mode():
            found = net(_color_input(frame.rgb.reshape(-1, 3))).argmax(1).numpy()
        return label_set.to_ids(found).reshape(frame.rgb.shape[:2])

    return score_images(config, predict)


def unet_arm(config: KlevrConfig) -> SceneScores:
    """The per-image U-Net on the same label maps, past its plateau.

    It is fitted anew with twice the steps until those after four fifths of them bring less than half a point of mIoU at
    test cameras of training scenes.
    """
    frames, steps = labelled_frames(config), config.unet_steps
    checked = [f for s in train_seeds(config)[:_CHECKED_SCENES] for f in _held_out(config, s)]
    unet, gain = _fit_unet(config, frames, checked, steps)
    for _ in range(_MOST_DOUBLINGS):
        if gain < _PLATEAU:
            break
        steps *= 2
        unet, gain = _fit_unet(config, frames, checked, steps)
    return score_images(config, unet.predict)


def _fit_unet(
    config: KlevrConfig, frames: list[PosedFrame], checked: list[PosedFrame], steps: int
) -> tuple[UNetBaseline, float]:
    """A U-Net fitted to ``frames``, and what the last fifth of the steps brought at ``checked``."""
    unet = UNetBaseline(KLEVR_SUITE.label_set, UNetConfig(steps=steps, width=config.width, seed=config.seed))
    before: list[float] = []

    def look(fraction: float) -> None:
        if fraction >= 0.8 and not before:
            unet.net.eval()
            before.append(_miou(checked, unet.predict))
            unet.net.train()

    unet.fit(frames, look)
    reached = _miou(checked, unet.predict)
    gain = reached - (before[0] if before else 0.0)  # a handful of steps has no last fifth
    _log.info("unet_fitted", steps=steps, last_fifth=round(gain, 4), miou=round(reached, 4))
    return unet, gain


ARMS: dict[str, Arm] = {"color": color_arm, "unet": unet_arm}  # those of NeSF: ``klevr_nesf``

_NESF: Score = ("nesf", POINTS)
CLAIMS = (
    Claim("gate: the colour of a pixel says little", "", ("color", TRAIN_CAMERAS), most=30.0),
    Claim("rotation augmentation", "3D 75.5 -> 97.1", _NESF, ("nesf-no-rotation", POINTS), least=5.0),
    Claim("3D above 2D", "97.8 / 92.7", _NESF, ("nesf", TRAIN_CAMERAS), least=2.0),
    Claim(
        "grid 32 -> 64", "2D 87.5 -> 91.7", ("nesf-grid-64", TRAIN_CAMERAS), ("nesf-grid-32", TRAIN_CAMERAS), least=2.0
    ),
    Claim("one label map a scene: 90 % of nine", "figure", ("nesf-1-map", POINTS), _NESF, least=0.0, factor=0.9),
    Claim(
        "views 5 -> 25",
        "5 -> 100: 52.2 -> 92.0",
        ("nesf-25-views", TRAIN_CAMERAS),
        ("nesf-5-views", TRAIN_CAMERAS),
        least=10.0,
    ),
    Claim(
        "not far below an image network", "97.1 / 92.7", ("nesf", TRAIN_CAMERAS), ("unet", TRAIN_CAMERAS), least=-8.0
    ),
    Claim("the same at test cameras", "", ("nesf", TEST_CAMERAS), ("nesf", TRAIN_CAMERAS), least=-1.0, most=1.0),
)


def klevr_digest(config: KlevrConfig) -> str:
    """What tells records apart that were made in another way: 16 hex digits."""
    plain = to_plain(config) | {"suite_version": KLEVR_SUITE.version, "record_version": RECORD_VERSION}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def run_klevr(
    config: KlevrConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object] = bool
) -> Iterator[str]:
    """Make the records that are missing in ``store``, arm by arm; yields the name of each arm before it is run.

    Args:
        config: What to run.
        arms: By name, from ``ARMS``.
        store: Records that are there are kept and not made again.
        stopped: Asked before each arm; once it says so (anything true), the run ends.

    Raises:
        ConfigError: settings that no run can follow.
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
        for scene, confusions in arm(own).items():
            rows = {kind: as_rows(matrix) for kind, matrix in confusions.items()}
            store.add(SceneRecord(settings=settings, weights=name, room=scene, confusions=rows))


def klevr_scores(configs: Sequence[KlevrConfig], store: RecordStore) -> Scores:
    """All scores of the records that there are, by arm and what of it is scored; those of several seeds add up."""
    found: dict[Score, dict[int, ConfusionMatrix]] = {}
    names = {arm for claim in CLAIMS for arm, _ in (claim.first, claim.second or claim.first)} | ARMS.keys()
    for name, config in product(sorted(names), configs):
        for scene in novel_seeds(config):
            record = store.find(SceneRecord, klevr_digest(config), name, scene)
            for kind, rows in ({} if record is None else record.confusions).items():
                total = found.setdefault((name, kind), {})
                matrix = from_rows(rows, KLEVR_SUITE.label_set)
                total[scene] = total[scene] + matrix if scene in total else matrix
    return found


def _confusion(frames: list[PosedFrame], predict: Callable[[PosedFrame], UInt8]) -> ConfusionMatrix:
    total = ConfusionMatrix(KLEVR_SUITE.label_set)
    for frame in frames:
        assert frame.label is not None
        total.update(frame.label, predict(frame), f"frame {frame.seq}")
    return total


def _miou(frames: list[PosedFrame], predict: Callable[[PosedFrame], UInt8]) -> float:
    return _confusion(frames, predict).metrics().miou or 0.0


def _held_out(config: KlevrConfig, scene: int) -> list[PosedFrame]:
    return scene_frames(config, scene, scored_numbers(config, scene)[TEST_CAMERAS])


def _color_input(rgb: UInt8) -> torch.Tensor:
    return torch.from_numpy(rgb.astype(np.float32) / 255)
