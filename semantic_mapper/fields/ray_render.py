"""From quantities of samples to what a ray renders to: the end of every field that composites."""

from __future__ import annotations

import torch

from semantic_mapper.fields.volume import composite, composite_depth
from semantic_mapper.types import FieldRender


def composite_render(
    weights: torch.Tensor, z: torch.Tensor, colour: torch.Tensor, logits: torch.Tensor, known: torch.Tensor
) -> FieldRender:
    """Depth and colour composited, logits as they are: explicit zeros where nothing is known.

    Args:
        weights: (R, N) compositing weights, 0 on rays that are not known.
        z: (R, N) metres.
        colour: (R, N, 3) in [0, 1].
        logits: (R, L), already composited.
        known: (R,) bool.
    """
    return field_render(
        logits=logits,
        depth_m=composite_depth(weights, z),
        opacity=weights.sum(dim=1),
        rgb=composite(weights, colour),
        known=known,
    )


def field_render(
    *, logits: torch.Tensor, depth_m: torch.Tensor, opacity: torch.Tensor, rgb: torch.Tensor, known: torch.Tensor
) -> FieldRender:
    """A ``FieldRender`` with zero logits, hence full entropy, where ``known`` (R,) is False."""
    logits = logits * known[:, None]
    log_p = torch.log_softmax(logits, dim=-1)
    return FieldRender(
        logits=logits,
        depth_m=depth_m,
        opacity=opacity,
        rgb=rgb,
        entropy=-(log_p.exp() * log_p).sum(-1),
        known=known,
    )


def weighted_moments(values: torch.Tensor, fraction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and variance over the views, (R, N, C) each, of values (m, R, N, C) that count by share (m, R, N).

    Shares add up to 1 over the views, or are all 0 where no view counts; then both moments are 0.
    """
    mean = torch.einsum("mrn,mrnc->rnc", fraction, values)
    square = torch.einsum("mrn,mrnc->rnc", fraction, values * values)
    return mean, (square - mean * mean).clamp_min(0)
