"""Train the network that refines maps (``fields.nesf``) from label images alone.

The label of a pixel counts where its ray meets the map: of all that Eq. 7 of the paper weighs, a map has the surface.
Votes and colours are withheld at random, so that the network learns what shape alone tells, and labels surface without
votes.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import io
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from msgspec.structs import replace
from numpy.typing import NDArray

from research.train.recipe import provenance
from research.train.train_checks import check_nothing_is_overwritten
from research.train.train_state import LOSS_PARTS, Progress, load_state, save_state
from semantic_mapper.config import AtLeastOne, AtLeastZero, Config, Fraction, NotNegative, Positive, to_plain
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.fields.nesf import (
    CELL_M,
    FARTHEST_M,
    Cells,
    Nesf,
    NesfConfig,
    NesfWeights,
    SurfacePoints,
    near_cells,
    pack_cells,
    pool,
    smoothed_votes,
)
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.fit import budget_fraction
from semantic_mapper.training.losses import RAREST

STATE_FILE = "state.safetensors"
CUBE_M = 1.0
TEMPERATURES = np.geomspace(0.5, 3.0, 40)
TRUSTED = np.linspace(0.1, 1.0, 10)
FITTED = 200_000  # voxels are enough for two numbers
NEVER_STORED = ("seconds", "steps", "logs", "save_every_s")  # may differ when a run goes on
WARM_UP = 0.03  # fraction of the budget over which the learning rate rises
LAST_RATE = 0.02  # fraction of the learning rate that is left at the end
LEAST_LABELLED = 100  # voxels of a crop that are worth a step


class NesfTrainConfig(Config, frozen=True):
    """A training run; ``research/recipes/nesf-rooms.toml``."""

    kind: str = "nesf"
    field: NesfConfig = NesfConfig()
    rooms: NotNegative = 102  # procedural rooms to map, from ``first_seed`` on
    validation_rooms: NotNegative = 12  # of other materials than those
    first_seed: NotNegative = 50_000  # S-Ray's weights were trained on rooms below: on those its votes are too sure
    logs: tuple[str, ...] = ()  # labelled logs with depth, in place of rooms; the last tenth of them validates
    maps: str = ""  # folder of the maps that are made of them; empty = "maps" in the run's folder
    weights: str = ""  # of the field that maps; empty = those that ship
    seconds: float = 0.0  # of training; 0 = only steps count
    steps: NotNegative = 2400  # of one map each
    crop_voxels: AtLeastOne = 60_000  # of larger maps, those nearest to a point of theirs
    labelled_voxels: AtLeastOne = 16_384  # of a crop that are compared
    learning_rate: Positive = 3e-3
    weight_decay: AtLeastZero = 0.01
    balance: Fraction = 0.1  # a class counts by its fraction of all maps' voxels to the power of minus this
    centres: AtLeastZero = 0.0  # weight of the distance to objects' centres, where maps have instances; 0 = not learned
    no_votes: Fraction = 0.1  # of crops that lose all votes
    cubes: Fraction = 0.3  # of crops that lose those of some of their cubes of 1 m
    cubes_lost: Fraction = 0.3  # of the cubes
    no_colour: Fraction = 0.3
    validate_every: AtLeastOne = 500  # steps
    save_every_s: Positive = 120.0
    seed: NotNegative = 0


class VoxelLabels(NamedTuple):
    """Labelled voxels of a map, each once: the class of most of its pixels, and the object of most of those.

    Args:
        row: (V,) int64 of the map's points.
        channel: (V,) int64 class.
        thing: (V,) int64 number of its object from 0; -1 = none is known.
    """

    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    thing: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class TrainingMap:
    """The surface of a map, and the labels that pixels give it.

    Args:
        points: Voxels that make up the cells (``mapping.refine``).
        row: (H,) int64 of ``points`` that a labelled pixel's ray meets.
        channel: (H,) int64 its class; a voxel may stand here with several.
        instance: (H,) int64 number of the pixel's object, from 1; 0 = not known, or no countable thing.
        count: (H,) float32 pixels.
        made_of: Digest of what it was made of; empty = not noted.
    """

    points: SurfacePoints
    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    instance: NDArray[np.int64]
    count: NDArray[np.float32]
    made_of: str = ""

    @property
    def voxels(self) -> VoxelLabels:
        """The labels of its voxels."""
        _, of_class = np.unique((self.row << 8) | self.channel, return_inverse=True)
        pixels = np.bincount(of_class, self.count)[of_class]  # with the same class at the same voxel
        order = np.lexsort((self.count, self.channel, pixels, self.row))
        last = order[np.diff(self.row[order], append=-1) != 0]
        found = np.stack((self.channel, self.instance))[:, last]
        _, number = np.unique(found, axis=1, return_inverse=True)
        thing = np.where(found[1] > 0, number.reshape(-1), -1)
        return VoxelLabels(self.row[last], found[0], thing)

    def save(self, path: Path) -> None:
        """Write to a compressed .npz, in half precision where that is enough; whole or not at all."""
        content = io.BytesIO()
        p = self.points
        np.savez_compressed(
            content,
            xyz=p.xyz,
            rise=p.rise.astype(np.float16),
            height_m=p.height_m.astype(np.float16),
            rgb=(p.rgb * 255).round().astype(np.uint8),
            log_p=p.log_p.astype(np.float16),
            votes=p.votes.astype(np.float16),
            row=self.row.astype(np.int32),
            channel=self.channel.astype(np.uint8),
            instance=self.instance.astype(np.uint16),
            count=self.count,
            made_of=np.array(self.made_of),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainingMap:
        """What ``save`` wrote; large arrays stay in half precision. Raises WeightsError: damaged, or something else."""
        with _stored(path) as stored:
            points = SurfacePoints(*(stored[name] for name in SurfacePoints._fields))
            points = points._replace(rgb=(points.rgb / np.float32(255)).astype(np.float16))
            row, channel, instance = (stored[name].astype(np.int64) for name in ("row", "channel", "instance"))
            return cls(points, row, channel, instance, stored["count"].astype(np.float32), str(stored["made_of"]))

    @classmethod
    def read_made_of(cls, path: Path) -> str:
        """``made_of`` alone; empty where the file has none. Errors as of ``load``."""
        with _stored(path) as stored:
            return str(stored["made_of"]) if "made_of" in stored else ""


@contextmanager
def _stored(path: Path) -> Iterator[Any]:
    try:
        with np.load(path) as stored:
            yield stored
    except (KeyError, ValueError, OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise WeightsError(f"{path}: not a training map ({error}); delete it, and it is made again") from error


@dataclass(frozen=True, slots=True)
class NesfProgress:
    """State after a step: fraction of the budget, mean loss since the last line, last validation (None before)."""

    step: int
    fraction: float
    loss: float
    miou: float | None


def train_nesf(
    config: NesfTrainConfig,
    label_set: LabelSet,
    maps: Sequence[TrainingMap],
    validation: Sequence[TrainingMap],
    folder: Path | None = None,
    *,
    resume: bool = False,
    on_progress: Callable[[NesfProgress], object] = lambda progress: None,
    stopped: Callable[[], object] = bool,
) -> NesfWeights:
    """Train; returns the weights that were best on the validation maps, with trust and temperature fitted to them.

    Raises ConfigError: no maps, another config than that of the run to go on with, or a run in the folder.
    WeightsError: no state to go on with, or training diverged.

    Args:
        label_set: Of the maps.
        folder: For the state; None writes nothing.
        resume: Go on with the state there.
        stopped: Asked once a step; when it says yes, the state is saved and the best weights so far are returned.
    """
    if not maps or not validation:
        raise ConfigError("training needs at least one map, and one more to validate on")
    if config.steps <= 0 and config.seconds <= 0:
        raise ConfigError("training needs a budget: set steps or seconds")
    torch.manual_seed(config.seed)
    labels = [map_.voxels for map_ in maps]
    centres = config.centres > 0 and any((found.thing >= 0).any() for found in labels)
    model = Nesf(label_set, replace(config.field, centres=centres))
    model.start_smoothed()
    optimiser = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, betas=(0.9, 0.99), weight_decay=config.weight_decay
    )
    weight = _class_weights(labels, len(label_set), config.balance)
    identity = {k: v for k, v in to_plain(config).items() if k not in NEVER_STORED}
    progress = Progress(torch.zeros(len(LOSS_PARTS), dtype=torch.float64))
    state = None if folder is None else folder / STATE_FILE
    if state is not None and resume:
        progress = load_state(state, model, optimiser, identity)
    elif state is not None:
        check_nothing_is_overwritten(state)
    began, saved = time.monotonic() - progress.elapsed_s, time.monotonic()
    if not progress.history:
        progress.history.append({"step": 0, **_validate(model, validation)})
    mean_loss, miou = 0.0, None
    while not stopped():
        progress.elapsed_s = time.monotonic() - began
        fraction = budget_fraction(progress.step, progress.elapsed_s, steps=config.steps, seconds=config.seconds)
        progress.finished = fraction >= 1
        if progress.finished:
            break
        rate = config.learning_rate * (LAST_RATE + (1 - LAST_RATE) * (0.5 + 0.5 * np.cos(np.pi * fraction)))
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, 0.1 + fraction / WARM_UP)
        number = _map_of_step(progress.step, len(maps), config.seed)
        crop = _crop(maps[number].points, labels[number], config, np.random.default_rng((config.seed, progress.step)))
        loss = _step(model, optimiser, crop, weight, config, progress.step)
        mean_loss += (loss - mean_loss) * max(0.02, 1 / (progress.step + 1))
        progress.step += 1
        if progress.step % config.validate_every == 0:
            miou = _note_validation(progress, model, validation)
        on_progress(NesfProgress(progress.step, fraction, mean_loss, miou))
        if state is not None and time.monotonic() - saved > config.save_every_s:
            save_state(state, progress, model, optimiser, identity)
            saved = time.monotonic()
    if progress.history[-1]["step"] != progress.step:
        _note_validation(progress, model, validation)
    if state is not None:
        save_state(state, progress, model, optimiser, identity)
    if progress.best is not None:
        model.load_state_dict(progress.best)
    model.eval()
    trusted = _fit_to_validation(model, validation)
    recipe = {
        "config": to_plain(config),
        "steps": progress.step,
        "best_step": progress.best_step,
        "trusted": round(trusted, 3),
        "maps": len(maps),
        "seconds": round(progress.elapsed_s, 1),
        "validation": _validate(model, validation),
        "history": progress.history,
    }
    return NesfWeights(model, recipe | provenance(torch.device("cpu")))


def _note_validation(progress: Progress, model: Nesf, validation: Sequence[TrainingMap]) -> float:
    found = _validate(model, validation)
    progress.history.append({"step": progress.step, "seconds": round(progress.elapsed_s, 1), **found})
    if found["miou"] > progress.best_score:
        progress.best_score, progress.best_step = found["miou"], progress.step
        progress.best = {name: t.clone() for name, t in model.state_dict().items()}
    return found["miou"]


def _class_weights(labels: Sequence[VoxelLabels], classes: int, balance: float) -> torch.Tensor:
    """(L,) what a voxel of each class counts; the mean over all voxels is 1."""
    fraction = np.bincount(np.concatenate([found.channel for found in labels]), minlength=classes).astype(np.float64)
    fraction /= max(fraction.sum(), 1)
    weight = (fraction + RAREST) ** -balance
    return torch.from_numpy(weight / max(float(fraction @ weight), 1e-9)).float()


def _map_of_step(step: int, count: int, seed: int) -> int:
    """Each map once, in random order, then each again."""
    return int(np.random.default_rng((seed, step // count, 1)).permutation(count)[step % count])


class _Crop(NamedTuple):
    """A part of a map, changed at random: cells, and of V voxels what the map says and what the labels say.

    Args:
        cells: Of all voxels of the part.
        xyz: (V, 3) in cells.
        log_p: (V, L).
        channel: (V,).
        way: (V, 3) float32 metres to their objects' centres, at most ``FARTHEST_M`` long.
        weight: (V,) float32 of each in the loss of that; 0 = its object is not known.
    """

    cells: Cells
    xyz: NDArray[np.float32]
    log_p: torch.Tensor
    channel: torch.Tensor
    way: torch.Tensor
    weight: torch.Tensor


def _crop(
    points: SurfacePoints, labels: VoxelLabels, config: NesfTrainConfig, rng: np.random.Generator
) -> _Crop | None:
    """A part of a map, turned about z, mirrored, stretched and shifted, some of it withheld; None: hardly a label."""
    kept = _nearest_voxels(points.xyz, config.crop_voxels, rng)
    row_here = np.full(len(points.xyz), -1, np.int64)
    row_here[kept] = np.arange(len(kept))
    inside = np.flatnonzero(row_here[labels.row] >= 0)
    if len(inside) < LEAST_LABELLED:
        return None
    move = _random_move(rng)
    stretch = float(np.linalg.norm(move[2]))
    part = SurfacePoints(*(values[kept].astype(np.float32) for values in points))
    xyz = (part.xyz @ move.T + rng.uniform(0, 2, 3)).astype(np.float32)
    height = part.height_m * np.float32(stretch) + np.float32(rng.normal(0, 0.03))
    part = withhold(_other_colours(part._replace(xyz=xyz, height_m=height), rng), config, rng)

    centre, size = _centres(points.xyz[labels.row], labels.thing)  # of whole objects, whatever the part has of them
    chosen = rng.choice(inside, min(config.labelled_voxels, len(inside)), replace=False)
    rows = row_here[labels.row[chosen]]
    way = (centre[chosen] - points.xyz[labels.row[chosen]].astype(np.float32)) @ move.T * CELL_M
    length = np.linalg.norm(way, axis=1, keepdims=True)
    way *= np.minimum(1, FARTHEST_M / np.maximum(length, 1e-6))
    weight = np.where(labels.thing[chosen] >= 0, np.maximum(size[chosen], 1) ** -0.5, 0)
    return _Crop(
        pool(part),
        part.xyz[rows],
        torch.from_numpy(part.log_p[rows]),
        torch.from_numpy(labels.channel[chosen]),
        torch.from_numpy(way.astype(np.float32)),
        torch.from_numpy(weight.astype(np.float32)),
    )


def _nearest_voxels(xyz: NDArray[Any], most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """At most this many of the voxels: an upright square round one of them."""
    if len(xyz) <= most:
        return np.arange(len(xyz))
    apart = np.abs(xyz[:, :2] - xyz[rng.integers(len(xyz)), :2]).max(axis=1)
    return np.flatnonzero(apart <= np.partition(apart, most - 1)[most - 1])


def _random_move(rng: np.random.Generator) -> NDArray[np.float64]:
    """(3, 3): turned about z, mirrored half of the time, stretched by up to a tenth."""
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array(((c, -s, 0), (s, c, 0), (0, 0, 1)))
    return turned @ np.diag((rng.choice((-1.0, 1.0)), 1.0, 1.0)) * rng.uniform(0.9, 1.1)


def _other_colours(points: SurfacePoints, rng: np.random.Generator) -> SurfacePoints:
    """As under another light."""
    seen = points.rgb.any(axis=1, keepdims=True)
    rgb = points.rgb * (rng.uniform(0.7, 1.3) * rng.uniform(0.9, 1.1, 3)) + rng.uniform(-0.1, 0.1)
    return points._replace(rgb=np.where(seen, np.clip(rgb, 1e-3, 1), 0).astype(np.float32))


def _centres(xyz: NDArray[Any], thing: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Mean (V, 3) of the voxels of each voxel's object, and how many (V,) it has."""
    size = np.bincount(thing + 1)
    sums = np.stack([np.bincount(thing + 1, xyz[:, axis]) for axis in range(3)], axis=1)
    return (sums / np.maximum(size, 1)[:, None])[thing + 1].astype(np.float32), size[thing + 1]


