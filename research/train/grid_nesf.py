"""Train NeSF on fitted densities of many scenes and label images of them; nothing else says a class."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from research.peers.grid_nesf import (
    MIN_WEIGHT,
    GridNesf,
    GridNesfConfig,
    Placement,
    density_cells,
    smooth_opacity,
)
from semantic_mapper.config import AtLeastOne, AtLeastZero, Config, Fraction, NotNegative, Positive
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.views import FrameRays, frame_rays
from semantic_mapper.types import Float32, PosedFrame, UInt8


class GridNesfTraining(Config, frozen=True):
    """How the network is trained; a step sees one scene."""

    network: GridNesfConfig = GridNesfConfig()
    steps: AtLeastOne = 2400
    rays: AtLeastOne = 384
    balanced: Fraction = 0.5  # of the rays: of a class that is drawn first; the others are of any pixel
    first_rate: Positive = 6e-3
    last_rate: Positive = 1e-4  # along half a cosine
    rotate: bool = True  # by any angle about z
    smoothness: AtLeastZero = 0.1  # weight of the squared distance of probabilities
    smooth_points: AtLeastOne = 256
    smooth_sigma: Positive = 0.05  # of half a side of the box
    near_m: AtLeastZero = 1.0
    seed: NotNegative = 0


class Samples(NamedTuple):
    """N samples on rays: points (N, 3) in the world, weights (N,) and the number (N,) of the ray."""

    xyz: torch.Tensor
    weight: torch.Tensor
    ray: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class LabelledScene:
    """A density with the P pixels of its label images that have a class.

    Args:
        grid: The density.
        opacity: From ``smooth_opacity``.
        samples: On the rays of all pixels, in their order.
        first: (P + 1,) number of each pixel's first sample.
        channel: (P,) int64 class of a pixel.
        by_class: Pixels of each class that there is.
    """

    grid: SceneGrid
    opacity: torch.Tensor
    samples: Samples
    first: NDArray[np.int64]
    channel: torch.Tensor
    by_class: tuple[NDArray[np.int64], ...]

    def draw(self, count: int, balanced: float, rng: np.random.Generator) -> NDArray[np.int64]:
        """Pixels (count,): a fraction of them of a class that is drawn first, the others any."""
        pick = rng.integers(len(self.channel), size=count)
        for n in range(round(balanced * count)):
            there = self.by_class[n % len(self.by_class)]
            pick[n] = there[rng.integers(len(there))]
        return pick

    def frequencies(self, count: int, balanced: float) -> NDArray[np.float64]:
        """(count,) of the classes among rays that ``draw`` gives."""
        of_all, equal = np.zeros(count), np.zeros(count)
        for pixels in self.by_class:
            channel = int(self.channel[pixels[0]])
            of_all[channel], equal[channel] = len(pixels) / len(self.channel), 1 / len(self.by_class)
        return (1 - balanced) * of_all + balanced * equal

    def on_rays(self, pixels: NDArray[np.int64]) -> Samples:
        """The samples of pixels (R,); their rays count from 0 in the order of ``pixels``."""
        start, counts = self.first[pixels], self.first[pixels + 1] - self.first[pixels]
        ray = np.repeat(np.arange(len(pixels)), counts)
        rows = torch.from_numpy(np.arange(len(ray)) + (start - (counts.cumsum() - counts))[ray])
        return Samples(self.samples.xyz[rows], self.samples.weight[rows], torch.from_numpy(ray))


def labelled_scene(
    grid: SceneGrid, frames: Sequence[PosedFrame], label_set: LabelSet, config: GridNesfTraining
) -> LabelledScene:
    """A scene to train on. Raises FrameError: no frame has a label."""
    frames = [f for f in frames if f.label is not None]
    channel = np.concatenate([label_set.to_channels(f.label).ravel() for f in frames if f.label is not None] or [[]])
    pixels = np.flatnonzero(channel >= 0)
    if not len(pixels):
        raise FrameError("no frame of the scene has a labelled pixel")
    rays = frame_rays(frames, max(f.intrinsics.width for f in frames))
    if len(rays) != len(channel):
        raise FrameError("labelled frames of one scene must have the same size")
    return _labelled(grid, marched(grid, rays, pixels, config.near_m), channel[pixels].astype(np.int64), config)


def labelled_points(
    grid: SceneGrid, xyz: Float32, channel: NDArray[np.int64], config: GridNesfTraining
) -> LabelledScene:
    """A scene to train on by points (P, 3) of the world that have a class each, instead of pixels."""
    samples = Samples(torch.from_numpy(xyz), torch.ones(len(xyz)), torch.arange(len(xyz)))
    return _labelled(grid, samples, channel, config)


def _labelled(grid: SceneGrid, samples: Samples, channel: NDArray[np.int64], config: GridNesfTraining) -> LabelledScene:
    first = np.searchsorted(samples.ray.numpy(), np.arange(len(channel) + 1))
    by_class = tuple(np.flatnonzero(channel == c) for c in np.unique(channel))
    opacity = smooth_opacity(grid, config.network.size)
    return LabelledScene(grid, opacity, samples, first, torch.from_numpy(channel), by_class)


def marched(grid: SceneGrid, rays: FrameRays, pixels: NDArray[np.int64], near_m: float) -> Samples:
    """The samples on rays that matter, ray by ray."""
    with torch.no_grad():
        batch = rays.rays(pixels, near_m)
        march = grid.march(batch)
        ray, column = (march.weight > MIN_WEIGHT).nonzero(as_tuple=True)
        z = march.z[ray, column]
        return Samples(batch.origin[ray] + z[:, None] * batch.direction[ray], march.weight[ray, column], ray)


def train_grid_nesf(
    scenes: Sequence[LabelledScene],
    label_set: LabelSet,
    config: GridNesfTraining,
    on_step: Callable[[int, float, GridNesf], None] | None = None,
) -> GridNesf:
    """A network fitted to the label images of scenes.

    Args:
        on_step: Called after each with its number from 1 on, its cross-entropy and the network.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng((config.seed, 21))
    model = GridNesf(label_set, config.network)
    optimiser = torch.optim.Adam(model.parameters(), config.first_rate, fused=True)
    order: list[int] = []
    for step in range(config.steps):
        order = order or [int(n) for n in rng.permutation(len(scenes))]
        for group in optimiser.param_groups:
            group["lr"] = _rate(config, step / config.steps)
        entropy, rough = _losses(model, scenes[order.pop()], config, rng)
        optimiser.zero_grad()
        (entropy + config.smoothness * rough).backward()
        optimiser.step()
        if on_step is not None:
            on_step(step + 1, float(entropy.detach()), model)
    favour_by_frequency(model, scenes, config.balanced)
    return model.eval()


