"""``GridField``: a scene grid as a field. Kinds that know classes build on it and say what its samples mean."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass
from typing import ClassVar

import msgspec
import torch

from semantic_mapper.config import GridFieldConfig, SamplingConfig
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.grid.march import KEPT, GridRays, March, gather
from semantic_mapper.fields.grid.scene_grid import SceneGrid, grid_box
from semantic_mapper.fields.grid.trunk import Trunk
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.ray_render import field_render
from semantic_mapper.fields.source_maps import check_views, encoded_views, seen_bounds
from semantic_mapper.fields.volume import composite_depth, interval_lengths
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

OPAQUE = 0.5  # opacity from which on a ray has met something


@dataclass(frozen=True, slots=True, eq=False)
class RaySamples:
    """What a kind says the classes of: K samples on each of R rays.

    Args:
        rays: The rays in the world.
        points: (R, K, 3) voxel coordinates.
        z: (R, K) metres.
        weight: (R, K) compositing weights, differentiable by the grid's density.
        light: (R,) what gets through the grid to the sky.
        mover: (R, K) int64 number of the box that moves whose sample it is, -1 = of the scene; None = all are.
    """

    rays: RayBatch
    points: torch.Tensor
    z: torch.Tensor
    weight: torch.Tensor
    light: torch.Tensor
    mover: torch.Tensor | None = None

    @property
    def opacity(self) -> torch.Tensor:
        """(R,) what the grid stops."""
        return 1 - self.light

    def at(self, index: torch.Tensor) -> RaySamples:
        """The samples at positions (R, N) of each ray."""
        points = self.points.gather(1, index[..., None].expand(-1, -1, 3))
        mover = None if self.mover is None else self.mover.gather(1, index)
        z, weight = self.z.gather(1, index), self.weight.gather(1, index)
        return RaySamples(self.rays, points, z, weight, self.light, mover)


class GridField(LearnedField):
    """Geometry and colour of one scene, without classes.

    Colour, depth and opacity are rendered wherever the grid has them. A ray is *known* where the field can say a
    class, which this kind nowhere can: its logits are zeros. A kind that can overrides ``classify``.

    Args:
        config: The box, and whether colours depend on the direction.
        label_set: Classes of the logits.
        sampling: Its ``near_m`` bounds rays; where they are sampled, the grid says.
    """

    kind: ClassVar[str] = "grid"
    holds_scene = True
    knows_classes = False
    stored_in_half = True
    fitted_steps: torch.Tensor

    def __init_subclass__(cls) -> None:
        """A kind that overrides ``classify`` knows classes."""
        super().__init_subclass__()
        cls.knows_classes = cls.classify is not GridField.classify

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
        """Class logits (R, L) of rays, composited, and where they are known (R,).

        Override it, and ``known`` where opacity is not what decides. The base knows no classes.
        """
        count = len(samples.light)
        none = torch.zeros(count, dtype=torch.bool, device=samples.z.device)
        return samples.z.new_zeros(count, len(self.label_set)), none

    def known(self, samples: RaySamples, *, sky: bool = False) -> torch.Tensor:
        """Where rays (R,) have met something; for kinds with a class for the sky, ``sky`` = those that leave, too."""
        opaque = samples.opacity > OPAQUE
        return (opaque | sky) & self.fitted

    def encode(self, views: SourceViews) -> EncodedViews:
        """The views' cameras and colours, without features: nothing of them is looked at.

        Raises:
            ShapeError: tensors that do not fit together.
        """
        check_views(views)
        return encoded_views(views, views.rgb[:, :0])

    def scene_config(self, views: SourceViews, far_m: float) -> GridFieldConfig:
        """This kind, in the box that holds what the views can see, as finely as this field's is divided."""
        low, high = seen_bounds(views, far_m)
        return msgspec.structs.replace(self.config, grid=grid_box(low, high, max(self.config.grid.shape)))

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """The samples of greatest weight of each ray."""
        placed = self.grid.rays(rays, jitter)
        marched = self.grid.march(placed, kept)
        if not self.fitted:
            marched = March(marched.z, torch.zeros_like(marched.weight), torch.ones_like(marched.light))
        return RaySamples(rays, placed.points(marched.z), marched.z, marched.weight, marched.light)

    def sample(self, rays: RayBatch, sources: EncodedViews, generator: torch.Generator | None = None) -> torch.Tensor:
        """Depths (R, K) of the samples of greatest weight."""
        with torch.no_grad():
            return self.march(rays).z

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """Render rays; differentiable by what asks for gradients."""
        return self.render_marched(self.march(rays), sources)

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N), metres; also the compositing weights (R, N)."""
        placed = self.grid.rays(rays)
        samples = self._samples_at(rays, placed, z)
        return self.render_marched(samples, sources), samples.weight

    def render_marched(self, samples: RaySamples, sources: EncodedViews) -> FieldRender:
        """What marched rays render to."""
        logits, known = self.classify(samples, sources)
        # Samples that were left out are like those that were not.
        weight = samples.weight * (samples.opacity / samples.weight.sum(1).clamp_min(1e-6))[:, None]
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

    def _samples_at(self, rays: RayBatch, placed: GridRays, z: torch.Tensor) -> RaySamples:
        """Samples at given depths, each as long as it is to the next one."""
        points = placed.points(z)
        top = points.new_tensor([n - 1 for n in self.config.grid.shape])
        inside = ((points >= 0) & (points <= top)).all(-1)
        raw = gather(self.grid.values, points)[..., 0]
        length = interval_lengths(z, placed.direction.norm(dim=1))
        depth = SceneGrid.optical_depth(raw) * length * inside * self.fitted
        before = torch.cumsum(depth, 1) - depth
        weight = torch.exp(-before) * -torch.expm1(-depth)
        return RaySamples(rays, points, z, weight, 1 - weight.sum(1))
