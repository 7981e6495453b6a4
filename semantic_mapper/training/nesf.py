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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from semantic_mapper.config import AtLeastOne, Config, Fraction, NotNegative, Positive, to_plain
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, confusion_of
from semantic_mapper.fields.nesf import CELL_M, Nesf, NesfConfig, NesfWeights, SurfacePoints, near_cells, pool
from semantic_mapper.fields.sparse_conv import find_rows, pack_cells
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.losses import RAREST, semantic_loss
from semantic_mapper.training.recipe import provenance
from semantic_mapper.training.schedule import budget_fraction
from semantic_mapper.training.train_checks import check_nothing_is_overwritten
from semantic_mapper.training.train_state import LOSS_PARTS, Progress, load_state, save_state

STATE_FILE = "state.safetensors"
MOST_COUNT = 4  # pixels that one voxel counts for
CUBE_M = 1.0
TEMPERATURES = np.geomspace(0.5, 3.0, 40)
NEVER_STORED = ("seconds", "steps", "logs", "save_every_s")  # may differ when a run goes on


class NesfTrainConfig(Config, frozen=True):
    """A training run; ``recipes/nesf-rooms.toml``."""

    kind: str = "nesf"
    field: NesfConfig = NesfConfig()
    rooms: NotNegative = 100  # procedural rooms to map, from ``first_seed`` on
    validation_rooms: NotNegative = 10
    first_seed: NotNegative = 50_000  # S-Ray's weights were trained on rooms below: on those its votes are too sure
    logs: tuple[str, ...] = ()  # labelled logs with depth, in place of rooms; the last tenth of them validates
    maps: str = ""  # folder of the maps that are made of them; empty = "maps" in the run's folder
    weights: str = ""  # of the field that maps; empty = those that ship
    seconds: float = 0.0  # of training; 0 = only steps count
    steps: NotNegative = 3000
    crops: AtLeastOne = 2  # a step
    crop_m: Positive = 3.2  # side of a crop, of full height
    hits: AtLeastOne = 8192  # of a crop that are compared
    learning_rate: Positive = 1e-3
    final_learning_rate: Positive = 1e-5
    balance: Fraction = 0.25  # a class counts by its fraction of the hits to the power of minus this
    smoothness: Fraction = 0.1
    smooth_points: AtLeastOne = 2048
    smooth_m: Positive = 0.05
    no_votes: Fraction = 0.15  # of crops that lose all votes
    cubes: Fraction = 0.3  # of crops that lose those of half of their cubes of 1 m
    no_colour: Fraction = 0.3
    validate_every: AtLeastOne = 250  # steps
    save_every_s: Positive = 120.0
    seed: NotNegative = 0