def favour_by_frequency(model: GridNesf, scenes: Sequence[LabelledScene], balanced: float) -> None:
    """Shift logits so that probabilities are those of pixels as they are, not as they were drawn to learn from.

    Rays of solids are drawn more often than they are seen; without the shift, edges of solids spread over the floor.
    """
    classes = len(model.label_set)
    true, drawn = (np.mean([s.frequencies(classes, rate) for s in scenes], axis=0) for rate in (0.0, balanced))
    seen = drawn > 0
    shift = torch.from_numpy(np.where(seen, np.log(np.maximum(true, 1e-9) / np.where(seen, drawn, 1)), 0)).float()
    with torch.no_grad():
        model.head.bias.add_(shift)
        model.nothing.add_(shift)


def _rate(config: GridNesfTraining, fraction: float) -> float:
    high = (1 + math.cos(math.pi * fraction)) / 2
    return config.last_rate + (config.first_rate - config.last_rate) * high


def _losses(
    model: GridNesf, scene: LabelledScene, config: GridNesfTraining, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cross-entropy of a batch of rays, and the squared distance of probabilities at points next to each other."""
    angle = float(rng.uniform(0, 2 * np.pi)) if config.rotate else 0.0
    seen = density_cells(scene.opacity, Placement(scene.grid.config, config.network.size, angle))
    pick = scene.draw(config.rays, config.balanced, rng)
    samples = scene.on_rays(pick)
    count = len(samples.xyz)
    chosen = torch.from_numpy(rng.integers(max(count, 1), size=min(config.smooth_points, count)))
    half_side = torch.tensor([(n - 1) * scene.grid.config.voxel_m / 2 for n in scene.grid.config.shape])
    noise = torch.from_numpy(rng.normal(size=(len(chosen), 3)).astype(np.float32)) * half_side * config.smooth_sigma
    points = torch.cat((samples.xyz, samples.xyz[chosen] + noise))
    logits = model.logits(model.features(seen), seen.near(points))
    rendered = model.composite(logits[:count], samples.weight, samples.ray, config.rays)
    entropy = functional.cross_entropy(rendered, scene.channel[pick])
    here, beside = logits[:count][chosen].softmax(1), logits[count:].softmax(1)
    rough = (here - beside).square().sum(1).mean() if len(chosen) else entropy.new_zeros(())
    return entropy, rough


class SceneLabels:
    """Classes of one scene by a trained network: of pixels and of points.

    Args:
        model: Trained.
        grid: The scene's density.
        near_m: Where rays begin.
    """

    def __init__(self, model: GridNesf, grid: SceneGrid, near_m: float = 1.0) -> None:
        self.model, self.grid, self.near_m = model, grid, near_m
        size = model.config.size
        with torch.inference_mode():
            self.seen = density_cells(smooth_opacity(grid, size), Placement(grid.config, size))
            self.features = model.features(self.seen)

    def frame(self, frame: PosedFrame) -> UInt8:
        """Ids (H, W) of a frame's pixels; only its camera is looked at."""
        rays = frame_rays([frame], frame.intrinsics.width)
        samples = marched(self.grid, rays, rays.pixels_of(0), self.near_m)
        with torch.inference_mode():
            logits = self.model.logits(self.features, self.seen.near(samples.xyz))
            found = self.model.composite(logits, samples.weight, samples.ray, len(rays)).argmax(1).numpy()
        return self.model.label_set.to_ids(found).reshape(rays.image_size(0))

    def points(self, xyz: Float32) -> UInt8:
        """Ids (N,) at points (N, 3) of the world."""
        with torch.inference_mode():
            found = self.model.logits(self.features, self.seen.near(torch.from_numpy(xyz))).argmax(1).numpy()
        return self.model.label_set.to_ids(found)