def _step(
    model: Nesf,
    optimiser: torch.optim.Optimizer,
    crop: _Crop | None,
    weight: torch.Tensor,
    config: NesfTrainConfig,
    step: int,
) -> float:
    if crop is None:
        return 0.0
    optimiser.zero_grad()
    logits, way = model.read(model(crop.cells), near_cells(crop.xyz, crop.cells.cells), crop.log_p)
    loss = torch.nn.functional.cross_entropy(logits, crop.channel, weight)
    if config.centres > 0 and bool((crop.weight > 0).any()):
        apart = (way - crop.way).norm(dim=1)
        loss = loss + config.centres * (apart * crop.weight).sum() / crop.weight.sum()
    total = float(loss.detach())
    if not np.isfinite(total):
        raise WeightsError(f"the loss of step {step} is {total}: training has diverged; lower learning_rate")
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
    optimiser.step()
    return total


def withhold(points: SurfacePoints, config: NesfTrainConfig, rng: np.random.Generator) -> SurfacePoints:
    """The points without some of their votes and colours."""
    if rng.random() < config.no_colour:
        points = points._replace(rgb=np.zeros_like(points.rgb))
    chance = rng.random()
    if chance >= config.no_votes + config.cubes:
        return points
    gone = np.ones(len(points.votes), np.bool_)
    if chance >= config.no_votes:
        cube = np.floor(points.xyz / (CUBE_M / CELL_M) + rng.uniform(0, 1, 3)).astype(np.int64)
        _, member = np.unique(pack_cells(cube), return_inverse=True)
        member = member.reshape(-1)
        gone = (rng.random(member.max(initial=0) + 1) < config.cubes_lost)[member]
    log_p = np.where(gone[:, None], np.float32(0), points.log_p)
    return points._replace(log_p=log_p, votes=np.where(gone, np.float32(0), points.votes))


