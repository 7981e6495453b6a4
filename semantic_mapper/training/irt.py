"""Fit an Implicit Ray-Transformer to one scene: geometry and colours of all frames, then classes of the labelled ones.

Steps draw pixels of all labelled frames at once. The texture of a pixel depends on the patch round it alone, so that a
step looks at patches, not at whole images.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.config import IRTConfig
from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.fields.scene.grid import RaySamples
from semantic_mapper.fields.scene.irt import IRT, RayTexture, at_measured, no_texture, surface
from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.fit import (
    Budget,
    FitTask,
    Fitted,
    HeldOut,
    State,
    cosine_rate,
    descend,
    fit,
    held_out_blocks,
)
from semantic_mapper.training.grid_fit import fit_geometry, fit_trunk, grid_figures, surface_depth, trunk_steps
from semantic_mapper.training.losses import IGNORE, RAREST, semantic_loss
from semantic_mapper.training.views import FrameRays, frame_rays, jittered, pixel_channels
from semantic_mapper.types import PosedFrame

RAYS = 512  # a step
BALANCED = 0.5  # of them with all classes equally likely
GRID_UNTIL, TRUNK_UNTIL = 0.35, 0.5  # fractions of the time for geometry and colours, then for features
LEARNING_RATE, FINAL_RATE, WEIGHT_DECAY = 2e-3, 1e-4, 1e-4
CLASS_BALANCE = 0.25  # a class counts by its fraction of the pixels to the power of minus this
IMAGE_DROPPED = 0.2  # fraction of rays without the texture of their pixel
DEPTH_USED = 0.7  # fraction of steps in which measured depth says where a ray ends
LABELS_DROPPED = 0.5  # of the other frames' labels at most, drawn in every step
IMAGE_LOSS = 1.0  # weight of what the texture says by itself
COLOUR_JITTER = 0.25
LOOK_RAYS = 4096


@dataclass(frozen=True, slots=True, eq=False)
class LabelledRays:
    """All pixels of the labelled frames, F of one size."""

    rays: FrameRays  # of the frames
    rgb: torch.Tensor  # (F, 3, H + 2 margin, W + 2 margin) uint8, continued beyond the edges
    channel: torch.Tensor  # (F H W,) int64, -1 = not labelled
    held_out: torch.Tensor  # (F H W,) bool

    def patches(self, pixels: torch.Tensor, side: int) -> torch.Tensor:
        """Colours (R, 3, side, side) in [0, 1] round pixels (R,)."""
        height, width = self.rays.image_size(0)
        margin = (self.rgb.shape[2] - height) // 2
        frame, place = pixels // (height * width), pixels % (height * width)
        steps = torch.arange(side) + margin - side // 2
        row = (place // width)[:, None, None] + steps[None, :, None]
        column = (place % width)[:, None, None] + steps[None, None, :]
        return self.rgb[frame[:, None, None], :, row, column].permute(0, 3, 1, 2).float() / 255


def fit_irt(task: FitTask) -> Fitted:
    """Fit an ``IRT``: geometry and texture from all frames, classes from those with labels. ``budget.steps``, if not 0,
    are those of each of its three parts. Raises FrameError: no labelled frame, one class only, or what ``fit_grid``
    refuses. WeightsError: ``start`` has other classes."""
    start, config, budget, labelled = task.start, task.config, task.budget, task.labelled
    if start is not None and start.label_set != task.label_set:
        raise WeightsError(
            f"the weights have label set '{start.label_set.name}', the labels '{task.label_set.name}'; fit without them"
        )
    rays = labelled_rays(labelled, task.label_set, config)
    shape = start.shape if isinstance(start, IRT) else IRTConfig()
    shape = msgspec.structs.replace(
        shape,
        variant=config.irt.variant or shape.variant,
        carried=len(labelled) if config.irt.carry_labels else 0,
        carried_size=rays.rays.image_size(0),
    )
    known = start if isinstance(start, IRT) else None
    field, geometry = fit_geometry(task._replace(start=known), shape, IRT.kind, GRID_UNTIL)
    assert isinstance(field, IRT)
    fit_trunk(field, geometry, config, budget.part(TRUNK_UNTIL, steps=trunk_steps(config)))
    held_out, steps = ClassFit(field, rays, config).run(budget.part(1.0))
    figures = grid_figures(geometry) | {"grid_steps": geometry.steps} | held_out.figures(steps)
    return Fitted(field, figures, labelled)


def labelled_rays(frames: Sequence[PosedFrame], label_set: LabelSet, config: FinetuneConfig) -> LabelledRays:
    """The pixels of labelled frames, some of them held out.
    Raises FrameError: no labelled frame, frames of several sizes, or fewer than two classes."""
    if not frames:
        raise FrameError("no frame has a label and a usable pose; give labelled keyframes (--keyframes)")
    rays = frame_rays(frames, config.width)
    if len({(k.width, k.height) for k in rays.intrinsics}) > 1:
        raise FrameError("labelled frames have several sizes; give those of one camera")
    flat = pixel_channels(frames, rays, label_set)
    if len(flat[flat >= 0].unique()) < 2:
        raise FrameError("the labelled frames show fewer than two classes; there is nothing to tell apart")
    height, width = rays.image_size(0)
    generator = torch.Generator().manual_seed(config.seed)
    masks = [held_out_blocks(height, width, config.held_out_fraction, generator).flatten() for _ in frames]
    rgb = torch.from_numpy(rays.rgb.reshape(len(frames), height, width, 3)).permute(0, 3, 1, 2)
    margin = 3
    padded = functional.pad(rgb.float(), (margin,) * 4, mode="replicate").to(torch.uint8)
    return LabelledRays(rays, padded, flat, torch.cat(masks) & (flat >= 0))


class ClassFit:
    """The second part of a fit: what reads classes learns, all else stays as it is."""

    def __init__(self, field: IRT, data: LabelledRays, config: FinetuneConfig) -> None:
        self.field, self.data, self.config = field, data, config
        self.generator = torch.Generator().manual_seed(config.seed)
        for frozen in (field.grid, field.trunk):
            assert frozen is not None
            frozen.requires_grad_(False)
        self.learned = {n: p for n, p in field.named_parameters() if p.requires_grad}
        self.optimiser = torch.optim.AdamW(self.learned.values(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        train = (data.channel >= 0) & ~data.held_out
        self.taught = torch.where(train, data.channel, IGNORE)
        self.pool = _BalancedPixels(self.taught, len(field.label_set))
        self.looked_at = data.held_out.nonzero()[:, 0]
        if len(self.looked_at) > LOOK_RAYS:
            order = torch.randperm(len(self.looked_at), generator=self.generator)
            self.looked_at = self.looked_at[order[:LOOK_RAYS].sort().values]

    def run(self, budget: Budget) -> tuple[HeldOut, int]:
        """Learn until the budget is used; the field then has the weights that were best on what was held out.
        Returns these weights, and the number of steps."""

        def state() -> State:
            return {name: p.detach().clone() for name, p in self.learned.items()}

        held_out, steps = HeldOut(self._look, state, best=state()), 0
        if not budget.stopped():
            carry_labels(self.field, self.data.rays, self.taught, self.config.grid.near_m)
            steps = fit(self._learn, budget, held_out)
            self.field.load_state_dict(held_out.best, strict=False)
            carry_labels(self.field, self.data.rays, self.data.channel, self.config.grid.near_m)
        return held_out, steps

    def _learn(self, fraction: float) -> float:
        """One step, at a fraction of the budget."""
        for group in self.optimiser.param_groups:
            group["lr"] = cosine_rate(fraction, LEARNING_RATE, FINAL_RATE)
        pixels, weight = self.pool.draw(RAYS, self.generator)
        channel = self.data.channel[pixels]
        with_depth = float(torch.rand(1, generator=self.generator)) < DEPTH_USED
        jitter = torch.rand(len(pixels), generator=self.generator)
        samples = self._samples(pixels, with_depth=with_depth, jitter=jitter)
        texture = self._texture(pixels, samples, learning=True)
        dropped = LABELS_DROPPED * torch.rand(1, generator=self.generator)
        kept = torch.rand(len(self.data.rays.intrinsics), generator=self.generator) >= dropped
        logits = self.field.logits(samples, texture, self._carried(pixels, samples, kept))
        loss = semantic_loss(logits, channel, weight)
        if self.field.image_head is not None and bool(texture.there.any()):
            by_image = self.field.image_head(texture.values[texture.there])
            loss = loss + IMAGE_LOSS * semantic_loss(by_image, channel[texture.there], weight[texture.there])
        return descend(self.optimiser, loss)

    def _look(self) -> tuple[float, float]:
        """Loss and accuracy of what was held out, as a consumer with the frame's own image sees it."""
        losses: list[float] = []
        right = 0
        everything = torch.ones(len(self.data.rays.intrinsics), dtype=torch.bool)
        self.field.eval()
        with torch.no_grad():
            for pixels in self.looked_at.split(1024):
                samples = self._samples(pixels, with_depth=True)
                texture = self._texture(pixels, samples, learning=False)
                logits = self.field.logits(samples, texture, self._carried(pixels, samples, everything))
                channel = self.data.channel[pixels]
                losses.append(float(functional.cross_entropy(logits, channel, reduction="sum")))
                right += int((logits.argmax(1) == channel).sum())
        self.field.train()
        count = len(self.looked_at)
        return (sum(losses) / count, right / count) if count else (math.inf, math.nan)

    def _samples(self, pixels: torch.Tensor, *, with_depth: bool, jitter: torch.Tensor | None = None) -> RaySamples:
        rays = self.data.rays.rays(pixels.numpy(), self.config.grid.near_m)
        if with_depth:
            rays = replace(rays, prior_depth_m=torch.from_numpy(self.data.rays.depth_m[pixels.numpy()]))
        with torch.no_grad():
            return at_measured(self.field.march(rays, jitter=jitter), self.field.config.grid)

    def _texture(self, pixels: torch.Tensor, samples: RaySamples, *, learning: bool) -> RayTexture:
        net = self.field.texture
        if net is None:
            return no_texture(samples.rays)
        patches = self.data.patches(pixels, 2 * net.margin + 1)
        there = torch.ones(len(pixels), dtype=torch.bool)
        if learning:
            patches = jittered(patches, COLOUR_JITTER, self.generator)
            there = torch.rand(len(pixels), generator=self.generator) >= IMAGE_DROPPED
        return RayTexture(net.of_patches(patches) * there[:, None], there)

    def _carried(self, pixels: torch.Tensor, samples: RaySamples, kept: torch.Tensor) -> torch.Tensor | None:
        """Labels of the other frames: a query's own are not known."""
        if self.field.carried is None:
            return None
        own = torch.from_numpy(self.data.rays.frame_of(pixels.numpy()))
        counted = kept[None] & (own[:, None] != torch.arange(len(kept)))
        with torch.no_grad():
            return self.field.carried(surface(samples), counted.float())


