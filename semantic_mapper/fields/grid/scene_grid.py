"""``SceneGrid``: density and colour of one scene on a dense grid, and the colours of the sky behind it."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math

import msgspec
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import GridConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.grid.kernels import GridArrays
from semantic_mapper.fields.grid.march import BIAS, KEPT, STEP, GridRays, March, array_of, gather, march
from semantic_mapper.fields.grid.reference import CELL
from semantic_mapper.types import RayBatch

MAX_VOXELS = 1 << 24
SKY_ROWS, SKY_COLUMNS = 16, 32
EMPTY_ALPHA = 4e-3  # a cell whose voxels are all less opaque is skipped
HAZE = 1.7  # raw density of what is not known: an opacity of 5e-3, which is not skipped
NOTHING = -10.0  # raw density of what is empty: an opacity of 5e-8


class SceneGrid(nn.Module):
    """Raw density and raw colour at the vertices of a grid; trilinear between them, then softplus and sigmoid.

    ``values`` (X, Y, Z, 4) holds raw density, red, green and blue; ``occupied`` tells which cells rays may skip;
    ``sky`` (16, 32, 3) are raw colours by direction, for rays that leave the box. They are parameters without
    gradients: fits that want some ask for them.

    Args:
        config: The box. All axes are the world's.
    """

    occupied: torch.Tensor

    def __init__(self, config: GridConfig) -> None:
        super().__init__()
        check_grid(config)
        self.config = config
        self.values = nn.Parameter(torch.zeros(*config.shape, 4), requires_grad=False)
        self.sky = nn.Parameter(torch.zeros(SKY_ROWS, SKY_COLUMNS, 3), requires_grad=False)
        cells = [-(-(n - 1) // CELL) for n in config.shape]
        self.register_buffer("occupied", torch.ones(*cells, dtype=torch.uint8))

    def arrays(self) -> GridArrays:
        """For kernels, in the same memory."""
        return GridArrays(array_of(self.values), array_of(self.occupied), STEP, BIAS)

    def rays(self, rays: RayBatch, jitter: torch.Tensor | None = None) -> GridRays:
        """Rays (R,) of the world in voxels.

        Args:
            jitter: (R,) place of samples in their intervals, 0 to 1; None = the middle.
        """
        origin = (rays.origin - rays.origin.new_tensor(self.config.origin_m)) / self.config.voxel_m
        middle = torch.full_like(rays.near_m, 0.5) if jitter is None else jitter
        direction = rays.direction / self.config.voxel_m
        return GridRays(origin, direction, rays.near_m, torch.full_like(rays.far_m, math.inf), middle)

    def march(self, rays: GridRays, kept: int = KEPT) -> March:
        """The samples of greatest weight of each ray, as far as the grid reaches."""
        return march(self.values, self.occupied, rays, kept)

    def colour(self, points: torch.Tensor) -> torch.Tensor:
        """Colours (..., 3) in [0, 1] at voxel coordinates (..., 3)."""
        return torch.sigmoid(gather(self.values, points)[..., 1:])

    def sky_colour(self, direction: torch.Tensor) -> torch.Tensor:
        """Colours (R, 3) in [0, 1] of the sky in directions (R, 3)."""
        texel, weight = sky_texels(direction)
        return (torch.sigmoid(self.sky.flatten(0, 1))[texel] * weight[..., None]).sum(1)

    @staticmethod
    def optical_depth(raw: torch.Tensor) -> torch.Tensor:
        """Optical depth a voxel of raw densities."""
        return functional.softplus(raw + BIAS)

    def alpha(self) -> torch.Tensor:
        """Opacity (X, Y, Z) of a voxel at each vertex."""
        return -torch.expm1(-self.optical_depth(self.values[..., 0]))

    def update_occupied(self) -> None:
        """Find the cells that rays may skip."""
        with torch.no_grad():
            seen = (self.alpha() >= EMPTY_ALPHA).float()
            sides = [0 if (n - 1) % CELL == 0 else CELL - (n - 1) % CELL for n in seen.shape]
            padded = functional.pad(seen, (0, sides[2], 0, sides[1], 0, sides[0]))
            cells = functional.max_pool3d(padded[None, None], CELL + 1, CELL)[0, 0]
            self.occupied.copy_(cells)

    def resampled(self, config: GridConfig) -> SceneGrid:
        """This grid in another box or resolution."""
        other = SceneGrid(config).to(self.values.device)
        axes = [
            (torch.arange(n) * config.voxel_m + a - b) / self.config.voxel_m
            for n, a, b in zip(config.shape, config.origin_m, self.config.origin_m, strict=True)
        ]
        with torch.no_grad():
            for x, layer in zip(axes[0], other.values, strict=True):  # a layer at a time: points need no memory then
                points = torch.stack(torch.meshgrid(x[None], axes[1], axes[2], indexing="ij"), -1)
                layer.copy_(gather(self.values, points.to(self.values))[0])
            other.sky.copy_(self.sky)
        other.update_occupied()
        return other


def sky_texels(direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The four texels (R, 4) int64 of the sky round directions (R, 3), row by row, and their weights (R, 4)."""
    unit = functional.normalize(direction, dim=1)
    row = (torch.acos(unit[:, 2].clamp(-1, 1)) / math.pi * SKY_ROWS - 0.5).clamp(0, SKY_ROWS - 1)
    column = (torch.atan2(unit[:, 1], unit[:, 0]) / (2 * math.pi) * SKY_COLUMNS - 0.5) % SKY_COLUMNS
    v, u = row.floor().clamp(max=SKY_ROWS - 2), column.floor()
    dv, du = row - v, column - u
    left, right = u.long() % SKY_COLUMNS, (u.long() + 1) % SKY_COLUMNS
    above, below = v.long() * SKY_COLUMNS, (v.long() + 1) * SKY_COLUMNS
    texel = torch.stack((above + left, above + right, below + left, below + right), 1)
    weight = torch.stack(((1 - dv) * (1 - du), (1 - dv) * du, dv * (1 - du), dv * du), 1)
    return texel, weight


