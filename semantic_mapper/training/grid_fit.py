"""Fit a scene grid to posed images, and the fields that stand on one: coarse to fine, from depth if there is some.

A field of one scene is fitted in stages: geometry and colours for every kind (``fit_geometry``), features where it has
some (``fit_trunk``), then what is its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import torch
from torch import nn

from semantic_mapper.config import GridConfig, GridFieldConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.learned import build_field
from semantic_mapper.fields.scene import march
from semantic_mapper.fields.scene.grid import (
    HAZE,
    NOTHING,
    OPAQUE,
    GridField,
    SceneGrid,
    Trunk,
    at_resolution,
    ray_fraction,
    sky_texels,
)
from semantic_mapper.geometry import invert_pose
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.fit import Budget, FitTask, Fitted, descend, fit
from semantic_mapper.training.scene_box import check_parallax, scene_box
from semantic_mapper.training.views import FrameRays, frame_rays
from semantic_mapper.types import Bool, Float32, Float64, Int64, PosedFrame

BETA1, BETA2 = 0.9, 0.99
LEARNING_RATE, FINAL_FRACTION = 0.2, 0.3  # of density and colour at the start, and what is left of it in the end
SKY_RATE, GAIN_RATE = 0.02, 2e-3
DENSITY_VARIATION, COLOUR_VARIATION = 1e-5, 1e-6  # weights of the total variation, a ray
OPACITY = 1e-2  # weight of what stops light, of scenes with depth
PRUNE_EVERY = 200  # steps
WARM_UP = 200  # steps before anything is pruned
COARSE = ((0.0, 3), (0.3, 1.5), (0.6, 1))  # fraction of the steps, and how much coarser the grid is until the next
MIN_FRAMES = 2
PSNR_VIEWS = 4  # of those that are held out, evenly spread: rendering costs as much as hundreds of steps
MIN_GAIN_DB = 1.0  # over the mean colour; the sky's colours alone, with poses that mean nothing, gain half of it
TRUNCATION = 3.0  # voxels
BETA = 0.5  # voxels: spread of the Laplace distribution that turns distance into density
TRUNK_RAYS, TRUNK_SAMPLES, TRUNK_STEPS = 1024, 8, 600
FEATURE_RATE, TRUNK_RATE = 2e-2, 2e-3
GRID_UNTIL = 0.6  # fraction of the time, where features are fitted to the grid afterwards


LeaveOut = Callable[[Sequence[PosedFrame], FrameRays], Bool]  # pixels (P,) that show something else than the scene


@dataclass(frozen=True, slots=True, eq=False)
class GridFit:
    """A fitted grid."""

    grid: SceneGrid
    steps: int
    # Of held-out frames in dB, each with the gain that fits it best if exposure was fitted; NaN where none were
    # rendered: none held out, or stopped
    psnr: float
    frames: tuple[PosedFrame, ...]  # f frames that it was fitted to for ``steps`` steps
    gains: Float32  # (F, 3) their exposure


def fit_grid(
    frames: Sequence[PosedFrame],
    config: FinetuneConfig,
    budget: Budget | None = None,
    box: GridConfig | None = None,
    leave_out: LeaveOut | None = None,
) -> GridFit:
    """Fit a grid to posed images of a scene that stands still, with rigid poses; sizes and cameras may differ.
    ``budget``: None = that of ``config``; without steps those of ``config.grid``. ``box``: instead of the one that
    ``config`` describes. Raises FrameError: too few frames, poses that only turn, or held-out views rendered hardly
    better than by their mean colour. ConfigError: a box that cannot be."""
    budget = budget or Budget(config.seconds, config.steps or config.grid.steps)
    every = config.grid.held_out
    held_out = frames[every - 1 :: every] if every else []
    seen = [f for i, f in enumerate(frames) if not every or (i + 1) % every]
    if len(seen) < MIN_FRAMES:
        raise FrameError(f"a grid needs at least {MIN_FRAMES} frames to fit besides held-out ones, got {len(seen)}")
    box = box or scene_box(frames, config.grid)
    check_parallax(frames, box)
    rays = frame_rays(seen, config.width)
    fitter = _Fitter(rays, box, config, None if leave_out is None else leave_out(seen, rays))
    steps = fit(fitter.learn, budget)
    complete = budget.used(steps) >= 1
    grid = fitter.finish()
    shown = [] if budget.stopped() else held_out[:: -(-len(held_out) // PSNR_VIEWS) or 1]
    psnr, mean_psnr = held_out_psnr(grid, shown, config)
    if psnr < mean_psnr + MIN_GAIN_DB and complete:
        raise FrameError(
            f"held-out views are rendered with {psnr:.1f} dB, hardly better than by their mean colour "
            f"({mean_psnr:.1f} dB): {steps} steps are too few, the box does not hold what is seen, or poses are not "
            "T_world_camera in metres, camera axes x right, y down, z forward"
        )
    return GridFit(grid, steps, psnr, tuple(seen), np.exp(fitter.log_gain).astype(np.float32))


def grid_of_depth(rays: FrameRays, config: GridConfig, unseen: float = HAZE) -> SceneGrid:
    """A grid whose density is that of the measured surface: Laplace-CDF(-distance) / beta, of the distance in voxels,
    positive before the surface. What was not observed has the raw density ``unseen``; colours are grey."""
    distance, weight = np.zeros(config.shape, np.float32), np.zeros(config.shape, np.float32)
    T_world_grid = np.diag((config.voxel_m, config.voxel_m, config.voxel_m, 1.0))
    T_world_grid[:3, 3] = config.origin_m
    for i, k in enumerate(rays.intrinsics):
        depth = rays.depth_m[rays.pixels_of(i)].reshape(rays.image_size(i))
        T_camera_grid = invert_pose(rays.T_world_camera[i].astype(np.float64)) @ T_world_grid
        arrays = (distance, weight, depth, np.ascontiguousarray(T_camera_grid[:3]))
        march.fuse_grid_depth(len(distance), *arrays, k.fx, k.fy, k.cx, k.cy, TRUNCATION * config.voxel_m)
    distance *= np.float32(TRUNCATION)
    grid = SceneGrid(config)
    density = np.where(distance > 0, 0.5 * np.exp(-np.abs(distance) / BETA), 1 - 0.5 * np.exp(-np.abs(distance) / BETA))
    per_voxel = density / BETA
    raw = np.log(np.expm1(np.maximum(per_voxel, 1e-9))) - march.BIAS
    values = np.where(weight > 0, np.maximum(raw, NOTHING), unseen).astype(np.float32)
    with torch.no_grad():
        grid.values[..., 0] = torch.from_numpy(values)
    grid.update_occupied()
    return grid


def render_frame(grid: SceneGrid, rays: FrameRays, frame: int, near_m: float) -> tuple[Float32, Float32]:
    """Colour (H, W, 3) in [0, 1] and z (H, W) in metres of a frame, 0 where less than half of the light is stopped."""
    with torch.no_grad():
        batch = rays.rays(rays.pixels_of(frame), near_m)
        samples = grid.march(batch)
        weight = samples.weight / samples.weight.sum(1, keepdim=True).clamp_min(1e-6)
        colour = (weight[..., None] * grid.colour(samples.points)).sum(1) * samples.opacity[:, None]
        colour += samples.light[:, None] * grid.sky_colour(batch.direction)
        depth = (weight * samples.z).sum(1) * (samples.light < 0.5)
    size = rays.image_size(frame)
    return colour.numpy().reshape(*size, 3), depth.numpy().reshape(size)


def held_out_psnr(grid: SceneGrid, frames: Sequence[PosedFrame], config: FinetuneConfig) -> tuple[float, float]:
    """PSNR in dB of frames that were not fitted to, and that of images of their mean colour; NaN without frames."""
    if not frames:
        return math.nan, math.nan
    rays = frame_rays(frames, config.width)
    errors, plain = [], []
    for i in range(len(frames)):
        colour, _ = render_frame(grid, rays, i, config.grid.near_m)
        truth = rays.rgb[rays.pixels_of(i)].reshape(colour.shape) / np.float32(255)
        if config.grid.exposure:
            colour = colour * ((colour * truth).sum((0, 1)) / np.maximum((colour * colour).sum((0, 1)), 1e-6))
        errors.append(np.square(colour - truth).mean())
        plain.append(np.square(truth.mean((0, 1)) - truth).mean())
    return psnr_of(float(np.mean(errors))), psnr_of(float(np.mean(plain)))


def psnr_of(mean_square: float) -> float:
    """dB of a mean squared error of colours in [0, 1]."""
    return -10 * math.log10(max(mean_square, 1e-10))


class _Fitter:
    """The grid at its present resolution, and the state of Adam."""

    def __init__(self, rays: FrameRays, box: GridConfig, config: FinetuneConfig, left_out: Bool | None) -> None:
        self.pixels = np.arange(len(rays)) if left_out is None else np.flatnonzero(~left_out)
        if left_out is not None:
            rays = replace(rays, depth_m=np.where(left_out, np.float32(0), rays.depth_m))
        self.rays, self.box, self.config = rays, box, config.grid
        self.rng = np.random.default_rng(config.seed)
        self.order = np.zeros(0, np.int64)
        self.log_gain = np.zeros((len(rays.intrinsics), 3))
        measured = bool((rays.depth_m > 0).any())
        opacity = self.config.opacity
        self.loss = march.LossWeights(opacity=(OPACITY if measured else 0.0) if opacity is None else opacity)
        # A start from depth has nothing to gain from coarse grids.
        self.stages = COARSE[-1:] if measured else COARSE
        self.stage, self.steps = 0, 0
        first = at_resolution(box, self._long_side(0))
        self.grid = grid_of_depth(rays, first) if measured else SceneGrid(first)
        self.gain_adam, self.sky_adam = _Adam(self.log_gain.shape), _Adam(tuple(self.grid.sky.shape))
        self._allocate()

    def _long_side(self, stage: int) -> int:
        return max(round(max(self.box.shape) / self.stages[stage][1]), 8)

    def _allocate(self) -> None:
        self.adam = GridAdam(self.grid, self.rays, self.config.near_m)
        self.gradient = np.zeros_like(self.adam.values)
        self.samples = march.SampleLists.empty(self.config.rays, self.gradient.shape, 4)

    def learn(self, fraction: float) -> float:
        """One step of Adam on a batch of rays at a fraction of the budget; returns their mean squared error."""
        step, self.steps = self.steps, self.steps + 1
        if self.stage + 1 < len(self.stages) and fraction >= self.stages[self.stage + 1][0]:
            self.stage += 1
            del self.adam, self.gradient, self.samples  # before larger ones are made
            self.grid = self.grid.resampled(at_resolution(self.box, self._long_side(self.stage)))
            self._allocate()
        elif step >= WARM_UP and step % PRUNE_EVERY == 0:
            self.grid.update_occupied()
        loss = self._rays_backward(self._draw())
        rate, count = LEARNING_RATE * FINAL_FRACTION**fraction, self.config.rays
        variation = (DENSITY_VARIATION / count, COLOUR_VARIATION / count)
        march.add_total_variation(len(self.gradient), self.adam.values, self.gradient, *variation)
        self.adam.step(self.gradient, rate, rate)
        return loss

    def finish(self) -> SceneGrid:
        """The grid, empty where no frame looks."""
        self.adam.values[self.adam.seen == 0] = (NOTHING, 0, 0, 0)
        self.grid.update_occupied()
        return self.grid

    def _draw(self) -> np.ndarray:
        """The next pixels of a random order of all."""
        while len(self.order) < self.config.rays:
            self.order = np.concatenate((self.order, self.rng.permutation(self.pixels)))
        drawn, self.order = np.split(self.order, [self.config.rays])
        return drawn

    def _rays_backward(self, pixels: np.ndarray) -> float:
        """Gradients of everything from one batch; returns its mean squared error."""
        batch, frame = self.rays.rays(pixels, self.config.near_m), self.rays.frame_of(pixels)
        jitter = torch.from_numpy(self.rng.random(len(pixels), np.float32))
        gain = np.exp(self.log_gain[frame]).astype(np.float32)
        behind = self.grid.sky_colour(batch.direction).detach().numpy()
        depth = self.rays.depth_m[pixels]
        inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
        colour = self.rays.rgb[pixels].astype(np.float32) / np.float32(255)
        results = march.RayResults(*(np.empty((len(pixels), 3), np.float32) for _ in range(3)))
        rays = self.grid.ray_arrays(batch, jitter)
        targets = march.TargetArrays(colour, inverse, gain, behind)
        march.photometric_rays(len(pixels), self.grid.arrays(), rays, targets, self.loss, self.samples, results)
        march.scatter_grid(len(self.gradient), self.samples, self.gradient)
        self._step_sky(batch.direction, results.sky_gradient)
        if self.config.exposure:
            gradient = _sums(frame, results.gain_gradient * gain, len(self.log_gain))
            self.log_gain -= GAIN_RATE * self.gain_adam.step(gradient)
            self.log_gain -= self.log_gain.mean(0)
        return float(np.square(results.colour - colour).mean())

    def _step_sky(self, direction: torch.Tensor, gradient: Float32) -> None:
        """One step of the sky, given the gradient (R, 3) by its colour in directions (R, 3)."""
        texel, weight = (t.numpy() for t in sky_texels(direction))
        sky = self.grid.sky.detach().numpy()
        colour = 1 / (1 + np.exp(-sky))
        by_texel = _sums(texel.ravel(), (weight[..., None] * gradient[:, None]).reshape(-1, 3), sky[..., 0].size)
        sky -= SKY_RATE * self.sky_adam.step(by_texel.reshape(sky.shape) * colour * (1 - colour)).astype(np.float32)


class GridAdam:
    """Adam for the values of a grid, each as far as frames look at its vertex; a gradient is 0 after its step."""

    def __init__(self, grid: SceneGrid, rays: FrameRays, near_m: float) -> None:
        self.values = grid.values.detach().numpy()
        self.seen = view_fraction(rays, grid.config, near_m)
        self._first, self._second, self._count = np.zeros_like(self.values), np.zeros_like(self.values), 0

    def step(self, gradient: Float32, density_rate: float, colour_rate: float) -> None:
        """One step down a gradient (X, Y, Z, 4)."""
        self._count += 1
        buffers = (self.values, gradient, self._first, self._second, self.seen)
        corrections = (1 - BETA1**self._count, 1 - BETA2**self._count)
        march.adam_grid(len(self.values), *buffers, density_rate, colour_rate, BETA1, BETA2, *corrections)


class _Adam:
    def __init__(self, shape: tuple[int, ...]) -> None:
        self.first, self.second, self.count = np.zeros(shape), np.zeros(shape), 0

    def step(self, gradient: Float64) -> Float64:
        """What to subtract, times the learning rate."""
        self.count += 1
        self.first = BETA1 * self.first + (1 - BETA1) * gradient
        self.second = BETA2 * self.second + (1 - BETA2) * gradient**2
        root = np.sqrt(self.second / (1 - BETA2**self.count))
        return self.first / (1 - BETA1**self.count) / (root + 1e-15)


def _sums(index: np.ndarray, values: np.ndarray, count: int) -> Float64:
    """Sums (count, 3) of rows of ``values`` (N, 3) by ``index`` (N,)."""
    return np.stack([np.bincount(index, values[:, c], count) for c in range(3)], axis=1).astype(np.float64)


def view_fraction(rays: FrameRays, config: GridConfig, near_m: float) -> Float32:
    """How many frames look at each vertex (X, Y, Z), as a fraction of the most that look at one."""
    count = np.zeros(config.shape, np.float32)
    axes = [np.arange(n) * config.voxel_m + o for n, o in zip(config.shape, config.origin_m, strict=True)]
    for k, T in zip(rays.intrinsics, rays.T_world_camera.astype(np.float64), strict=True):
        # Camera coordinates are a sum of one term an axis.
        terms = [(a[:, None] - T[i, 3]) * T[i, :3] for i, a in enumerate(axes)]
        x, y, z = (
            terms[0][:, None, None, c] + terms[1][None, :, None, c] + terms[2][None, None, :, c] for c in range(3)
        )
        inside = (z > near_m) & (np.abs(k.fx * x + (k.cx - k.width / 2 + 0.5) * z) <= k.width / 2 * z)
        count += inside & (np.abs(k.fy * y + (k.cy - k.height / 2 + 0.5) * z) <= k.height / 2 * z)
    return count / max(float(count.max()), 1.0)


def fit_geometry(
    task: FitTask, shape: GridFieldConfig, kind: str, until: float, leave_out: LeaveOut | None = None
) -> tuple[GridField, GridFit]:
    """A field of a kind that stands on a grid, which shows the frames, within a fraction of the budget.

    ``shape`` is the config of the kind, but for the box: that is the one of ``task.start`` if it is fitted, unless
    ``config.grid`` names one. Raises what ``fit_grid`` raises."""
    start, config = task.start, task.config
    part = task.budget.part(until, steps=config.steps or config.grid.steps)
    box = start.config.grid if isinstance(start, GridField) and start.fitted and config.grid.box_m is None else None
    found = fit_grid(task.frames, config, part, box, leave_out)
    torch.manual_seed(config.seed)  # of what the kind draws
    field = build_field(kind, msgspec.structs.replace(shape, grid=found.grid.config), task.label_set)
    assert isinstance(field, GridField)
    field.grid = found.grid
    field.fitted_steps += found.steps
    return field, found


def fit_scene(task: FitTask) -> Fitted:
    """Fit a plain ``GridField``: geometry and colour, no classes."""
    shape = task.start.config if isinstance(task.start, GridField) else GridFieldConfig()
    field, geometry = fit_geometry(task, shape, GridField.kind, GRID_UNTIL if shape.features else 1.0)
    if field.trunk is not None:
        fit_trunk(field, geometry, task.config, task.budget.part(1.0, steps=trunk_steps(task.config)))
    return Fitted(field, grid_figures(geometry))


def surface_depth(field: GridField, rays: FrameRays, pixels: Int64, near_m: float) -> torch.Tensor:
    """z (R,) of what pixels (R,) see, 0 where that is nothing."""
    with torch.no_grad():
        samples = field.march(rays.rays(pixels, near_m))
    return torch.where(samples.opacity > OPAQUE, samples.depth_m, 0.0)


def grid_figures(geometry: GridFit) -> dict[str, Any]:
    """What a recipe says of a grid."""
    return {"steps": geometry.steps, "psnr": None if math.isnan(geometry.psnr) else round(geometry.psnr, 2)}


def trunk_steps(config: FinetuneConfig) -> int:
    """Steps of ``fit_trunk``."""
    return min(config.steps or TRUNK_STEPS, TRUNK_STEPS)


def trunk_optimiser(trunk: Trunk, *others: nn.Module) -> torch.optim.Adam:
    """Adam for features, and for the networks that read them."""
    networks = [p for name, p in trunk.named_parameters() if name != "features"]
    networks += [p for module in others for p in module.parameters()]
    groups = [{"params": [trunk.features], "lr": FEATURE_RATE}, {"params": networks, "lr": TRUNK_RATE}]
    return torch.optim.Adam(groups, fused=True)  # without temporaries as large as the features


def fit_trunk(field: GridField, geometry: GridFit, config: FinetuneConfig, budget: Budget) -> float:
    """Fit features, trunk and colour head to the frames of a grid's fit; the geometry stays.
    Returns the PSNR of the last steps' rays in dB."""
    assert field.trunk is not None
    rng = np.random.default_rng(config.seed)
    rays = frame_rays(geometry.frames, config.width)
    optimiser = trunk_optimiser(field.trunk)
    errors: list[float] = []

    def learn(fraction: float) -> float:
        pixels = rng.integers(0, len(rays), TRUNK_RAYS)
        batch = rays.rays(pixels, config.grid.near_m)
        with torch.no_grad():
            samples = field.march(batch, TRUNK_SAMPLES, torch.from_numpy(rng.random(len(pixels), np.float32)))
            behind = field.grid.sky_colour(batch.direction) * samples.light[:, None]
            weight = ray_fraction(samples)
        gain = torch.from_numpy(geometry.gains[rays.frame_of(pixels)])
        seen = gain * ((weight[..., None] * field.colour(samples)).sum(1) + behind)
        errors.append(descend(optimiser, nn.functional.mse_loss(seen, rays.colours(pixels))))
        return errors[-1]

    fit(learn, budget)
    return psnr_of(float(np.mean(errors[-50:]))) if errors else math.nan
