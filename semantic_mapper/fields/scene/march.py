"""Rays through a dense grid: the samples of greatest weight, and reading channels there; differentiable.

Compiled for float32 on a CPU (``kernels/src/scene_grid.c``); the same in plain torch is the reference that tests
compare it with, and the way on other devices.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn import functional

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
    step: float  # length of a sample, in voxels
    bias: float  # added to the raw density before its softplus
    stop_below: float = STOP_BELOW


class RayArrays(NamedTuple):
    """R rays in voxels: origin, direction a metre of z (R, 3); near, far (R,) metres of z; jitter (R,) in [0, 1)."""

    origin: Float32
    direction: Float32
    near: Float32
    far: Float32
    jitter: Float32


class TargetArrays(NamedTuple):
    """What R rays should see: colour (R, 3), inverse_depth (R,) 1 / m with 0 = not known, gain of the image (R, 3),
    colour of the sky behind (R, 3)."""

    colour: Float32
    inverse_depth: Float32
    gain: Float32
    sky: Float32


class LossWeights(NamedTuple):
    """Of the colour of each sample, the opacity of the ray, and its depth, against the MSE of colours.

    Where depth was measured, a sample costs its weight, as a fraction that grows with its distance from there up to 1
    at ``reach`` (1 / m, of inverse depth); light that gets through costs all. Samples with less weight than
    ``min_weight`` teach no colour.
    """

    point_colour: float = 0.1
    opacity: float = 1e-3
    depth: float = 0.1
    reach: float = 0.05
    min_weight: float = 1e-4


class SampleLists(NamedTuple):
    """Samples of each ray: points (R, S, 3) in voxels, gradient (R, S, C), counts (R,) of the S that are there."""

    points: Float32
    gradient: Float32
    counts: Int64

    @classmethod
    def empty(cls, rays: int, most: int, channels: int) -> SampleLists:
        """Room for ``most`` samples a ray."""
        return cls(
            np.empty((rays, most, 3), np.float32),
            np.empty((rays, most, channels), np.float32),
            np.zeros(rays, np.int64),
        )


class RayResults(NamedTuple):
    """Of R rays, (R, 3) each: colour with the gain; gradient of the loss by the sky, and by the gain."""

    colour: Float32
    sky_gradient: Float32
    gain_gradient: Float32


class Marched(NamedTuple):
    """z and weight (R, K) of the samples of greatest weight, ascending; light (R,) that gets through."""

    z: Float32
    weight: Float32
    light: Float32


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


class GridRays(NamedTuple):
    """``RayArrays`` as tensors."""

    origin: torch.Tensor
    direction: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    jitter: torch.Tensor

    def arrays(self) -> RayArrays:
        """For kernels."""
        return RayArrays(*map(array_of, self))

    def points(self, z: torch.Tensor) -> torch.Tensor:
        """Voxel coordinates (R, K, 3) at z (R, K)."""
        return self.origin[:, None] + z[..., None] * self.direction[:, None]


class March(NamedTuple):
    """Samples of R rays: z (R, K) in metres, ascending; compositing weights (R, K), 0 beyond the last sample; and light
    (R,) that gets through the whole grid: 1 minus all weights, also of samples that are left out."""

    z: torch.Tensor
    weight: torch.Tensor
    light: torch.Tensor


def march(values: torch.Tensor, occupied: torch.Tensor, rays: GridRays, kept: int = KEPT) -> March:
    """The ``kept`` samples of greatest weight of each ray; differentiable by ``values``.

    The gradient is exact: also samples that are left out, and those before a kept one, have theirs.

    Args:
        values: (X, Y, Z, C) at the vertices; channel 0 is the raw density.
        occupied: uint8, of each cell of 4 intervals a side whether anything may be in it.

    Raises:
        ShapeError: a grid without two vertices a side.
    """
    if values.ndim != 4 or min(values.shape[:3]) < 2:
        raise ShapeError(f"a grid has at least 2 vertices a side and channels, got shape {tuple(values.shape)}")
    if not _is_compiled(values):
        return March(*reference_march(values, occupied, rays, kept))
    return March(*_March.apply(values, occupied, kept, *rays))  # type: ignore[misc]


def gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Channels (..., C) of ``values`` (X, Y, Z, C) at ``points`` (..., 3) in voxels, trilinear; differentiable by
    ``values``. Beyond the grid, those of its edge."""
    if not _is_compiled(values):
        return reference_gather(values, points)
    return _Gather.apply(values, points)  # type: ignore[return-value]


def array_of(tensor: torch.Tensor) -> np.ndarray[Any, Any]:
    """A tensor as kernels take it: contiguous, without gradients, in the same memory where it already is so."""
    return tensor.detach().contiguous().numpy()


def most_samples(shape: tuple[int, ...]) -> int:
    """A bound of the samples of a ray through a grid of this shape."""
    return int(math.sqrt(sum((n - 1) ** 2 for n in shape[:3])) / STEP) + 3


def _is_compiled(values: torch.Tensor) -> bool:
    return values.device.type == "cpu" and values.dtype == torch.float32