class _BalancedPixels:
    """Pixels to draw: partly as they come, partly with every class equally likely.

    The weight of a drawn ray takes that back, and makes rare classes count somewhat more.
    """

    def __init__(self, channel: torch.Tensor, classes: int) -> None:
        self.labelled = (channel >= 0).nonzero()[:, 0]
        if len(self.labelled) == 0:
            raise FrameError("no labelled pixel is left to learn from; lower held_out_fraction or label more")
        counts = torch.bincount(channel[self.labelled], minlength=classes)
        self.by_class = self.labelled[channel[self.labelled].argsort(stable=True)]
        self.present = counts.nonzero()[:, 0]
        self.first, self.counts = counts.cumsum(0) - counts, counts
        fraction = counts / counts.sum()
        drawn = (1 - BALANCED) * fraction + BALANCED * (counts > 0) / len(self.present)
        wanted = fraction * (fraction + RAREST) ** -CLASS_BALANCE
        self.weight = wanted / drawn.clamp_min(1e-9)
        self.channel = channel

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Pixels (count,) and what each counts."""
        balanced = int(BALANCED * count)
        uniform = self.labelled[torch.randint(len(self.labelled), (count - balanced,), generator=generator)]
        of = self.present[torch.randint(len(self.present), (balanced,), generator=generator)]
        place = (torch.rand(balanced, generator=generator) * self.counts[of]).long().clamp_max(self.counts[of] - 1)
        pixels = torch.cat((uniform, self.by_class[self.first[of] + place]))
        return pixels, self.weight[self.channel[pixels]]


def carry_labels(field: IRT, rays: FrameRays, channel: torch.Tensor, near_m: float) -> None:
    """Give a field the labels (F H W,) of frames, with their depth: measured, else rendered from ``near_m`` on."""
    carried = field.carried
    if carried is None:
        return
    size = rays.image_size(0)
    for i, k in enumerate(rays.intrinsics):
        pixels = rays.pixels_of(i)
        depth = torch.from_numpy(rays.depth_m[pixels])
        blank = (depth == 0).nonzero()[:, 0]
        for part in blank.split(4096):
            depth[part] = surface_depth(field, rays, pixels[part.numpy()], near_m)
        carried.depth_m[i] = depth.view(size)
        carried.channel[i] = channel[torch.from_numpy(pixels)].view(size).to(torch.int16)
        carried.K[i] = torch.from_numpy(camera_matrix(k))
        carried.T_camera_world[i] = torch.from_numpy(invert_pose(rays.T_world_camera[i].astype(np.float64)))
