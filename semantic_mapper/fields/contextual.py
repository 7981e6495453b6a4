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
SURFACE_CUES = CUES + 1  # and whether the view is the query's own, for a token at the surface
BACKGROUND_M = 1e4  # where a ray ends that meets nothing
OWN_RADIUS_M = 1e-3  # a view whose camera is that near to the ray's origin is the query's own


@dataclass(frozen=True, slots=True, eq=False)
class ContextualSpace:
    """The space M of Eq. 5 with what goes with it, view-first.

    Args:
        feature: (m, R, N, C).
        rgb: (m, R, N, 3).
        cues: (m, R, N, CUES); of tokens at the surface SURFACE_CUES.
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


def background_space(rays: RayBatch, sources: EncodedViews) -> ContextualSpace:
    """What the views hold in the direction of each ray, infinitely far away: M with N = 1.

    The sky, or what lies beyond the sensor's range: it has no depth, but every view that looks that way has an opinion.
    """
    where = reproject(rays, rays.origin.new_full((len(rays.origin), 1), BACKGROUND_M), sources)
    found = gather(sources, where)
    hit, visibility = hit_and_visibility(found.geometry, where.z, where.z.new_zeros(()))
    visibility = visibility * where.valid
    cues = torch.stack((hit, visibility, where.view_cosine, torch.log(found.geometry[..., 1])), dim=-1)
    nowhere = rays.origin.new_zeros(len(rays.origin), 1)
    channel = torch.full_like(found.channel, -1)
    return ContextualSpace(found.feature, found.rgb, cues, hit, visibility, where.valid, nowhere, channel)


def surface_space(
    space: ContextualSpace, weights: torch.Tensor, rays: RayBatch, sources: EncodedViews, *, occlusion: bool
) -> ContextualSpace:
    """M with one token a view (N = 1): its samples composited, what lies infinitely far behind them included.

    The query's own view sees all of its ray, wherever that ends: its samples land on one pixel. So it outweighs the
    others where no depth is known and their visibilities are guesses.

    Args:
        space: Of N samples a ray.
        weights: (R, N) compositing weights; what they leave of 1 belongs to the background.
        occlusion: Whether a view's samples count by how much it sees of them. Without, its visibility is how much of
            the ray lies inside its image.
    """
    far = background_space(rays, sources)
    rest = (1 - weights.sum(1, keepdim=True)).clamp_min(0)
    weight = torch.cat((weights, rest), dim=1)

    def both(name: str) -> torch.Tensor:
        return torch.cat((getattr(space, name), getattr(far, name)), dim=2)

    T = sources.T_camera_world
    origin = torch.einsum("mij,rj->mri", T[:, :3, :3], rays.origin) + T[:, None, :3, 3]
    own = origin.square().sum(-1) < OWN_RADIUS_M**2  # (m, R)
    valid, hit = both("valid"), both("hit")
    visibility = torch.where(own[..., None], valid.to(hit.dtype), both("visibility"))
    seen = weight * valid  # (m, R, N + 1)
    share = seen * (visibility + LEAST_VISIBILITY) if occlusion else seen
    share = share / share.sum(2, keepdim=True).clamp_min(1e-12)

    def mean(values: torch.Tensor) -> torch.Tensor:
        return torch.einsum("mrn,mrnc->mrc", share, values)

    visible, hits = (seen * visibility).sum(2), (seen * hit).sum(2)
    geometry = mean(both("cues")[..., 2:CUES])
    cues = torch.cat((torch.stack((hits, visible), dim=-1), geometry, own.to(hits.dtype)[..., None]), dim=-1)
    return ContextualSpace(
        feature=mean(both("feature"))[:, :, None],
        rgb=mean(both("rgb"))[:, :, None],
        cues=cues[:, :, None],
        hit=hits[..., None],
        visibility=(visible if occlusion else seen.sum(2))[..., None],
        valid=(seen.sum(2) > 0)[..., None],
        delta=far.delta,
        channel=far.channel,
    )


def visibility_share(visibility: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Weights of the views at each sample, in proportion to their visibility: (m, R, N), sum 1 over valid views."""
    weight = (visibility + LEAST_VISIBILITY) * valid
    return weight / weight.sum(0).clamp_min(1e-6)
