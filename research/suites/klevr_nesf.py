"""NeSF's arms of the suite KLEVR: one network on fitted densities, and what is left of it without one of its parts."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from safetensors.torch import save
from torch.nn import functional

from research.peers.grid_nesf import GridNesf, GridNesfConfig
from research.scenes.klevr import BOX_HIGH_M, BOX_LOW_M
from research.scenes.suite import KLEVR_SUITE
from research.suites.kept import read_json, read_network
from research.suites.klevr import (
    POINTS,
    TRAIN_CAMERAS,
    VIEW_ARMS,
    Arm,
    ArmScores,
    KlevrConfig,
    SceneScores,
    confusion,
    label_map_numbers,
    novel_seeds,
    scene_frames,
    scenes_of_arm,
    scored_numbers,
    surface_points,
    train_seeds,
)
from research.suites.klevr_grids import NEAR_M, KlevrGridConfig, SceneDensity, grid_digest, scene_densities
from research.suites.plateau import fit_to_plateau
from research.train.grid_nesf import (
    GridNesfTraining,
    LabelledScene,
    SceneLabels,
    labelled_points,
    labelled_scene,
    train_grid_nesf,
)
from semantic_mapper.config import to_plain
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.scene.grid import SceneGrid, grid_box
from semantic_mapper.files import write_bytes
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float32, UInt8

_log = get_logger(__name__)

VERSION = 2  # raised by a change of the training: older networks are left alone
_OPAQUE = 40.0  # raw density at which nothing passes a voxel; its negative lets all pass
LOOKS = 10  # at the points of novel scenes, spread evenly over the steps


class NesfArm(NamedTuple):
    """What an arm changes.

    Args:
        rotate: Turn training scenes about z.
        size: Vertices along x and y.
        maps: Label maps a training scene; None = those of the run.
        views: That densities are fitted to; None = all train cameras.
        exact: The surface itself instead of densities, and classes of its points instead of label maps: an upper bound.
    """

    rotate: bool = True
    size: int = 48
    maps: int | None = None
    views: int | None = None
    exact: bool = False


NESF_ARMS = {
    "nesf": NesfArm(),
    "nesf-no-rotation": NesfArm(rotate=False),
    "nesf-grid-32": NesfArm(size=32),
    "nesf-grid-64": NesfArm(size=64),
    "nesf-1-map": NesfArm(maps=1),
    "exact-points": NesfArm(exact=True),
} | {name: NesfArm(views=views) for name, views in VIEW_ARMS.items()}


class TrainingPoint(msgspec.Struct, frozen=True):
    """The state of a training: mIoU at points of novel scenes, and mean cross-entropy of the last 200 steps."""

    step: int
    miou_points: float
    cross_entropy: float


def nesf_arms(folder: Path) -> dict[str, Arm]:
    """Arms by name; densities and networks are kept in ``folder``."""

    def run(name: str, config: KlevrConfig) -> ArmScores:
        model, curve = arm_network(config, name, folder)
        own, _ = arm_settings(config, name)
        return ArmScores(nesf_scores(own, model, folder, NESF_ARMS[name]), last_fifth(curve), curve[-1].step)

    return {name: partial(run, name) for name in NESF_ARMS}


def arm_network(config: KlevrConfig, name: str, folder: Path) -> tuple[GridNesf, list[TrainingPoint]]:
    """The network of an arm, its steps doubled until its plateau, and how it was trained."""
    (own, training), arm = arm_settings(config, name), NESF_ARMS[name]

    def fit(steps: int) -> tuple[tuple[GridNesf, list[TrainingPoint]], float]:
        settings = msgspec.structs.replace(training, steps=steps)
        model = nesf_network(own, settings, folder, arm)
        curve = read_curve(own, settings, folder, arm)
        return (model, curve), last_fifth(curve)

    return fit_to_plateau(fit, training.steps, config.doublings)[0]


def last_fifth(curve: Sequence[TrainingPoint]) -> float:
    """mIoU that the last fifth of the steps brought; all of it where there are too few steps to tell."""
    before = [p.miou_points for p in curve if p.step <= 0.8 * curve[-1].step]
    return curve[-1].miou_points - (before[-1] if before else 0.0)


def arm_settings(config: KlevrConfig, name: str) -> tuple[KlevrConfig, GridNesfTraining]:
    """The run of an arm, and how its network is trained."""
    arm, own = NESF_ARMS[name], scenes_of_arm(config, name)
    own = own if arm.maps is None else msgspec.structs.replace(own, label_maps=arm.maps)
    return own, training_of(own, size=arm.size, rotate=arm.rotate)


def training_of(config: KlevrConfig, *, size: int = 48, rotate: bool = True) -> GridNesfTraining:
    """How an arm's network is trained."""
    network = GridNesfConfig(size=size, width=config.nesf_width)
    return GridNesfTraining(network=network, steps=config.nesf_steps, rotate=rotate, near_m=NEAR_M, seed=config.seed)