def grid_box(
    low_m: tuple[float, ...], high_m: tuple[float, ...], long_side: int, voxel_m: float | None = None
) -> GridConfig:
    """The grid of a box with ``long_side`` vertices along its longest side, or of voxels of this size.

    A box that would have more than 16 M voxels gets larger ones.

    Raises:
        ConfigError: a box without a volume, or one that is too large for ``voxel_m``, with the size that fits.
    """
    sides = [high - low for low, high in zip(low_m, high_m, strict=True)]
    if not all(math.isfinite(s) and s > 0 for s in sides):
        raise ConfigError(f"the box from {low_m} to {high_m} m has no volume; give lower corner, then upper corner")
    size = voxel_m or max(sides) / (long_side - 1)
    fits = size
    while math.prod(_vertices(sides, fits)) > MAX_VOXELS:
        fits *= 1.01
    if voxel_m is not None and fits > size:
        raise ConfigError(
            f"voxel_m = {voxel_m:g} makes {math.prod(_vertices(sides, size))} voxels, at most {MAX_VOXELS} are "
            f"possible: set voxel_m to {math.ceil(fits * 1e4) / 1e4:g} or more, or a smaller box"
        )
    x, y, z = _vertices(sides, fits)
    return GridConfig(origin_m=(low_m[0], low_m[1], low_m[2]), voxel_m=fits, shape=(x, y, z))


def check_grid(config: GridConfig) -> None:
    """Refuse a grid that would take too much memory.

    Raises:
        ConfigError: more than 16 M voxels.
    """
    if math.prod(config.shape) > MAX_VOXELS:
        raise ConfigError(f"a grid of {config.shape} has more than {MAX_VOXELS} voxels; raise voxel_m")


def at_resolution(config: GridConfig, long_side: int) -> GridConfig:
    """The same box with ``long_side`` vertices along its longest side; never finer than it is."""
    sides = [(n - 1) * config.voxel_m for n in config.shape]
    voxel = max(max(sides) / (long_side - 1), config.voxel_m)
    x, y, z = _vertices(sides, voxel)
    return config if voxel == config.voxel_m else msgspec.structs.replace(config, voxel_m=voxel, shape=(x, y, z))


def _vertices(sides: list[float], voxel_m: float) -> list[int]:
    return [max(math.ceil(side / voxel_m - 1e-6), 1) + 1 for side in sides]
