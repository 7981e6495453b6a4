"""Panoptic NeRF with samples evenly along rays, as an ablation."""

from __future__ import annotations

import torch
from torch.nn import functional

from semantic_mapper.fields.scene.grid import RaySamples, heaviest
from semantic_mapper.fields.scene.march import BIAS, KEPT, gather
from semantic_mapper.fields.scene.panoptic import LEAST, Panoptic
from semantic_mapper.fields.volume import interval_lengths
from semantic_mapper.training.finetune import FITTERS
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.types import RayBatch


class UniformPanoptic(Panoptic):
    """Samples lie evenly from where a ray enters the grid to its end."""

    kind = "panoptic_uniform"

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """``kept`` samples of each ray; rays with a time meet the boxes that move, too."""
        enter, leave = self.grid.span(rays)
        place = 0.5 if jitter is None else jitter[:, None]
        fraction = (torch.arange(kept, device=enter.device) + place) / kept
        z = enter[:, None] + fraction * (leave - enter).clamp_min(LEAST)[:, None]
        samples = self._samples_at(rays, z)
        return heaviest(self.moving.composite(samples, kept), kept) if self.fitted else samples

    def _samples_at(self, rays: RayBatch, z: torch.Tensor) -> RaySamples:
        """Samples at given depths, each as long as it is to the next one."""
        points = self.grid.points(rays, z)
        top = points.new_tensor([n - 1 for n in self.config.grid.shape])
        inside = ((points >= 0) & (points <= top)).all(-1)
        raw = gather(self.grid.values, points)[..., 0]
        length = interval_lengths(z, (rays.direction / self.grid.config.voxel_m).norm(dim=1))
        depth = functional.softplus(raw + BIAS) * length * inside * self.fitted
        before = torch.cumsum(depth, 1) - depth
        weight = torch.exp(-before) * -torch.expm1(-depth)
        return RaySamples(rays, points, z, weight, 1 - weight.sum(1))


FITTERS[UniformPanoptic.kind] = fit_panoptic