@dataclass(frozen=True, slots=True, eq=False)
class TrainingMap:
    """The surface of a map, and the labels that pixels give it.

    Args:
        points: Voxels that make up the cells (``mapping.refine``).
        row: (H,) int64 of ``points`` that a labelled pixel's ray meets.
        channel: (H,) int64 its class; a voxel may stand here with several.
        count: (H,) float32 pixels.
    """

    points: SurfacePoints
    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    count: NDArray[np.float32]

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
            count=self.count.astype(np.float16),
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content.getvalue())

    @classmethod
    def load(cls, path: Path) -> TrainingMap:
        """What ``save`` wrote; large arrays stay in half precision.

        Raises:
            WeightsError: it is something else.
        """
        try:
            with np.load(path) as stored:
                points = SurfacePoints(*(stored[name] for name in SurfacePoints._fields))
                points = points._replace(rgb=(points.rgb / np.float32(255)).astype(np.float16))
                row, channel = stored["row"].astype(np.int64), stored["channel"].astype(np.int64)
                return cls(points, row, channel, stored["count"].astype(np.float32))
        except (KeyError, ValueError, OSError) as error:
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
    """Train; returns the weights that were best on the validation maps, with a temperature fitted to them.

    Args:
        label_set: Of the maps.
        folder: For the state; None writes nothing.
        resume: Go on with the state there.
        stopped: Asked once a step; when it says yes, the state is saved and the best weights so far are returned.

    Raises:
        ConfigError: no maps, another config than that of the run to go on with, or a run in the folder.
        WeightsError: no state to go on with, or training diverged.
    """
    if not maps or not validation:
        raise ConfigError("training needs at least one map, and one more to validate on")
    if config.steps <= 0 and config.seconds <= 0:
        raise ConfigError("training needs a budget: set steps or seconds")
    torch.manual_seed(config.seed)
    model = Nesf(label_set, config.field)
    model.start_smoothed()
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate, betas=(0.9, 0.99))
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
        rate = config.learning_rate * (config.final_learning_rate / config.learning_rate) ** fraction
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, progress.step / 50 + 0.1)
        loss = _step(model, optimiser, maps, config, progress.step)
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
    model.temperature.fill_(_temperature(model, validation))
    recipe = {
        "config": to_plain(config),
        "steps": progress.step,
        "best_step": progress.best_step,
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


def _step(
    model: Nesf, optimiser: torch.optim.Optimizer, maps: Sequence[TrainingMap], config: NesfTrainConfig, step: int
) -> float:
    rng = np.random.default_rng((config.seed, step))
    optimiser.zero_grad()
    total = 0.0
    for _ in range(config.crops):
        loss = _crop_loss(model, maps[int(rng.integers(len(maps)))], config, rng) / config.crops
        loss.backward()
        total += float(loss.detach())
    if not np.isfinite(total):
        raise WeightsError(f"the loss of step {step} is {total}: training has diverged; lower learning_rate")
    torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
    optimiser.step()
    return total


def _crop_loss(model: Nesf, map_: TrainingMap, config: NesfTrainConfig, rng: np.random.Generator) -> torch.Tensor:
    """Loss of one crop, turned about z and shifted, some of it withheld."""
    xyz = map_.points.xyz
    centre = xyz[map_.row[rng.integers(len(map_.row))], :2]
    kept = np.flatnonzero((np.abs(xyz[:, :2] - centre) < config.crop_m / 2 / CELL_M).all(axis=1))
    points = withhold(SurfacePoints(*(v[kept].astype(np.float32) for v in map_.points)), config, rng)
    upright = points.xyz  # as the map has it
    turned = _turned(upright - np.append(centre, 0), rng.uniform(0, 2 * np.pi)) + rng.uniform(0, 1, 3)
    points = points._replace(xyz=turned.astype(np.float32))
    cells = pool(points)
    answer = model(cells)

    row_here = np.full(len(xyz), -1, np.int64)
    row_here[kept] = np.arange(len(kept))
    hits = np.flatnonzero(row_here[map_.row] >= 0)
    hits = rng.choice(hits, min(config.hits, len(hits)), replace=False)
    rows, channel = row_here[map_.row[hits]], torch.from_numpy(map_.channel[hits])
    logits = _logits(model, answer, points, cells.cells, rows)
    count = torch.from_numpy(np.minimum(map_.count[hits], MOST_COUNT))
    fraction = torch.bincount(channel, count, len(model.label_set)) / count.sum()
    weight = count * ((fraction + RAREST) ** -config.balance)[channel].float()
    loss = semantic_loss(logits, channel, weight)
    if config.smoothness <= 0:
        return loss
    return loss + config.smoothness * _roughness(model, answer, points, cells.cells, upright, rows, config, rng)


def _roughness(
    model: Nesf,
    answer: torch.Tensor,
    points: SurfacePoints,
    cells: NDArray[np.int64],
    upright: NDArray[np.float32],
    rows: NDArray[np.int64],
    config: NesfTrainConfig,
    rng: np.random.Generator,
) -> torch.Tensor:
    """Squared distance of class probabilities at points and at others some centimetres off."""
    here = rows[rng.integers(len(rows), size=config.smooth_points)]
    moved = upright[here] + rng.normal(0, config.smooth_m / CELL_M, (len(here), 3))
    keys = pack_cells(np.floor(2 * upright).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    place = find_rows(keys[order], pack_cells(np.floor(2 * moved).astype(np.int64)))
    there = place < len(keys)
    if not there.any():
        return answer.sum() * 0
    first = torch.softmax(_logits(model, answer, points, cells, here[there]), dim=1)
    second = torch.softmax(_logits(model, answer, points, cells, order[place[there]]), dim=1)
    return ((first - second) ** 2).sum(dim=1).mean()


def _logits(
    model: Nesf, answer: torch.Tensor, points: SurfacePoints, cells: NDArray[np.int64], rows: NDArray[np.int64]
) -> torch.Tensor:
    return model.logits(answer, near_cells(points.xyz[rows], cells), torch.from_numpy(points.log_p[rows]))


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
        gone = (rng.random(member.max(initial=0) + 1) < 0.5)[member]
    log_p = np.where(gone[:, None], np.float32(0), points.log_p)
    return points._replace(log_p=log_p, votes=np.where(gone, np.float32(0), points.votes))


def _turned(xyz: NDArray[Any], angle: float) -> NDArray[Any]:
    c, s = np.cos(angle), np.sin(angle)
    return xyz @ np.array(((c, s, 0), (-s, c, 0), (0, 0, 1)))


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


@torch.inference_mode()
def _temperature(model: Nesf, maps: Sequence[TrainingMap]) -> float:
    """That under which the labels of the maps are likeliest."""
    answers = [_map_logits(model, map_) for map_ in maps]
    logits = torch.cat([a[0] for a in answers])
    channel = torch.from_numpy(np.concatenate([a[2] for a in answers]))
    losses = [float(torch.nn.functional.cross_entropy(logits / t, channel)) for t in TEMPERATURES]
    return float(TEMPERATURES[int(np.argmin(losses))])


def _map_logits(model: Nesf, map_: TrainingMap) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.int64]]:
    """Logits and the map's log-probabilities (V, L) at labelled voxels, and the class (V,) of most of their pixels."""
    points = SurfacePoints(*(v.astype(np.float32) for v in map_.points))
    order = np.lexsort((map_.count, map_.row))
    last = np.append(np.diff(map_.row[order]) > 0, [True])
    rows, channel = map_.row[order][last], map_.channel[order][last]
    cells = pool(points)
    answer = model(cells)
    logits = _logits(model, answer, points, cells.cells, rows)
    return logits, torch.from_numpy(points.log_p[rows]), channel
