"""What the peers make of samples in the same way: density, moments over the views, and a render without labels."""

from __future__ import annotations

import torch

from semantic_mapper.fields.volume import composite, composite_depth, field_render
from semantic_mapper.types import FieldRender

DENSITY_START = 2.0  # log density of an untrained network: 7 / m, a third of the light gone after 5 cm
DENSITY_LIMIT = 8.0  # 3,000 / m: opaque within 1 mm, and no overflow


def density_from(raw: torch.Tensor) -> torch.Tensor:
    """Network output -> density in 1 / m, positive.

    An exponential where NeRF has a ReLU: scenes are in metres here, and samples may stand a centimetre apart, so
    densities from 0.1 / m to 1,000 / m have to be in reach of one learning rate.
    """
    return torch.exp((raw + DENSITY_START).clamp(max=DENSITY_LIMIT))


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


def weighted_moments(values: torch.Tensor, fraction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and variance over the views, (R, N, C) each, of values (m, R, N, C) that count by share (m, R, N).

    Shares add up to 1 over the views, or are all 0 where no view counts; then both moments are 0.
    """
    mean = torch.einsum("mrn,mrnc->rnc", fraction, values)
    square = torch.einsum("mrn,mrnc->rnc", fraction, values * values)
    return mean, (square - mean * mean).clamp_min(0)
