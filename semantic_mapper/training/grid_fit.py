"""Fit a scene grid to posed images: coarse to fine, with Adam; started from depth where there is some."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
import torch

from semantic_mapper.config import (
    AtLeastOne,
    AtLeastZero,
    Config,
    Fraction,
    GridConfig,
    Metres,
    NotNegative,
    Positive,
)
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.grid.kernels import (
    LossWeights,
    RayResults,
    SampleLists,
    TargetArrays,
    adam_grid,
    add_total_variation,
    photometric_rays,
    scatter_grid,
)
from semantic_mapper.fields.grid.march import most_samples
from semantic_mapper.fields.grid.scene_grid import NOTHING, SceneGrid, at_resolution, grid_box, sky_texels
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.frame_rays import FrameRays, frame_rays, usable_frames
from semantic_mapper.training.grid_depth import depth_bounds, grid_of_depth, image_bounds
from semantic_mapper.training.schedule import budget_fraction
from semantic_mapper.types import Bool, Float32, Float64, PosedFrame

BETA1, BETA2 = 0.9, 0.99
SKY_RATE, GAIN_RATE = 0.02, 2e-3
PRUNE_EVERY = 200  # steps
WARM_UP = 200  # steps before anything is pruned
COARSE = ((0.0, 3), (0.3, 1.5), (0.6, 1))  # fraction of the steps, and how much coarser the grid is until the next
MIN_PARALLAX = 1e-3  # distance of cameras as a fraction of the box, below which poses only turn
MIN_FRAMES = 2
LONG_SIDE, OPACITY = 96, 1e-2  # of scenes with depth
VOXELS = 2.5e6  # of a grid without depth: its box is flat, or has much air
PSNR_VIEWS = 4  # of those that are held out, evenly spread: rendering costs as much as hundreds of steps
MIN_GAIN_DB = 1.0  # over the mean colour; the sky's colours alone, with poses that mean nothing, gain half of it
_log = get_logger(__name__)


class GridFitConfig(Config, frozen=True):
    """How a scene grid is fitted."""

    steps: AtLeastOne = 1200
    seconds: AtLeastZero = 0.0  # wall-clock bound; 0 = only steps count (then a run repeats bit for bit)
    rays: AtLeastOne = 2048  # a step
    width: AtLeastOne = 320  # working width of the images
    # Vertices along the box's longest side; None = 96, and where no frame has depth as many as make 2.5 M in all
    long_side: Annotated[int, msgspec.Meta(ge=8, le=2048)] | None = None
    voxel_m: Positive | None = None  # sets their distance instead
    # Lower corner, then upper corner of the box in metres of the world; None = what depth reaches; without depth, what
    # matched features show; where these are too few, what the cameras can see up to ``far_m``
    box_m: tuple[float, float, float, float, float, float] | None = None
    near_m: AtLeastZero = 0.1
    far_m: Metres = 8.0
    learning_rate: Positive = 0.2  # of density and colour at the start
    final_rate: Fraction = 0.3  # what is left of it in the end
    density_variation: AtLeastZero = 1e-5  # weight of the total variation, a ray
    colour_variation: AtLeastZero = 1e-6
    point_colour: AtLeastZero = 0.1  # weight of the colour of each sample
    # Weight of what stops light: clears haze of the sky's colour. None = 0.01 where depth of frames is used, else 0:
    # without depth the sky's colours explain surface
    opacity: AtLeastZero | None = None
    depth: AtLeastZero = 0.1  # weight of what lies off the measured depth, where frames have some
    start_from_depth: bool = True  # where frames have some
    exposure: bool = True  # a gain a frame and channel, for cameras whose exposure drifts
    trunk_steps: NotNegative = 600  # of features and colours that depend on the direction, where a field has them
    held_out: NotNegative = 8  # every n-th frame is held out, for the PSNR; 0 = none
    seed: NotNegative = 0


@dataclass(frozen=True, slots=True)
class GridFitProgress:
    """State after a step; ``loss`` is the mean squared error of its rays."""

    step: int
    fraction: float
    loss: float


@dataclass(frozen=True, slots=True, eq=False)
class GridFit:
    """A fitted grid.

    Args:
        grid: The grid.
        steps: That it was fitted for.
        seconds: Wall-clock time.
        psnr: Of held-out frames in dB, each with the gain that fits it best if exposure was fitted; NaN where none were
            rendered: none held out, or stopped.
        mean_colour_psnr: The same of images of their mean colour.
        frames: F frames that it was fitted to.
        gains: (F, 3) their exposure.
    """

    grid: SceneGrid
    steps: int
    seconds: float
    psnr: float
    mean_colour_psnr: float
    frames: tuple[PosedFrame, ...]
    gains: Float32


def fit_grid(
    frames: Sequence[PosedFrame],
    config: GridFitConfig = GridFitConfig(),
    on_progress: Callable[[GridFitProgress], None] | None = None,
    stopped: Callable[[], object] = bool,
    box: GridConfig | None = None,
    leave_out: Callable[[Sequence[PosedFrame], FrameRays], Bool] | None = None,
) -> GridFit:
    """Fit a grid to posed images.

    Args:
        frames: Of a scene that stands still; sizes and cameras may differ. Frames with impossible poses are left out.
        config: Budget, box and resolution.
        on_progress: Called after every step.
        stopped: Asked before every step; once it says so (anything true), the grid so far is the result.
        box: Instead of the one that ``config`` describes.
        leave_out: Which pixels (P,) of the frames show something else than the scene.

    Raises:
        FrameError: too few frames, poses that only turn, or held-out views rendered hardly better than by their mean
            colour.
        ConfigError: a box that cannot be.
    """
    start = time.monotonic()
    frames = usable_frames(frames)
    held_out = frames[config.held_out - 1 :: config.held_out] if config.held_out else []
    seen = [f for i, f in enumerate(frames) if not config.held_out or (i + 1) % config.held_out]
    if len(seen) < MIN_FRAMES:
        raise FrameError(f"a grid needs at least {MIN_FRAMES} frames to fit besides held-out ones, got {len(seen)}")
    box = box or scene_box(frames, config)
    _check_parallax(frames, box)
    rays = frame_rays(seen, config.width)
    fitter = _Fitter(rays, box, config, None if leave_out is None else leave_out(seen, rays))
    steps = 0
    fraction = 0.0
    while fraction < 1 and not stopped():
        loss = fitter.step(steps, fraction)
        steps += 1
        fraction = budget_fraction(steps, time.monotonic() - start, steps=config.steps, seconds=config.seconds)
        if on_progress is not None:
            on_progress(GridFitProgress(steps, min(fraction, 1.0), loss))
    grid = fitter.finish()
    shown = [] if stopped() else held_out[:: -(-len(held_out) // PSNR_VIEWS) or 1]
    psnr, mean_psnr = held_out_psnr(grid, shown, config)
    if psnr < mean_psnr + MIN_GAIN_DB and fraction >= 1:
        raise FrameError(
            f"held-out views are rendered with {psnr:.1f} dB, hardly better than by their mean colour "
            f"({mean_psnr:.1f} dB): poses do not fit the images, or {steps} steps are too few. Poses are "
            "T_world_camera in metres, camera axes x right, y down, z forward; the scene must stand still, and the box "
            "must hold what is seen"
        )
    gains = np.exp(fitter.log_gain).astype(np.float32)
    return GridFit(grid, steps, time.monotonic() - start, psnr, mean_psnr, tuple(seen), gains)


def scene_box(frames: Sequence[PosedFrame], config: GridFitConfig) -> GridConfig:
    """The box that ``config`` asks for, or what the frames' depth reaches, or what their images show.

    Raises:
        ConfigError: a box without a volume, or too large for ``voxel_m``.
    """
    long_side = config.long_side or LONG_SIDE
    if config.box_m is not None:
        low, high = config.box_m[:3], config.box_m[3:]
    elif any(f.depth_m is not None for f in frames):
        low, high = depth_bounds(frames)
    else:
        low, high = image_bounds(frames, config.far_m)
        sides = [b - a for a, b in zip(low, high, strict=True)]
        long_side = config.long_side or max(LONG_SIDE, round(max(sides) * (VOXELS / math.prod(sides)) ** (1 / 3)))
    box = grid_box(low, high, long_side, config.voxel_m)
    wanted = max(b - a for a, b in zip(low, high, strict=True)) / (long_side - 1)
    if config.voxel_m is None and box.voxel_m > wanted * (1 + 1e-9):
        _log.warning(
            "voxels_grown", wanted_m=round(wanted, 4), voxel_m=round(box.voxel_m, 4), reason="16 M voxels at most"
        )
    return box


def render_frame(grid: SceneGrid, rays: FrameRays, frame: int, near_m: float) -> tuple[Float32, Float32]:
    """Colour (H, W, 3) in [0, 1] and z (H, W) in metres of a frame, 0 where less than half of the light is stopped."""
    with torch.no_grad():
        batch = rays.rays(rays.pixels_of(frame), near_m)
        placed = grid.rays(batch)
        marched = grid.march(placed)
        weight = marched.weight / marched.weight.sum(1, keepdim=True).clamp_min(1e-6)
        colour = (weight[..., None] * grid.colour(placed.points(marched.z))).sum(1) * (1 - marched.light)[:, None]
        colour += marched.light[:, None] * grid.sky_colour(batch.direction)
        depth = (weight * marched.z).sum(1) * (marched.light < 0.5)
    size = rays.image_size(frame)
    return colour.numpy().reshape(*size, 3), depth.numpy().reshape(size)


def held_out_psnr(grid: SceneGrid, frames: Sequence[PosedFrame], config: GridFitConfig) -> tuple[float, float]:
    """PSNR in dB of frames that were not fitted to, and that of images of their mean colour; NaN without frames."""
    if not frames:
        return math.nan, math.nan
    rays = frame_rays(frames, config.width)
    errors, plain = [], []
    for i in range(len(frames)):
        colour, _ = render_frame(grid, rays, i, config.near_m)
        truth = rays.rgb[rays.pixels_of(i)].reshape(colour.shape) / np.float32(255)
        if config.exposure:
            colour = colour * ((colour * truth).sum((0, 1)) / np.maximum((colour * colour).sum((0, 1)), 1e-6))
        errors.append(np.square(colour - truth).mean())
        plain.append(np.square(truth.mean((0, 1)) - truth).mean())
    return psnr_of(float(np.mean(errors))), psnr_of(float(np.mean(plain)))


def psnr_of(mean_square: float) -> float:
    """dB of a mean squared error of colours in [0, 1]."""
    return -10 * math.log10(max(mean_square, 1e-10))


class _Fitter:
    """The grid at its present resolution, and the state of Adam."""

    def __init__(self, rays: FrameRays, box: GridConfig, config: GridFitConfig, left_out: Bool | None) -> None:
        self.pixels = np.arange(len(rays)) if left_out is None else np.flatnonzero(~left_out)
        if left_out is not None:
            rays = replace(rays, depth_m=np.where(left_out, np.float32(0), rays.depth_m))
        self.rays, self.box, self.config = rays, box, config
        self.rng = np.random.default_rng(config.seed)
        self.order = np.zeros(0, np.int64)
        self.log_gain = np.zeros((len(rays.intrinsics), 3))
        measured = bool((rays.depth_m > 0).any()) and (config.depth > 0 or config.start_from_depth)
        from_depth = config.start_from_depth and measured
        self.opacity = (OPACITY if measured else 0.0) if config.opacity is None else config.opacity
        # A start from depth has nothing to gain from coarse grids.
        self.stages = COARSE[-1:] if from_depth else COARSE
        self.stage = 0
        first = at_resolution(box, self._long_side(0))
        self.grid = grid_of_depth(rays, first) if from_depth else SceneGrid(first)
        self.gain_adam, self.sky_adam = _Adam(self.log_gain.shape), _Adam(tuple(self.grid.sky.shape))
        self._allocate()

    def _long_side(self, stage: int) -> int:
        return max(round(max(self.box.shape) / self.stages[stage][1]), 8)

    def _allocate(self) -> None:
        """Buffers for the grid as it is now."""
        self.values = self.grid.values.detach().numpy()
        self.gradient, self.first, self.second = (np.zeros_like(self.values) for _ in range(3))
        self.samples = SampleLists.empty(self.config.rays, most_samples(self.values.shape), 4)
        self.rate, self.since = view_fraction(self.rays, self.grid.config, self.config.near_m), 0

    def step(self, step: int, fraction: float) -> float:
        """One step of Adam on a batch of rays at a fraction of the budget; returns their mean squared error."""
        if self.stage + 1 < len(self.stages) and fraction >= self.stages[self.stage + 1][0]:
            self.stage += 1
            del self.gradient, self.first, self.second, self.samples  # before larger ones are made
            self.grid = self.grid.resampled(at_resolution(self.box, self._long_side(self.stage)))
            self._allocate()
        elif step >= WARM_UP and step % PRUNE_EVERY == 0:
            self.grid.update_occupied()
        loss = self._rays_backward(self._draw())
        self.since += 1
        config, rate = self.config, self.config.learning_rate * self.config.final_rate**fraction
        variation = (config.density_variation / config.rays, config.colour_variation / config.rays)
        add_total_variation(len(self.values), self.values, self.gradient, *variation)
        buffers = (self.values, self.gradient, self.first, self.second, self.rate)
        corrections = (1 - BETA1**self.since, 1 - BETA2**self.since)
        adam_grid(len(self.values), *buffers, rate, rate, BETA1, BETA2, *corrections)
        return loss

    def finish(self) -> SceneGrid:
        """The grid, empty where no frame looks."""
        self.values[self.rate == 0] = (NOTHING, 0, 0, 0)
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
        results = RayResults(*(np.empty((len(pixels), 3), np.float32) for _ in range(3)))
        loss = LossWeights(self.config.point_colour, self.opacity, self.config.depth)
        rays = self.grid.rays(batch, jitter).arrays()
        targets = TargetArrays(colour, inverse, gain, behind)
        photometric_rays(len(pixels), self.grid.arrays(), rays, targets, loss, self.samples, results)
        scatter_grid(len(self.gradient), self.samples, self.gradient)
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


class _Adam:
    """Adam's direction for a small array."""

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


def _check_parallax(frames: Sequence[PosedFrame], box: GridConfig) -> None:
    """Refuse cameras that stand in one place.

    Raises:
        FrameError: they do.
    """
    position = np.array([f.T_world_camera[:3, 3] for f in frames])
    reach = float(np.linalg.norm(position - position.mean(0), axis=1).max())
    if reach < MIN_PARALLAX * box.voxel_m * max(box.shape):
        raise FrameError(
            f"all cameras stand within {reach:.3g} m: poses that only turn tell no depth. Move the camera; poses are "
            "T_world_camera, with translations in metres"
        )