def grid_config(config: KlevrConfig, views: int | None = None) -> KlevrGridConfig:
    """How densities are fitted; ``views``: by fewer than all train cameras."""
    return KlevrGridConfig(
        views=min(views or config.train_views, config.train_views),
        checked_views=config.scored_views,
        checked_from=config.train_views,
        width=config.width,
        variant=config.variant,
        steps=config.grid_steps,
    )


def nesf_scores(config: KlevrConfig, model: GridNesf, folder: Path, arm: NesfArm) -> SceneScores:
    """What a network says of images and points of the novel scenes; of points alone where it was given the surface."""
    found: dict[int, dict[str, ConfusionMatrix]] = {}
    for scene, grid in _grids(config, novel_seeds(config), folder, arm).items():
        labels = SceneLabels(model, grid, NEAR_M)
        kinds = {} if arm.exact else scored_numbers(config, scene)
        found[scene] = {
            kind: confusion(scene_frames(config, scene, numbers), labels.frame) for kind, numbers in kinds.items()
        }
        xyz, truth = surface_points(config, scene)
        matrix = found[scene][POINTS] = ConfusionMatrix(KLEVR_SUITE.label_set)
        matrix.update(truth, labels.points(xyz), f"points of scene {scene}")
    return found


def nesf_network(config: KlevrConfig, training: GridNesfTraining, folder: Path, arm: NesfArm) -> GridNesf:
    """The network of an arm: read from ``folder``, or trained and kept there, its curve beside it."""
    label_set = KLEVR_SUITE.label_set
    path = network_path(config, training, folder, arm)
    kept = GridNesf(label_set, training.network)
    if read_curve(config, training, folder, arm) and read_network(path, kept):
        return kept
    grids = _grids(config, train_seeds(config), folder, arm)
    scenes = [_training_scene(config, training, scene, grid, arm) for scene, grid in grids.items()]
    novel = {s: (g, *surface_points(config, s)) for s, g in _grids(config, novel_seeds(config), folder, arm).items()}
    looks = {round(k * training.steps / LOOKS) for k in range(1, LOOKS + 1)}
    entropies: list[float] = []
    curve: list[TrainingPoint] = []

    def look(step: int, entropy: float, model: GridNesf) -> None:
        entropies.append(entropy)
        if step in looks:
            curve.append(TrainingPoint(step, _points_miou(model, novel), float(np.mean(entropies[-200:]))))
            _log.info("nesf_trained", **{k: round(v, 4) for k, v in msgspec.structs.asdict(curve[-1]).items()})

    model = train_grid_nesf(scenes, label_set, training, look)
    write_bytes(path.with_suffix(".json"), msgspec.json.encode(curve))
    write_bytes(path, save(model.state_dict()))
    return model