@torch.inference_mode()
def _validate(model: Nesf, maps: Sequence[TrainingMap]) -> dict[str, Any]:
    """mIoU at the labelled hits of whole maps, each voxel once, and cross-entropy; of the maps as they are, too."""
    before, after = ConfusionMatrix(model.label_set), ConfusionMatrix(model.label_set)
    losses: list[float] = []
    for map_ in maps:
        logits, log_p, channel = _map_logits(model, map_)
        truth = model.label_set.to_ids(channel)
        for said, matrix in ((log_p, "before"), (logits, "after")):
            found = confusion_of(truth, model.label_set.to_ids(said.argmax(1).numpy()), model.label_set, matrix)
            if matrix == "before":
                before = before + found
            else:
                after = after + found
        scaled = logits / model.temperature
        losses.append(float(torch.nn.functional.cross_entropy(scaled, torch.from_numpy(channel))))
    figures = {"miou": after.metrics().miou, "map_miou": before.metrics().miou, "loss": float(np.mean(losses))}
    return {name: round(value, 5) for name, value in figures.items()}


@torch.no_grad()
def trust(model: Nesf, fraction: float) -> None:
    """Blend the answers about classes with the smoothed votes: 1 = leave them as they are, 0 = smoothed votes."""
    head, classes = model.net.head, slice(0, -3)
    head.weight[classes] *= fraction
    head.bias[classes] *= fraction
    head.bias[-5] += 1 - fraction
    head.bias[-4] -= 1 - fraction


