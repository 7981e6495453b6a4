"""Fit a Panoptic NeRF to one scene: geometry first, then density, colours and classes together, guided by boxes."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.config import BoxConfig
from semantic_mapper.errors import ConfigError, FrameError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.boxes import MAX_INTERVALS
from semantic_mapper.fields.scene.grid import NOTHING, RaySamples, heaviest, ray_fraction
from semantic_mapper.fields.scene.march import adam_grid
from semantic_mapper.fields.scene.panoptic import BoxesOnRays, Panoptic, merged_classes
from semantic_mapper.imaging import resize_label
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.boxes import fill_boxes, nothing_in_view, shown_boxes
from semantic_mapper.training.config import FinetuneConfig, PanopticFitConfig
from semantic_mapper.training.finetune import check_budget
from semantic_mapper.training.fit import Budget, OnProgress, fit, part_of, time_left
from semantic_mapper.training.frame_rays import FrameRays, frame_rays, usable_frames
from semantic_mapper.training.grid_fit import (
    BETA1,
    BETA2,
    FEATURE_RATE,
    TRUNK_RATE,
    fit_geometry,
    scene_checkpoint,
    view_fraction,
)
from semantic_mapper.types import Bool, Int64, PosedFrame

GRID_UNTIL = 0.35  # fraction of the time for geometry and colours alone
SAMPLES = 8  # of a ray, those of greatest weight
DENSITY_RATE = 0.05
SEMANTICS, DEPTH = 0.05, 0.1  # weights of all that classes are learned from, and of rendered depth, against colours
FINAL_RATE = 0.1  # what is left of all rates in the end
LEAST = 1e-4  # of the probability that a pseudo label has: below, it has no gradient
POINT_WEIGHT = 0.05  # from which on a sample says what is there
DEPTH_REACH = 0.05  # 1 / m, of inverse depth: a larger error counts linearly
SURVEYED = 20000  # rays that say how much of the images boxes cover
LOOKED_AT = 2000  # of these together: where many boxes overlap, each ray takes a table of pairs
FEW_COVERED = 0.01  # fraction of pixels that meet a box, below which the log is warned about
FEW_MATCHED = 0.5  # fraction of the pseudo labels that are possible on their ray, below which the log is warned about
LEARNED = 10  # steps of the second part, below which the learned classes of a stopped fit are hardly more than noise
EMPTY_EVERY = 50  # steps between two looks at which cells are empty
_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class PseudoRays:
    """All pixels of F frames with their pseudo labels.

    Args:
        rays: Of the frames.
        channel: (P,) int64, -1 = none.
        gain: (F, 3) exposure of the frames.
        still: Numbers of the pixels that show what stands still.
    """

    rays: FrameRays
    channel: torch.Tensor
    gain: torch.Tensor
    still: Int64


@dataclass(frozen=True, slots=True)
class Survey:
    """What boxes and pseudo labels have to do with each other.

    Args:
        boxes: That stand still.
        seen: Of these, boxes that any surveyed ray meets.
        moving: Boxes that move, and are followed.
        lost: Boxes that move, and that no frame shows at their times.
        covered: Fraction of pixels whose ray meets a box.
        matched: Fraction of pixels with a pseudo label whose class is possible on their ray.
        crowded: Fraction of pixels whose ray meets more boxes than are looked at, ``MAX_INTERVALS``.
        ambiguous: Fraction of pixels whose surface is in boxes of several classes.
    """

    boxes: int
    seen: int
    covered: float
    matched: float
    crowded: float = 0.0
    ambiguous: float = math.nan
    moving: int = 0
    lost: int = 0


def fit_panoptic(
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    seen_stamps_ns: Iterable[int] = (),
) -> Checkpoint:
    """Fit a ``Panoptic``.

    Args:
        frames: With poses; their label images are the pseudo labels.
        label_set: Of these and of the boxes.
        start: A ``Panoptic`` with the boxes; its weights are not looked at. Without boxes pseudo labels alone teach,
            where ``config`` leaves out the losses that need some.
        config: ``seconds`` bounds the whole fit. ``steps``, if not 0, is the number of steps of each of its two parts.
        on_progress: Called after every step.
        stopped: Called before every step; once it returns anything true, the field so far is the result. With less than
            ``LEARNED`` steps of the second part its classes are those of the boxes alone (``fixed``).
        seen_stamps_ns: Frames whose true labels those who made the pseudo labels have learned from.

    Raises:
        ConfigError: no boxes, none of them in view, no class in common with the pseudo labels, or no budget.
        FrameError: no pseudo label, or what ``fit_grid`` refuses.
        WeightsError: ``start`` has other classes.
    """
    check_budget(config)
    by_boxes = config.panoptic.fixed > 0 or config.panoptic.points > 0
    if not isinstance(start, Panoptic) or (by_boxes and not start.shape.boxes):
        raise ConfigError("a field of kind 'panoptic' needs boxes; give a file of them (--boxes)")
    if start.label_set != label_set:
        raise WeightsError(f"the boxes are of label set '{start.label_set.name}', the labels of '{label_set.name}'")
    began = time.monotonic()
    usable = held_out_unlabelled(usable_frames(frames), config.grid.held_out)
    everything = pseudo_rays(usable, label_set, config.width)
    boxes, lost = _followed(start, usable, everything.rays)
    if by_boxes and not boxes:
        raise ConfigError(
            f"no box is in view of any frame: {lost} move, and no frame shows them at the times of their stamps. Are "
            "the stamps the log's, in nanoseconds?"
        )
    survey = replace(survey_boxes(start, everything, config), moving=len(start.moving) - lost, lost=lost)
    shape = msgspec.structs.replace(start.shape, boxes=boxes)
    part = msgspec.structs.replace(config, seconds=GRID_UNTIL * config.seconds)
    progress = part_of(on_progress, 0, GRID_UNTIL)
    movers = start.moving

    def shows_movers(seen: Sequence[PosedFrame], rays: FrameRays) -> Bool:
        return shown_boxes(movers, seen, rays)[0]

    leave_out = shows_movers if len(movers) else None
    field, grid = fit_geometry(start.kind, usable, label_set, start, part, progress, stopped, shape, leave_out)
    assert isinstance(field, Panoptic)
    data = pseudo_rays(grid.frames, label_set, config.width)
    still = np.flatnonzero(~shows_movers(grid.frames, data.rays))
    data = replace(data, gain=torch.from_numpy(grid.gains), still=still)
    steps = JointFit(field, data, config).run(
        time_left(config.seconds, began), part_of(on_progress, GRID_UNTIL, 1.0), stopped
    )
    if steps < LEARNED and stopped():
        field.shape = field.config = msgspec.structs.replace(field.shape, classes="fixed")
    fill_boxes(field, grid.frames, data.rays, grid.gains, config.grid.near_m)
    survey = replace(survey, ambiguous=ambiguous_fraction(field, everything, config))
    taught = [f for f in usable if f.label is not None and not f.label_is_pseudo]
    checkpoint = scene_checkpoint(field, grid, config, time.monotonic() - began, seen_stamps_ns, taught)
    figures: dict[str, Any] = {name: getattr(survey, name) for name in ("boxes", "seen", "moving", "lost")}
    figures |= {name: round(getattr(survey, name), 4) for name in ("covered", "matched", "crowded", "ambiguous")}
    figures["labelled_frames"] = sum(f.label is not None for f in usable)
    figures["frames"] = len(usable)
    recipe = checkpoint.recipe | {"grid_steps": grid.steps, "steps": steps, "panoptic": figures}
    return Checkpoint(checkpoint.model, (), recipe)


def held_out_unlabelled(frames: Sequence[PosedFrame], every: int) -> list[PosedFrame]:
    """Frames so that each ``every``-th, which ``fit_grid`` holds out, is without labels where there are such frames."""
    plain, labelled = ([f for f in frames if (f.label is None) == none] for none in (True, False))
    if not every or not plain:
        return list(frames)
    ordered: list[PosedFrame] = []
    while plain or labelled:
        held_out = (len(ordered) + 1) % every == 0
        ordered.append((plain if plain and (held_out or not labelled) else labelled).pop(0))
    return ordered


def pseudo_rays(frames: Sequence[PosedFrame], label_set: LabelSet, width: int) -> PseudoRays:
    """The pixels of frames with their label images.

    Raises:
        FrameError: no frame has one, or nothing is known in any of them.
    """
    rays = frame_rays(frames, width)
    if all(f.label is None for f in frames):
        raise FrameError("no frame has a pseudo label; give a folder of them or weights that make some (--pseudo)")
    channel = [
        np.full(k.width * k.height, -1)
        if f.label is None
        else label_set.to_channels(resize_label(f.label, k), f"frame seq={f.seq}").ravel()
        for f, k in zip(frames, rays.intrinsics, strict=True)
    ]
    channels = torch.from_numpy(np.concatenate(channel)).long()
    if not (channels >= 0).any():
        raise FrameError(
            f"all pixels of all {sum(f.label is not None for f in frames)} pseudo labels are unknown (id "
            f"{label_set.ignore_id}), so that they teach nothing; give others (--pseudo)"
        )
    return PseudoRays(rays, channels, torch.ones(len(frames), 3), np.arange(len(rays)))


def survey_boxes(field: Panoptic, data: PseudoRays, config: FinetuneConfig) -> Survey:
    """How many pixels meet boxes.

    Raises:
        ConfigError: no pixel does, or boxes and pseudo labels have no class in common.
    """
    if not len(field.primitives):
        return Survey(0, 0, 0.0, 1.0)
    pixels = _some_pixels(data, config.seed)
    rays = data.rays.rays(pixels, config.grid.near_m)
    found = field.primitives.intervals(rays)
    covered = (found.count > 0).float().mean().item()
    names = field.label_set.names
    if covered == 0:
        meshes = field.primitives.meshes
        raise nothing_in_view(meshes.low, meshes.high, data.rays.T_world_camera[:, :3, 3])
    if covered < FEW_COVERED:
        _log.warning("few_boxes_in_view", covered=round(covered, 4), reason="are they in the log's world frame?")
    group = merged_classes(field.label_set, field.shape.merge)
    said = data.channel[data.channel >= 0].unique()
    boxed = field.channel_of_box.unique()
    if not (group[said][:, boxed] > 0).any():
        raise ConfigError(
            f"pseudo labels and boxes have no class in common: labels say {', '.join(names[i] for i in said)}, boxes "
            f"{', '.join(names[i] for i in boxed)}. `merge` of boxes.json says which stand for others"
        )
    channel = data.channel[torch.from_numpy(pixels)]
    matched = possible(field.on_ray(found), group, channel)[channel >= 0].float().mean().item()
    crowded = (found.count > MAX_INTERVALS).float().mean().item()
    if matched < FEW_MATCHED:
        _log.warning(
            "few_labels_match", matched=round(matched, 4), reason="most name a class that no box on their ray has"
        )
    return Survey(len(field.primitives), len(found.index[found.index >= 0].unique()), covered, matched, crowded)


def ambiguous_fraction(field: Panoptic, data: PseudoRays, config: FinetuneConfig) -> float:
    """Fraction of pixels whose surface is in boxes of more than one class."""
    several = 0
    for pixels in np.split(_some_pixels(data, config.seed), SURVEYED // LOOKED_AT):
        with torch.no_grad():
            samples = heaviest(field.march(data.rays.rays(pixels, config.grid.near_m)), 1)
            named = field.boxes_on(samples).named[:, 0].sum(-1)
        several += int(((named > 1) & (samples.opacity > 0.5)).sum())
    return several / SURVEYED


def possible(on_ray: torch.Tensor, group: torch.Tensor, channel: torch.Tensor) -> torch.Tensor:
    """u(r) (R,): whether what a pseudo label (R,) may stand for is on the ray (R, L); False without a label."""
    return ((group[channel.clamp_min(0)] > 0) & on_ray).any(1) & (channel >= 0)


def semantic_losses(
    field: Panoptic,
    samples: RaySamples,
    boxes: BoxesOnRays,
    learned: torch.Tensor,
    channel: torch.Tensor,
    group: torch.Tensor,
    weights: PanopticFitConfig,
) -> torch.Tensor:
    """Eq. 5 and 6: the pseudo labels against the fixed field and the learned one, and this one against the boxes.

    Args:
        samples: R rays; weights differentiable by the density.
        boxes: What holds them.
        learned: (R, K, L) the learned field.
        channel: (R,) pseudo labels, -1 = none.
        group: (L, L) of ``merged_classes``.
        weights: Of the three terms.
    """
    there = channel >= 0
    stands_for = group[channel.clamp_min(0)]
    count = there.sum().clamp_min(1)
    fixed = (field.composited(samples, boxes.fixed, boxes) * stands_for).sum(1)
    seen = (field.composited(samples, learned, boxes) * stands_for).sum(1)
    by_fixed = -(torch.log(fixed.clamp_min(LEAST)) * there).sum() / count
    by_learned = -(torch.log(seen.clamp_min(LEAST)) * possible(boxes.on_ray, group, channel)).sum() / count
    # Where one class is allowed this is the paper's cross-entropy; where there are several, one of them has to be it.
    allowed = (learned * boxes.classes).sum(-1)
    surface = (samples.weight.detach() > POINT_WEIGHT) & (boxes.classes.sum(-1) > 0)
    by_points = -(torch.log(allowed.clamp_min(LEAST)) * surface).sum() / surface.sum().clamp_min(1)
    return weights.fixed * by_fixed + weights.learned * by_learned + weights.points * by_points


class JointFit:
    """The second part of a fit: density, features, colours and classes from one batch of rays a step."""

    def __init__(self, field: Panoptic, data: PseudoRays, config: FinetuneConfig) -> None:
        self.field, self.data, self.config = field, data, config
        self.rng = np.random.default_rng(config.seed)
        self.group = merged_classes(field.label_set, field.shape.merge)
        assert field.trunk is not None
        networks = [p for name, p in field.trunk.named_parameters() if name != "features"]
        networks += [*field.head.parameters(), *field.classifier.parameters()]
        groups = [{"params": [field.trunk.features], "lr": FEATURE_RATE}, {"params": networks, "lr": TRUNK_RATE}]
        self.optimiser = torch.optim.Adam(groups)
        self.rates = [FEATURE_RATE, TRUNK_RATE]
        field.grid.values.requires_grad_(True)
        values = field.grid.values.detach().numpy()
        self.first, self.second = np.zeros_like(values), np.zeros_like(values)
        self.rate = view_fraction(data.rays, field.grid.config, config.grid.near_m)
        self.solid = field.solid() if field.shape.uncovered == "empty" else None
        self.step = 0
        self._empty_cells()

    def run(self, seconds: float, on_progress: OnProgress | None = None, stopped: Callable[[], object] = bool) -> int:
        """Learn until the budget is used (``seconds`` 0 = only steps count); returns the number of steps."""
        steps = fit(self.learn, Budget(seconds, self.config.steps), on_progress, stopped)
        self._empty_cells()
        self.field.grid.values.requires_grad_(False)
        self.field.eval()
        return steps

    def learn(self, fraction: float) -> float:
        """One step at a fraction of the budget; returns the loss."""
        field, config = self.field, self.config
        left = FINAL_RATE**fraction
        for group, rate in zip(self.optimiser.param_groups, self.rates, strict=True):
            group["lr"] = rate * left
        pixels = self.data.still[self.rng.integers(0, len(self.data.still), config.step.rays)]
        batch = self.data.rays.rays(pixels, config.grid.near_m)
        samples = field.march(batch, SAMPLES, torch.from_numpy(self.rng.random(len(pixels), np.float32)))
        assert field.trunk is not None
        r = field.trunk(samples.points)
        share = ray_fraction(samples)
        behind = field.grid.sky_colour(batch.direction) * samples.light[:, None]
        colour = (share[..., None] * field.trunk.colour(r, batch.direction)).sum(1) + behind
        gain = self.data.gain[torch.from_numpy(self.data.rays.frame_of(pixels))]
        truth = torch.from_numpy(self.data.rays.rgb[pixels] / np.float32(255))
        loss = functional.mse_loss(gain * colour, truth)
        loss = loss + DEPTH * self._depth_loss(samples, share, pixels)
        channel = self.data.channel[torch.from_numpy(pixels)]
        boxes = field.boxes_on(samples)
        learned = field.learned(samples, r)
        semantics = semantic_losses(field, samples, boxes, learned, channel, self.group, config.panoptic)
        loss = loss + SEMANTICS * semantics
        self.optimiser.zero_grad()
        field.grid.values.grad = None
        loss.backward()
        self.optimiser.step()
        self._step_density(DENSITY_RATE * left)
        return float(loss.detach())

    def _depth_loss(self, samples: RaySamples, share: torch.Tensor, pixels: np.ndarray) -> torch.Tensor:
        """Huber of inverse depth, where depth is known, in units of its reach."""
        measured = torch.from_numpy(self.data.rays.depth_m[pixels])
        known = (measured > 0) & (samples.opacity.detach() > 0.5)
        z = (share * samples.z).sum(1) / samples.opacity.clamp_min(1e-6)
        error = (1 / z.clamp_min(1e-3) - 1 / measured.clamp_min(1e-3)) / DEPTH_REACH
        return (functional.huber_loss(error, torch.zeros_like(error), reduction="none") * known).mean()

    def _step_density(self, rate: float) -> None:
        self.step += 1
        grid = self.field.grid
        gradient = grid.values.grad
        assert gradient is not None
        adam_grid(
            len(self.rate),
            grid.values.detach().numpy(),
            gradient.contiguous().numpy(),
            self.first,
            self.second,
            self.rate,
            rate,
            0.0,
            BETA1,
            BETA2,
            1 - BETA1**self.step,
            1 - BETA2**self.step,
        )
        if self.step % EMPTY_EVERY == 0:
            self._empty_cells()

    def _empty_cells(self) -> None:
        """Empty what lies outside of all boxes, where nothing may be there, and find the cells that rays may skip."""
        with torch.no_grad():
            if self.solid is not None:
                self.field.grid.values[..., 0].masked_fill_(~self.solid, NOTHING)
            self.field.grid.update_occupied()


def _followed(start: Panoptic, frames: Sequence[PosedFrame], rays: FrameRays) -> tuple[tuple[BoxConfig, ...], int]:
    """The boxes without those that move and that no frame shows at their times, and how many those are."""
    _, shown = shown_boxes(start.moving, frames, rays)
    lost = {box.id for box, count in zip(start.moving.primitives, shown, strict=True) if not count}
    if lost:
        _log.warning("moving_boxes_left_out", count=len(lost), reason="no frame shows them at their times")
    return tuple(box for box in start.shape.boxes if box.id not in lost), len(lost)


def _some_pixels(data: PseudoRays, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, len(data.rays), SURVEYED)