class _March(torch.autograd.Function):
    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, values: torch.Tensor, occupied: torch.Tensor, kept: int, *rays: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        grid = GridArrays(array_of(values), array_of(occupied), STEP, BIAS)
        arrays, count = GridRays(*rays).arrays(), len(rays[0])
        out = Marched(
            np.empty((count, kept), np.float32), np.empty((count, kept), np.float32), np.empty(count, np.float32)
        )
        march_grid(count, grid, arrays, out)
        ctx.grid, ctx.rays, ctx.out = grid, arrays, out
        z, weight, light = (torch.from_numpy(a) for a in out)
        ctx.mark_non_differentiable(z)
        return z, weight, light

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        _, by_weight, by_light = (array_of(g) for g in gradients)
        values: np.ndarray[Any, Any] = ctx.grid.values
        samples = SampleLists.empty(len(by_light), most_samples(values.shape), 1)
        march_gradient(len(by_light), ctx.grid, ctx.rays, ctx.out, by_weight, by_light, samples)
        density = np.zeros((*values.shape[:3], 1), np.float32)
        scatter_grid(len(density), samples, density)
        total = torch.zeros(values.shape)
        total[..., :1] = torch.from_numpy(density)
        return (total, *(None,) * 7)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        flat = array_of(points.reshape(-1, 3))
        out = np.empty((len(flat), values.shape[3]), np.float32)
        gather_grid(len(flat), array_of(values), flat, out)
        ctx.points, ctx.shape = flat, values.shape
        return torch.from_numpy(out).view(*points.shape[:-1], values.shape[3])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        total = np.zeros(ctx.shape, np.float32)
        flat = array_of(gradient.reshape(1, -1, ctx.shape[3]))
        count = np.array([flat.shape[1]], np.int64)
        scatter_grid(len(total), SampleLists(ctx.points[None], flat, count), total)
        return torch.from_numpy(total), None


def reference_gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """``gather`` in plain torch: values (X, Y, Z, C) at points (..., 3) in voxels -> (..., C)."""
    size = points.new_tensor([n - 1 for n in values.shape[:3]])
    place = (points.reshape(1, -1, 1, 1, 3) / size * 2 - 1).flip(-1)  # grid_sample's x is the last axis
    volume = values.permute(3, 0, 1, 2)[None]
    read = functional.grid_sample(volume, place, mode="bilinear", padding_mode="border", align_corners=True)
    return read[0, :, :, 0, 0].T.reshape(*points.shape[:-1], values.shape[3])


def reference_samples(
    values: torch.Tensor, occupied: torch.Tensor, rays: GridRays
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """All samples: z (R, S), weight (R, S), and the light (R,) that gets through; without weight where none is."""
    z, valid = _lattice(values.shape, rays)
    top = z.new_tensor([n - 1 for n in values.shape[:3]])
    points = torch.minimum(rays.points(z).clamp(min=0), top)
    base = torch.minimum(points.long(), top.long() - 1)
    cell = base // CELL
    valid = valid & (occupied[cell[..., 0], cell[..., 1], cell[..., 2]] > 0)
    depth = STEP * functional.softplus(reference_gather(values[..., :1], points)[..., 0] + BIAS) * valid
    before = torch.cumsum(depth, 1) - depth
    depth = depth * (torch.exp(-before) >= STOP_BELOW)
    before = torch.cumsum(depth, 1) - depth
    return z, torch.exp(-before) * -torch.expm1(-depth), torch.exp(-depth.sum(1))


def reference_march(
    values: torch.Tensor, occupied: torch.Tensor, rays: GridRays, kept: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """``march`` in plain torch: z and weight (R, kept), and light (R,)."""
    z, weight, light = reference_samples(values, occupied, rays)
    if z.shape[1] < kept:
        z, weight = (functional.pad(t, (0, kept - t.shape[1])) for t in (z, weight))
    order = weight.detach().topk(kept, dim=1).indices.sort(dim=1).values
    z, weight = z.gather(1, order), weight.gather(1, order)
    last = (z * (weight > 0)).amax(1, keepdim=True)
    order = (weight.detach() <= 0).to(torch.uint8).argsort(dim=1, stable=True)  # those without weight to the end
    return torch.where(weight > 0, z, last).gather(1, order), weight.gather(1, order), light


def _lattice(shape: torch.Size, rays: GridRays) -> tuple[torch.Tensor, torch.Tensor]:
    """z (R, S) of the samples of rays, and whether they are in the grid."""
    o, d = rays.origin, rays.direction
    top = o.new_tensor([n - 1 for n in shape[:3]])
    along = d.abs() < 1e-9
    safe = torch.where(along, torch.ones_like(d), d)
    a, b = -o / safe, (top - o) / safe
    inside = (~along | ((o >= 0) & (o <= top))).all(1)
    low = torch.where(along, -torch.inf, torch.minimum(a, b)).amax(1)
    high = torch.where(along, torch.inf, torch.maximum(a, b)).amin(1)
    start, end = torch.maximum(rays.near, low), torch.minimum(rays.far, high)
    interval = STEP / d.norm(dim=1)
    count = torch.ceil((end - start) / interval - rays.jitter) * (inside & (end > start))
    k = torch.arange(max(int(count.max()), 1), dtype=o.dtype, device=o.device)
    z = start[:, None] + (k + rays.jitter[:, None]) * interval[:, None]
    valid = k < count[:, None]
    return torch.where(valid, z, rays.near[:, None]), valid
