"""What the source views know of the samples of a ray, for fields that take S-Ray's geometry-aware network as it is."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
from dataclasses import dataclass

import torch

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.geometry_net import LEAST_VISIBILITY, hit_and_visibility
from semantic_mapper.fields.projection import gather, reproject
from semantic_mapper.fields.volume import interval_lengths
from semantic_mapper.types import RayBatch

CUES = 4  # hit, visibility, view cosine, spread of the depth: what a view knows of a sample beside its feature


@dataclass(frozen=True, slots=True, eq=False)
class ContextualSpace:
    """The space M of Eq. 5 with what goes with it, view-first.

    Args:
        feature: (m, R, N, C).
        rgb: (m, R, N, 3).
        cues: (m, R, N, 4).
        hit, visibility: (m, R, N) in [0, 1].
        valid: (m, R, N) bool.
        delta: (R, N) interval lengths, metres.
        channel: (m, R, N) int64 known label at the sample, -1 = none.
    """

    feature: torch.Tensor
    rgb: torch.Tensor
    cues: torch.Tensor
    hit: torch.Tensor
    visibility: torch.Tensor
    valid: torch.Tensor
    delta: torch.Tensor
    channel: torch.Tensor


def contextual_space(rays: RayBatch, z: torch.Tensor, sources: EncodedViews) -> ContextualSpace:
    """Reproject samples z (R, N) of whole rays into all views and gather M (S-Ray Eq. 3 to 5)."""
    where = reproject(rays, z, sources)
    found = gather(sources, where)
    delta = interval_lengths(z, rays.direction.norm(dim=-1))
    hit, visibility = hit_and_visibility(found.geometry, where.z, 0.5 * delta)
    hit, visibility = hit * where.valid, visibility * where.valid
    cues = torch.stack((hit, visibility, where.view_cosine, torch.log(found.geometry[..., 1])), dim=-1)
    return ContextualSpace(found.feature, found.rgb, cues, hit, visibility, where.valid, delta, found.channel)


def visibility_share(visibility: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Weights of the views at each sample, in proportion to their visibility: (m, R, N), sum 1 over valid views."""
    weight = (visibility + LEAST_VISIBILITY) * valid
    return weight / weight.sum(0).clamp_min(1e-6)