@torch.inference_mode()
def _fit_to_validation(model: Nesf, maps: Sequence[TrainingMap]) -> float:
    """Set how far the network is trusted against smoothed votes, and the temperature: labels of the maps are likeliest.

    A network is too sure of what it learned where a scene differs from those it was trained on, and overrules votes
    that are right. Returns how far it is trusted.
    """
    answers = [_map_logits(model, map_) for map_ in maps]
    some = slice(0, None, max(1, sum(len(a[2]) for a in answers) // FITTED))
    logits, channel = torch.cat([a[0] for a in answers])[some], np.concatenate([a[2] for a in answers])[some]
    start, channel = smoothed_votes(model.label_set).model, torch.from_numpy(channel)
    votes = torch.cat([_map_logits(start, map_)[0] for map_ in maps])[some]
    losses = {
        (trusted, t): float(torch.nn.functional.cross_entropy(torch.lerp(votes, logits, trusted) / t, channel))
        for trusted in TRUSTED.tolist()
        for t in TEMPERATURES.tolist()
    }
    trusted, temperature = min(losses, key=losses.__getitem__)
    trust(model, trusted)
    model.temperature.fill_(temperature)
    return trusted


@torch.inference_mode()
def _map_logits(model: Nesf, map_: TrainingMap) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.int64]]:
    """Logits and the map's log-probabilities (V, L) at labelled voxels, and the class (V,) of most of their pixels."""
    points = SurfacePoints(*(v.astype(np.float32) for v in map_.points))
    rows, channel, _ = map_.voxels
    cells = pool(points)
    logits, _ = model.read(
        model(cells), near_cells(points.xyz[rows], cells.cells), torch.from_numpy(points.log_p[rows])
    )
    return logits, torch.from_numpy(points.log_p[rows]), channel
