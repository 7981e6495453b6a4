"""Fit a Panoptic NeRF to one scene: geometry first, then density, colours and classes together, guided by boxes."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.config import BoxConfig
from semantic_mapper.errors import ConfigError, FrameError, WeightsError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import NOTHING, RaySamples, ray_fraction
from semantic_mapper.fields.scene.march import adam_grid
from semantic_mapper.fields.scene.panoptic import BoxesOnRays, Panoptic, merged_classes
from semantic_mapper.imaging import resize_label
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.boxes import fill_boxes, nothing_in_view, shown_boxes
from semantic_mapper.training.config import FinetuneConfig, PanopticFitConfig
from semantic_mapper.training.fit import Budget, Fitted, descend, fit
from semantic_mapper.training.frame_rays import FrameRays, frame_rays
from semantic_mapper.training.grid_fit import BETA1, BETA2, fit_geometry, grid_figures, trunk_optimiser, view_fraction
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
        boxes, seen: How many stand still, and how many of these any surveyed ray meets.
        covered: Fraction of pixels whose ray meets a box.
        matched: Fraction of pixels with a pseudo label whose class is possible on their ray.
    """

    boxes: int
    seen: int
    covered: float
    matched: float


def fit_panoptic(
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    budget: Budget,
) -> Fitted:
    """Fit a ``Panoptic``; stopped before its classes are learned, these are those of the boxes alone.

    Args:
        frames: With poses; their label images are the pseudo labels.
        label_set: Of these and of the boxes.
        start: A ``Panoptic`` with the boxes; its weights are not looked at. Without boxes pseudo labels alone teach,
            where ``config`` leaves out the losses that need some.
        budget: ``steps``, if not 0, is the number of steps of each of its two parts.

    Raises:
        ConfigError: no boxes, none of them in view, or no class in common with the pseudo labels.
        FrameError: no pseudo label, or what ``fit_grid`` refuses.
        WeightsError: ``start`` has other classes.
    """
    by_boxes = config.panoptic.fixed > 0 or config.panoptic.points > 0
    if not isinstance(start, Panoptic) or (by_boxes and not start.shape.boxes):
        raise ConfigError("a field of kind 'panoptic' needs boxes; give a file of them (--boxes)")
    if start.label_set != label_set:
        raise WeightsError(f"the boxes are of label set '{start.label_set.name}', the labels of '{label_set.name}'")
    frames = held_out_unlabelled(frames, config.grid.held_out)
    everything = pseudo_rays(frames, label_set, config.width)
    boxes, lost = _followed(start, frames, everything.rays)
    if by_boxes and not boxes:
        raise ConfigError(
            f"no box is in view of any frame: {lost} move, and no frame shows them at the times of their stamps. Are "
            "the stamps the log's, in nanoseconds?"
        )
    survey = survey_boxes(start, everything, config)

    def shows_movers(seen: Sequence[PosedFrame], rays: FrameRays) -> Bool:
        return shown_boxes(start.moving, seen, rays)[0]

    field, grid = fit_geometry(
        frames,
        label_set,
        start,
        msgspec.structs.replace(start.shape, boxes=boxes),
        Panoptic.kind,
        config,
        budget.part(GRID_UNTIL, steps=config.steps or config.grid.steps),
        shows_movers if len(start.moving) else None,
    )
    assert isinstance(field, Panoptic)
    data = pseudo_rays(grid.frames, label_set, config.width)
    still = np.flatnonzero(~shows_movers(grid.frames, data.rays))
    data = replace(data, gain=torch.from_numpy(grid.gains), still=still)
    steps = JointFit(field, data, config).run(budget.part(1.0))
    if steps < LEARNED and budget.stopped():
        field.shape = field.config = msgspec.structs.replace(field.shape, classes="fixed")
    fill_boxes(field, grid.frames, data.rays, grid.gains, config.grid.near_m)
    found = {
        "boxes": survey.boxes,
        "seen": survey.seen,
        "covered": round(survey.covered, 4),
        "matched": round(survey.matched, 4),
        "moving": len(start.moving) - lost,
        "lost": lost,
        "labelled_frames": sum(f.label is not None for f in frames),
        "frames": len(frames),
    }
    figures = grid_figures(grid) | {"grid_steps": grid.steps, "steps": steps, "panoptic": found}
    return Fitted(field, figures, [f for f in frames if f.label is not None and not f.label_is_pseudo])


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
    if matched < FEW_MATCHED:
        _log.warning(
            "few_labels_match", matched=round(matched, 4), reason="most name a class that no box on their ray has"
        )
    return Survey(len(field.primitives), len(found.index[found.index >= 0].unique()), covered, matched)


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
        self.optimiser = trunk_optimiser(field.trunk, field.head, field.classifier)
        self.rates = [group["lr"] for group in self.optimiser.param_groups]
        field.grid.values.requires_grad_(True)
        values = field.grid.values.detach().numpy()
        self.first, self.second = np.zeros_like(values), np.zeros_like(values)
        self.rate = view_fraction(data.rays, field.grid.config, config.grid.near_m)
        self.solid = field.solid() if field.shape.uncovered == "empty" else None
        self.step = 0
        self._empty_cells()

    def run(self, budget: Budget) -> int:
        """Learn until the budget is used; returns the number of steps."""
        steps = fit(self.learn, budget)
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
        loss = functional.mse_loss(gain * colour, self.data.rays.colours(pixels))
        loss = loss + DEPTH * self._depth_loss(samples, share, pixels)
        channel = self.data.channel[torch.from_numpy(pixels)]
        boxes = field.boxes_on(samples)
        learned = field.learned(samples, r)
        semantics = semantic_losses(field, samples, boxes, learned, channel, self.group, config.panoptic)
        loss = loss + SEMANTICS * semantics
        field.grid.values.grad = None
        total = descend(self.optimiser, loss)
        self._step_density(DENSITY_RATE * left)
        return total

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
