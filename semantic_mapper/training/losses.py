"""What a rendered ray, and an image by itself, is compared with."""

from dataclasses import dataclass

import torch
from torch.nn import functional

from semantic_mapper.training.views import RayTargets
from semantic_mapper.types import FieldRender

IGNORE = -1
GUESS_WIDTH = 0.01  # least relative spread of a guessed depth
RAREST = 1e-3  # fraction of the pixels below which a class is not weighted up further
SEMANTIC, COLOUR, DEPTH = 0.25, 0.75, 0.1  # weights of the parts of ``ray_loss``


@dataclass(frozen=True, slots=True, eq=False)
class Loss:
    """The total and its parts, each a scalar tensor."""

    total: torch.Tensor
    semantic: torch.Tensor
    colour: torch.Tensor
    depth: torch.Tensor


def semantic_loss(logits: torch.Tensor, channel: torch.Tensor, weight: torch.Tensor | None = None) -> torch.Tensor:
    """Cross-entropy over the rays (S-Ray Eq. 14), ignored rays masked; 0 where all are ignored.
    ``weight``: (R,) what each ray counts; None = all alike."""
    if weight is not None:
        each = functional.cross_entropy(logits, channel, ignore_index=IGNORE, reduction="none")
        weight = weight * (channel != IGNORE)
        return (each * weight).sum() / weight.sum().clamp_min(1e-6)
    counted = (channel != IGNORE).sum().clamp_min(1)
    return functional.cross_entropy(logits, channel, ignore_index=IGNORE, reduction="sum") / counted


def image_loss(logits: torch.Tensor, channel: torch.Tensor, balance: float) -> torch.Tensor:
    """Cross-entropy of logits (m, L, h, w) over labelled pixels (m, H, W), 0 without any.
    ``balance``: A class counts by its fraction of the pixels to the power of minus this: 0 as it comes, 1 all alike."""
    size = logits.shape[-2:]
    small = functional.interpolate(channel[:, None].float(), size=size, mode="nearest-exact")[:, 0].long()
    labelled = small != IGNORE
    if balance <= 0:
        total = functional.cross_entropy(logits, small, ignore_index=IGNORE, reduction="sum")
        return total / labelled.sum().clamp_min(1)
    fraction = torch.bincount(small[labelled], minlength=logits.shape[1]) / labelled.sum().clamp_min(1)
    weight = (fraction.to(logits.dtype) + RAREST) ** -balance
    total = functional.cross_entropy(logits, small, weight, ignore_index=IGNORE, reduction="sum")
    return total / (weight * fraction).sum().clamp_min(1e-6) / labelled.sum().clamp_min(1)


def guess_loss(geometry: torch.Tensor, given_m: torch.Tensor, depth_m: torch.Tensor) -> torch.Tensor:
    """Negative log likelihood of the true depth of views that were given none; 0 without such views.

    A Laplace distribution of log depth round the field's guess, as wide as the field says. ``geometry``: (m, G, h, w)
    of ``EncodedViews``. ``given_m, depth_m``: (m, H, W) that the field was given, and that was measured; 0 = none.
    """
    size = geometry.shape[-2:]
    target = functional.interpolate(depth_m[:, None], size=size, mode="nearest-exact")[:, 0]
    guessed = (target > 0) & ~(given_m > 0).flatten(1).any(1)[:, None, None]
    width = (geometry[:, 1] / geometry[:, 0]).clamp_min(GUESS_WIDTH)
    error = (geometry[:, 0].log() - target.clamp_min(1e-3).log()).abs()
    each = error / width + width.log()
    return (each * guessed).sum() / guessed.sum().clamp_min(1)


def ray_loss(
    render: FieldRender, targets: RayTargets, weights: tuple[float, float, float] = (SEMANTIC, COLOUR, DEPTH)
) -> Loss:
    """Weighted sum of the semantic, colour and depth losses over rays that some view sees; depth is compared in inverse
    metres, where it is measured."""
    known = render.known
    channel = torch.where(known, targets.channel, torch.full_like(targets.channel, IGNORE))
    semantic = semantic_loss(render.logits, channel, targets.weight)
    count = known.sum().clamp_min(1)
    colour = (((render.rgb - targets.rgb) ** 2).mean(-1) * known).sum() / count
    measured = known & (targets.depth_m > 0) & (render.opacity > 0.1)
    inverse = (1 / render.depth_m.clamp_min(0.1) - 1 / targets.depth_m.clamp_min(0.1)).abs()
    depth = (inverse * measured).sum() / measured.sum().clamp_min(1)
    total = weights[0] * semantic + weights[1] * colour + weights[2] * depth
    return Loss(total, semantic, colour, depth)
