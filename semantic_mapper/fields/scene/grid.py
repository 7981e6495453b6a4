"""A radiance field on a dense grid, which two cores can fit: the base of fields of one scene.

``SceneGrid`` holds density and colour, ``Trunk`` features that kinds read more from, and ``GridField`` is both as a
field. Kinds that know classes build on it and say what its samples mean.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import msgspec
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import GridConfig, GridFieldConfig, SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.march import BIAS, CELL, KEPT, GridArrays, RayArrays, array_of, gather, march
from semantic_mapper.fields.views import EncodedViews, check_views, encoded_views
from semantic_mapper.fields.volume import composite_depth, field_render
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

MAX_VOXELS = 1 << 24
SKY_ROWS, SKY_COLUMNS = 16, 32
EMPTY_ALPHA = 4e-3  # a cell whose voxels are all less opaque is skipped
HAZE = 1.7  # raw density of what is not known: an opacity of 5e-3, which is not skipped
NOTHING = -10.0  # raw density of what is empty: an opacity of 5e-8
POSITION_FREQUENCIES, DIRECTION_FREQUENCIES = 4, 2
COLOUR_WIDTH = 64
FEATURE_START = 0.1  # standard deviation
LEAST_SLOPE = 1e-6  # of a ray along an axis
OPAQUE = 0.5  # opacity from which on a ray has met something


@dataclass(frozen=True, slots=True, eq=False)
class RaySamples:
    """K samples on each of R rays; kinds say of what class they are."""

    rays: RayBatch  # the rays in the world
    points: torch.Tensor  # (R, K, 3) voxel coordinates
    z: torch.Tensor  # (R, K) metres
    weight: torch.Tensor  # (R, K) compositing weights, differentiable by the grid's density
    light: torch.Tensor  # (R,) what gets through the grid to the sky
    # (R, K) int64 number of the box that moves whose sample it is, -1 = of the scene; None = all are
    mover: torch.Tensor | None = None

    @property
    def opacity(self) -> torch.Tensor:
        """(R,) what the grid stops."""
        return 1 - self.light

    @property
    def depth_m(self) -> torch.Tensor:
        """(R,) mean z of what rays meet."""
        return (self.weight * self.z).sum(1) / self.weight.sum(1).clamp_min(1e-6)

    def at(self, index: torch.Tensor) -> "RaySamples":
        """The samples at positions (R, N) of each ray."""
        points = self.points.gather(1, index[..., None].expand(-1, -1, 3))
        mover = None if self.mover is None else self.mover.gather(1, index)
        z, weight = self.z.gather(1, index), self.weight.gather(1, index)
        return RaySamples(self.rays, points, z, weight, self.light, mover)


def ray_fraction(samples: RaySamples) -> torch.Tensor:
    """What samples (R, K) count, as if none had been left out."""
    return samples.weight * (samples.opacity / samples.weight.sum(1).clamp_min(1e-6))[:, None]


def heaviest(samples: RaySamples, count: int) -> RaySamples:
    """The ``count`` samples of greatest weight of each ray, in their order."""
    if samples.z.shape[1] <= count:
        return samples
    return samples.at(samples.weight.topk(count, dim=1).indices.sort(dim=1).values)


class SceneGrid(nn.Module):
    """Raw density and raw colour at the vertices of a grid; trilinear between them, then softplus and sigmoid.

    ``values`` (X, Y, Z, 4) holds raw density, red, green and blue; ``occupied`` tells which cells rays may skip;
    ``sky`` (16, 32, 3) are raw colours by direction, for rays that leave the box. Fits ask for their gradients.
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
        return GridArrays(array_of(self.values), array_of(self.occupied))

    def ray_arrays(self, rays: RayBatch, jitter: torch.Tensor | None = None) -> RayArrays:
        """Rays (R,) of the world for kernels.
        ``jitter``: (R,) place of samples in their intervals, 0 to 1; None = the middle."""
        middle = torch.full_like(rays.near_m, 0.5) if jitter is None else jitter
        far = torch.full_like(rays.far_m, math.inf)
        return RayArrays(*map(array_of, (*self._in_voxels(rays), rays.near_m, far, middle)))

    def points(self, rays: RayBatch, z: torch.Tensor) -> torch.Tensor:
        """Voxel coordinates (R, K, 3) at z (R, K) of rays of the world."""
        origin, direction = self._in_voxels(rays)
        return origin[:, None] + z[..., None] * direction[:, None]

    def _in_voxels(self, rays: RayBatch) -> tuple[torch.Tensor, torch.Tensor]:
        origin = (rays.origin - rays.origin.new_tensor(self.config.origin_m)) / self.config.voxel_m
        return origin, rays.direction / self.config.voxel_m

    def span(self, rays: RayBatch) -> tuple[torch.Tensor, torch.Tensor]:
        """z (R,) at which rays enter the box, or begin in it, and at which they leave it; less where they miss it."""
        low = rays.origin.new_tensor(self.config.origin_m)
        high = low + self.config.voxel_m * (rays.origin.new_tensor(self.config.shape) - 1)
        step = torch.where(rays.direction.abs() < LEAST_SLOPE, LEAST_SLOPE, rays.direction)
        ends = (low - rays.origin) / step, (high - rays.origin) / step
        return torch.maximum(torch.minimum(*ends).amax(1), rays.near_m), torch.maximum(*ends).amin(1)

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """The samples of greatest weight of each ray, as far as the grid reaches."""
        z, weight, light = march(self.values, self.occupied, self.ray_arrays(rays, jitter), kept)
        return RaySamples(rays, self.points(rays, z), z, weight, light)

    def colour(self, points: torch.Tensor) -> torch.Tensor:
        """Colours (..., 3) in [0, 1] at voxel coordinates (..., 3)."""
        return torch.sigmoid(gather(self.values, points)[..., 1:])

    def sky_colour(self, direction: torch.Tensor) -> torch.Tensor:
        """Colours (R, 3) in [0, 1] of the sky in directions (R, 3)."""
        texel, weight = sky_texels(direction)
        return (torch.sigmoid(self.sky.flatten(0, 1))[texel] * weight[..., None]).sum(1)

    def alpha(self) -> torch.Tensor:
        """Opacity (X, Y, Z) of a voxel at each vertex."""
        return -torch.expm1(-functional.softplus(self.values[..., 0] + BIAS))

    def update_occupied(self) -> None:
        """Find the cells that rays may skip."""
        with torch.no_grad():
            seen = (self.alpha() >= EMPTY_ALPHA).float()
            sides = [0 if (n - 1) % CELL == 0 else CELL - (n - 1) % CELL for n in seen.shape]
            padded = functional.pad(seen, (0, sides[2], 0, sides[1], 0, sides[0]))
            cells = functional.max_pool3d(padded[None, None], CELL + 1, CELL)[0, 0]
            self.occupied.copy_(cells)

    def resampled(self, config: GridConfig) -> "SceneGrid":
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
    """The grid of a box with ``long_side`` vertices along its longest side, or more distant ones where these would be
    more than 16 M; or of voxels of this size. Raises ConfigError: a box without a volume, or one that is too large for
    ``voxel_m``, with the size that fits."""
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
    """Refuse a grid that would take too much memory. Raises ConfigError: more than 16 M voxels."""
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


