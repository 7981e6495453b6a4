"""Rays through a grid: the samples of greatest weight, and reading channels there; differentiable.

Compiled for float32 on a CPU. ``reference.py`` does the same in plain torch, for other devices and dtypes.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.grid import reference
from semantic_mapper.fields.grid.kernels import (
    GridArrays,
    Marched,
    RayArrays,
    SampleLists,
    gather_grid,
    march_gradient,
    march_grid,
    scatter_grid,
)

STEP = 0.5  # length of a sample, in voxels
ALPHA_START = 1e-3  # opacity of a voxel whose raw density is 0
BIAS = math.log(1 / (1 - ALPHA_START) - 1)
KEPT = 16  # samples of a ray that are looked at


@dataclass(frozen=True, slots=True, eq=False)
class GridRays:
    """R rays in voxels of a grid.

    Args:
        origin, direction: (R, 3); of the direction, voxels a metre of z.
        near, far: (R,) metres of z.
        jitter: (R,) where in its interval a sample lies, 0 to 1.
    """

    origin: torch.Tensor
    direction: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    jitter: torch.Tensor

    def arrays(self) -> RayArrays:
        """For kernels."""
        return RayArrays(*(array_of(t) for t in (self.origin, self.direction, self.near, self.far, self.jitter)))

    def points(self, z: torch.Tensor) -> torch.Tensor:
        """Voxel coordinates (R, K, 3) at z (R, K)."""
        return self.origin[:, None] + z[..., None] * self.direction[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class March:
    """Samples of R rays.

    Args:
        z: (R, K) metres, ascending.
        weight: (R, K) compositing weights, 0 beyond the last sample. Differentiable.
        light: (R,) what gets through the whole grid: 1 minus all weights, also of samples that are left out.
    """

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
        return March(*reference.march(values, occupied, rays, kept, STEP, BIAS))
    ray_tensors = (rays.origin, rays.direction, rays.near, rays.far, rays.jitter)
    return March(*_March.apply(values, occupied, kept, *ray_tensors))  # type: ignore[misc]


def gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Channels (..., C) of ``values`` (X, Y, Z, C) at ``points`` (..., 3) in voxels, trilinear; differentiable by
    ``values``. Beyond the grid, those of its edge."""
    if not _is_compiled(values):
        return reference.gather(values, points)
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
