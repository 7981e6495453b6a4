"""The compiled loops of the scene grid (``kernels/src/scene_grid.c``); ``reference.py`` has the same in plain torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, Float64, Int64, UInt8

STOP_BELOW = 1e-4  # a ray ends where less of its light gets through


class GridArrays(NamedTuple):
    """A grid as kernels take it.

    Args:
        values: (X, Y, Z, C) at the vertices, channel 0 the raw density.
        occupied: Of each cell of ``CELL`` intervals a side, whether there may be anything in it.
        step: Length of a sample, in voxels.
        bias: Added to the raw density before its softplus.
        stop_below: A ray ends where less light gets through.
    """

    values: Float32
    occupied: UInt8
    step: float
    bias: float
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
    at ``reach`` (1 / m, of inverse depth); light that gets through costs all. Samples with less weight than ``faint``
    teach no colour.
    """

    point_colour: float = 0.1
    opacity: float = 1e-3
    depth: float = 0.1
    reach: float = 0.05
    faint: float = 1e-4


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