def encode_frequencies(x: torch.Tensor, frequencies: int) -> torch.Tensor:
    """NeRF's gamma: (..., D) in [-1, 1] -> (..., D (1 + 2 F)), x itself and sin, cos of 2^k pi x for k = 0 .. F - 1."""
    rate = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angle = (x[..., None, :] * rate[:, None]).flatten(-2)  # (..., F D)
    return torch.cat((x, torch.sin(angle), torch.cos(angle)), dim=-1)


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Channels that ``encode_frequencies`` gives."""
    return dimensions * (1 + 2 * frequencies)


def relu_layers(c_in: int, width: int, count: int) -> nn.Sequential:
    """``count`` linear layers, each with a ReLU: (..., c_in) -> (..., width). He's initialisation, as NeRF's successors
    have it: with torch's own, a plain MLP learns far slower."""
    layers: list[nn.Module] = []
    for i in range(count):
        layer = nn.Linear(c_in if i == 0 else width, width)
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers)


class Trunk(nn.Module):
    """[feature, gamma_4(x)] -> r, which no direction enters; [r, gamma_2(d)] -> colour.

    ``features`` (X/2, Y/2, Z/2, F) lie on every second vertex of the scene grid.
    """

    size: torch.Tensor

    def __init__(self, config: GridFieldConfig) -> None:
        super().__init__()
        shape = [n // 2 + 1 for n in config.grid.shape]
        self.register_buffer("size", torch.tensor(config.grid.shape, dtype=torch.float32) - 1, persistent=False)
        self.features = nn.Parameter(FEATURE_START * torch.randn(*shape, config.features))
        self.body = relu_layers(config.features + encoded_size(3, POSITION_FREQUENCIES), config.trunk_width, 2)
        direction = encoded_size(3, DIRECTION_FREQUENCIES)
        self.head = nn.Sequential(
            relu_layers(config.trunk_width + direction, COLOUR_WIDTH, 1), nn.Linear(COLOUR_WIDTH, 3)
        )

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """r (..., trunk_width) at voxel coordinates (..., 3) of the scene grid."""
        position = encode_frequencies((points / self.size * 2 - 1).clamp(-1, 1), POSITION_FREQUENCIES)
        return self.body(torch.cat((gather(self.features, points / 2), position), -1))

    def colour(self, r: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """Colours (R, K, 3) in [0, 1] of r (R, K, W), seen in directions (R, 3)."""
        towards = encode_frequencies(functional.normalize(direction, dim=-1), DIRECTION_FREQUENCIES)
        return torch.sigmoid(self.head(torch.cat((r, towards[:, None].expand(*r.shape[:2], -1)), -1)))


class GridField(LearnedField):
    """Geometry and colour of one scene, without classes.

    A ray is *known* where the field can say a class, which this kind nowhere can: its logits are zeros. A kind that can
    overrides ``classify`` and says so (``knows_classes``). Of the sampling only ``near_m`` counts: where rays are
    sampled, the grid says.
    """

    kind: ClassVar[str] = "grid"
    holds_scene = True
    knows_classes = False
    stored_in_half = True
    fitted_steps: torch.Tensor

    def __init__(self, config: GridFieldConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.config: GridFieldConfig = config
        self.grid = SceneGrid(config.grid)
        self.trunk = Trunk(config) if config.features else None
        self.register_buffer("fitted_steps", torch.zeros((), dtype=torch.int64))

    @property
    def fitted(self) -> bool:
        """Whether the grid is of a scene."""
        return int(self.fitted_steps) > 0

    def classify(self, samples: RaySamples, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
        """Class logits (R, L) of rays, composited, and where they are known (R,); the base knows no classes."""
        count = len(samples.light)
        none = torch.zeros(count, dtype=torch.bool, device=samples.z.device)
        return samples.z.new_zeros(count, len(self.label_set)), none

    def known(self, samples: RaySamples) -> torch.Tensor:
        """Where rays (R,) have met something."""
        return (samples.opacity > OPAQUE) & self.fitted

    def encode(self, views: SourceViews) -> EncodedViews:
        """The views' cameras and colours, without features: nothing of them is looked at.
        Raises ShapeError: tensors that do not fit together."""
        check_views(views)
        return encoded_views(views, views.rgb[:, :0])

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """The samples of greatest weight of each ray."""
        found = self.grid.march(rays, kept, jitter)
        if self.fitted:
            return found
        return replace(found, weight=torch.zeros_like(found.weight), light=torch.ones_like(found.light))

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays; differentiable by what asks for gradients."""
        return self.render_marched(self.march(rays), sources)

    def render_marched(self, samples: RaySamples, sources: EncodedViews) -> FieldRender:
        """What marched rays render to."""
        logits, known = self.classify(samples, sources)
        # Samples that were left out are like those that were not.
        weight = ray_fraction(samples)
        sky = self.grid.sky_colour(samples.rays.direction) * (samples.light * self.fitted)[:, None]
        return field_render(
            logits=logits,
            depth_m=composite_depth(weight, samples.z),
            opacity=samples.opacity,
            rgb=(weight[..., None] * self.colour(samples)).sum(1) + sky,
            known=known,
        )

    def colour(self, samples: RaySamples) -> torch.Tensor:
        """Colours (R, K, 3) in [0, 1] of samples."""
        if self.trunk is None:
            return self.grid.colour(samples.points)
        return self.trunk.colour(self.trunk(samples.points), samples.rays.direction)