def read_curve(config: KlevrConfig, training: GridNesfTraining, folder: Path, arm: NesfArm) -> list[TrainingPoint]:
    """How a kept network was trained; empty where there is none."""
    return read_json(network_path(config, training, folder, arm).with_suffix(".json"), list[TrainingPoint]) or []


def _training_scene(
    config: KlevrConfig, training: GridNesfTraining, scene: int, grid: SceneGrid, arm: NesfArm
) -> LabelledScene:
    numbers, label_set = label_map_numbers(config, scene), KLEVR_SUITE.label_set
    if not arm.exact:
        return labelled_scene(grid, scene_frames(config, scene, numbers), label_set, training)
    xyz, ids = surface_points(config, scene, numbers)
    return labelled_points(grid, xyz, label_set.to_channels(ids).astype(np.int64), training)


def network_path(config: KlevrConfig, training: GridNesfTraining, folder: Path, arm: NesfArm) -> Path:
    """Where the network of an arm is kept."""
    return folder / f"nesf-{_network_digest(config, training, arm)}.safetensors"


def _network_digest(config: KlevrConfig, training: GridNesfTraining, arm: NesfArm) -> str:
    """Of all that a network and its curve follow from: novel scenes, too, as the curve is looked at there."""
    train, novel = train_seeds(config), novel_seeds(config)
    scenes = [grid_digest(grid_config(config, arm.views), scene) for scene in (*train, *novel)]
    maps = [label_map_numbers(config, scene) for scene in train]
    points = [scored_numbers(config, scene)[TRAIN_CAMERAS] for scene in novel]
    plain = [to_plain(training), arm.exact, scenes, maps, points, VERSION]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def scene_grid(density: SceneDensity) -> SceneGrid:
    """A grid of this density, grey everywhere."""
    grid = SceneGrid(density.grid)
    grid.values[..., 0] = torch.from_numpy(density.raw.astype(np.float32))
    grid.update_occupied()
    return grid


def exact_grid(config: KlevrConfig, scene: int) -> SceneGrid:
    """A grid that is opaque where the train cameras see the surface, and empty elsewhere.

    Its voxels are smaller than the network's, so neighbours in x and y are opaque, too: no vertex misses the surface.
    """
    grid = SceneGrid(grid_box(BOX_LOW_M, BOX_HIGH_M, grid_config(config).long_side))
    xyz, _ = surface_points(config, scene, range(config.train_views))
    place = ((xyz - np.array(grid.config.origin_m, np.float32)) / grid.config.voxel_m).round().astype(np.int64)
    place = place.clip(0, np.array(grid.config.shape) - 1)
    opaque = torch.zeros(grid.config.shape)
    opaque[tuple(torch.from_numpy(place).T)] = 1
    opaque = functional.max_pool3d(opaque[None, None], (3, 3, 1), 1, (1, 1, 0))[0, 0]
    grid.values[..., 0] = torch.where(opaque > 0, _OPAQUE, -_OPAQUE)
    return grid


def _grids(config: KlevrConfig, seeds: Sequence[int], folder: Path, arm: NesfArm) -> dict[int, SceneGrid]:
    if arm.exact:
        return {scene: exact_grid(config, scene) for scene in seeds}
    densities = list(scene_densities(grid_config(config, arm.views), seeds, folder))
    _log.info("densities", scenes=len(seeds), psnr=round(float(np.mean([d.psnr for d in densities])), 1))
    return {scene: scene_grid(density) for scene, density in zip(seeds, densities, strict=True)}


def _points_miou(model: GridNesf, novel: Mapping[int, tuple[SceneGrid, Float32, UInt8]]) -> float:
    total = ConfusionMatrix(KLEVR_SUITE.label_set)
    for scene, (grid, xyz, truth) in novel.items():
        total.update(truth, SceneLabels(model, grid, NEAR_M).points(xyz), f"points of scene {scene}")
    return total.metrics().miou or 0.0
