"""Rays through a dense grid of float32: the samples of greatest weight, and reading channels there; differentiable.

The loops are compiled (``kernels/src/scene_grid.c``) and run on the CPU, wherever the tensors are.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from typing import Any, NamedTuple

import numpy as np
import torch

from semantic_mapper.errors import ShapeError
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, Float64, Int64, UInt8

STEP = 0.5  # length of a sample, in voxels
ALPHA_START = 1e-3  # opacity of a voxel whose raw density is 0
BIAS = math.log(1 / (1 - ALPHA_START) - 1)
KEPT = 16  # samples of a ray that are looked at
CELL = 4  # intervals a side of a cell that is occupied or not
STOP_BELOW = 1e-4  # a ray ends where less of its light gets through


class GridArrays(NamedTuple):
    """A grid as kernels take it."""

    values: Float32  # (X, Y, Z, C) at the vertices, channel 0 the raw density
    occupied: UInt8  # of each cell of ``CELL`` intervals a side, whether there may be anything in it
    step: float = STEP  # length of a sample, in voxels
    bias: float = BIAS  # added to the raw density before its softplus
    stop_below: float = STOP_BELOW


class RayArrays(NamedTuple):
    """R rays in voxels, as kernels take them."""

    origin: Float32  # (R, 3)
    direction: Float32  # (R, 3) a metre of z
    near: Float32  # (R,) metres of z
    far: Float32  # (R,)
    jitter: Float32  # (R,) place of samples in their intervals, in [0, 1)


class TargetArrays(NamedTuple):
    """What R rays should see."""

    colour: Float32  # (R, 3)
    inverse_depth: Float32  # (R,) 1 / m, 0 = not known
    gain: Float32  # (R, 3) of the image
    sky: Float32  # (R, 3) colour of the sky behind


class LossWeights(NamedTuple):
    """Weights against the MSE of colours. Where depth was measured, a sample costs its weight, as a fraction that grows
    with its distance from there; light that gets through costs all."""

    point_colour: float = 0.1  # of the colour of each sample
    opacity: float = 1e-3  # of the opacity of the ray
    depth: float = 0.1
    reach: float = 0.05  # 1 / m, of inverse depth, from which on a sample costs all of its weight
    min_weight: float = 1e-4  # samples with less teach no colour


class SampleLists(NamedTuple):
    """S samples at most of each of R rays."""

    points: Float32  # (R, S, 3) in voxels
    gradient: Float32  # (R, S, C)
    counts: Int64  # (R,) of the S that are there

    @classmethod
    def empty(cls, rays: int, shape: tuple[int, ...], channels: int) -> "SampleLists":
        """Room for all samples of rays through a grid of this shape."""
        most = int(math.sqrt(sum((n - 1) ** 2 for n in shape[:3])) / STEP) + 3
        points, gradient = (np.empty((rays, most, n), np.float32) for n in (3, channels))
        return cls(points, gradient, np.zeros(rays, np.int64))


class RayResults(NamedTuple):
    """Of R rays, (R, 3) each."""

    colour: Float32  # with the gain
    sky_gradient: Float32  # of the loss
    gain_gradient: Float32


class Marched(NamedTuple):
    """K samples of greatest weight of each of R rays."""

    z: Float32  # (R, K) metres, ascending
    weight: Float32  # (R, K)
    light: Float32  # (R,) that gets through


@parallel_kernel(chunks_per_thread=4)
def photometric_rays(
    count: int,
    grid: GridArrays,
    rays: RayArrays,
    targets: TargetArrays,
    loss: LossWeights,
    samples: SampleLists,
    results: RayResults,
    /,
) -> None:
    """Colour rays forwards and backwards; ``count`` is that of the rays."""


@parallel_kernel()
def gather_grid(count: int, values: Float32, points: Float32, out: Float32, /) -> None:
    """Values (X, Y, Z, C) at ``points`` (count, 3) in voxels, trilinear; beyond the grid, those of its edge."""


@parallel_kernel()
def scatter_grid(layers: int, samples: SampleLists, total: Float32, /) -> None:
    """Add what samples hold to ``total`` (layers, Y, Z, C), trilinear: the same bits for any number of threads."""


@parallel_kernel(chunks_per_thread=4)
def march_grid(count: int, grid: GridArrays, rays: RayArrays, out: Marched, /) -> None:
    """The K samples of greatest weight of each of ``count`` rays."""


@parallel_kernel(chunks_per_thread=4)
def march_gradient(
    count: int,
    grid: GridArrays,
    rays: RayArrays,
    marched: Marched,
    weight_gradient: Float32,
    light_gradient: Float32,
    samples: SampleLists,
    /,
) -> None:
    """Gradients of the raw density at all samples, given those of the kept weights (R, K) and of the light (R,)."""


@parallel_kernel()
def adam_grid(
    layers: int,
    values: Float32,
    gradient: Float32,
    first: Float32,
    second: Float32,
    rate: Float32,
    density_rate: float,
    colour_rate: float,
    beta1: float,
    beta2: float,
    correction1: float,
    correction2: float,
    /,
) -> None:
    """One step of Adam where the gradient is not 0; the gradient is 0 afterwards. All (layers, Y, Z, C)."""


@parallel_kernel()
def add_total_variation(
    layers: int, values: Float32, gradient: Float32, density_weight: float, colour_weight: float, /
) -> None:
    """Add the gradient of the total variation to that of the loss, where the latter is not 0."""


@parallel_kernel()
def fuse_grid_depth(
    layers: int,
    distance: Float32,
    weight: Float32,
    depth_m: Float32,
    T_camera_grid: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    truncation_m: float,
    /,
) -> None:
    """Average one depth image into a truncated signed distance (layers, Y, Z)."""


def march(
    values: torch.Tensor, occupied: torch.Tensor, rays: RayArrays, kept: int = KEPT
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The ``kept`` samples of greatest weight of each ray; differentiable by ``values``.

    The gradient is exact: also samples that are left out, and those before a kept one, have theirs. ``values`` and
    ``occupied`` are those of ``GridArrays``. Returns z (R, K) in metres, ascending; compositing weights (R, K), 0
    beyond the last sample; and light (R,) that gets through the whole grid: 1 minus all weights, also of samples that
    are left out. Raises ShapeError: a grid without two vertices a side.
    """
    if values.ndim != 4 or min(values.shape[:3]) < 2:
        raise ShapeError(f"a grid has at least 2 vertices a side and channels, got shape {tuple(values.shape)}")
    return _March.apply(values, occupied, rays, kept)  # type: ignore[return-value]


def gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Channels (..., C) of ``values`` (X, Y, Z, C) at ``points`` (..., 3) in voxels, trilinear; differentiable by
    ``values``. Beyond the grid, those of its edge."""
    return _Gather.apply(values, points)  # type: ignore[return-value]


def array_of(tensor: torch.Tensor) -> np.ndarray[Any, Any]:
    """A tensor as kernels take it: contiguous, without gradients, in the same memory where it already is so."""
    return tensor.detach().cpu().contiguous().numpy()


class _March(torch.autograd.Function):
    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, values: torch.Tensor, occupied: torch.Tensor, rays: RayArrays, kept: int
    ) -> tuple[torch.Tensor, ...]:
        grid, count = GridArrays(array_of(values), array_of(occupied)), len(rays.near)
        out = Marched(*(np.empty(shape, np.float32) for shape in ((count, kept), (count, kept), count)))
        march_grid(count, grid, rays, out)
        ctx.grid, ctx.rays, ctx.out = grid, rays, out
        z, weight, light = (torch.from_numpy(a).to(values.device) for a in out)
        ctx.mark_non_differentiable(z)
        return z, weight, light

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        _, by_weight, by_light = (array_of(g) for g in gradients)
        shape = ctx.grid.values.shape
        samples = SampleLists.empty(len(by_light), shape, 1)
        march_gradient(len(by_light), ctx.grid, ctx.rays, ctx.out, by_weight, by_light, samples)
        density = np.zeros((*shape[:3], 1), np.float32)
        scatter_grid(len(density), samples, density)
        total = torch.zeros(shape)
        total[..., :1] = torch.from_numpy(density)
        return total.to(gradients[0].device), None, None, None


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        flat = array_of(points.reshape(-1, 3))
        out = np.empty((len(flat), values.shape[3]), np.float32)
        gather_grid(len(flat), array_of(values), flat, out)
        ctx.points, ctx.shape = flat, values.shape
        return torch.from_numpy(out).view(*points.shape[:-1], values.shape[3]).to(values.device)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        total = np.zeros(ctx.shape, np.float32)
        flat = array_of(gradient.reshape(1, -1, ctx.shape[3]))
        count = np.array([flat.shape[1]], np.int64)
        scatter_grid(len(total), SampleLists(ctx.points[None], flat, count), total)
        return torch.from_numpy(total).to(gradient.device), None
