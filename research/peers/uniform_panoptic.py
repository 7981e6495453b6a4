"""Panoptic NeRF with samples evenly along rays, as an ablation."""

from __future__ import annotations

import torch

from semantic_mapper.fields.scene.grid import RaySamples, heaviest
from semantic_mapper.fields.scene.march import KEPT
from semantic_mapper.fields.scene.panoptic import LEAST, Panoptic
from semantic_mapper.types import RayBatch


class UniformPanoptic(Panoptic):
    """Samples lie evenly from where a ray enters the grid to its end."""

    kind = "panoptic_uniform"

    def march(self, rays: RayBatch, kept: int = KEPT, jitter: torch.Tensor | None = None) -> RaySamples:
        """``kept`` samples of each ray; rays with a time meet the boxes that move, too."""
        enter, leave = self.span(rays)
        place = 0.5 if jitter is None else jitter[:, None]
        fraction = (torch.arange(kept, device=enter.device) + place) / kept
        z = enter[:, None] + fraction * (leave - enter).clamp_min(LEAST)[:, None]
        samples = self.samples_at(rays, self.grid.rays(rays), z)
        return heaviest(self.moving.composite(samples, kept), kept) if self.fitted else samples
