"""Draws that training makes from labelled views beyond those of finetuning: crops, spoiled views, frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from semantic_mapper.training.views import LabelledView
from semantic_mapper.types import CameraIntrinsics, SourceViews


def cropped_view(view: LabelledView, fraction: float, down: float, across: float) -> LabelledView:
    """A part of the view at the view's own size, as a longer lens sees it.

    Args:
        fraction: Of each side that is kept, above 0.
        down, across: Place of the part, from 0 (top, left) to 1.
    """
    k = view.intrinsics
    height, width = max(round(fraction * k.height), 1), max(round(fraction * k.width), 1)
    top, left = round(down * (k.height - height)), round(across * (k.width - width))
    part = slice(top, top + height), slice(left, left + width)
    size = (k.height, k.width)
    rgb = functional.interpolate(view.rgb[:, *part][None], size=size, mode="bilinear", align_corners=False)[0]

    def enlarged(values: torch.Tensor) -> torch.Tensor:
        return functional.interpolate(values[part][None, None].float(), size=size, mode="nearest-exact")[0, 0]

    x, y = k.width / width, k.height / height
    lens = CameraIntrinsics(
        k.fx * x, k.fy * y, (k.cx - left + 0.5) * x - 0.5, (k.cy - top + 0.5) * y - 0.5, k.width, k.height
    )
    return LabelledView(
        rgb,
        enlarged(view.depth_m),
        enlarged(view.channel).long(),
        lens,
        view.T_world_camera,
        computed_m=None if view.computed_m is None else enlarged(view.computed_m),
        computed_sigma_m=None if view.computed_sigma_m is None else enlarged(view.computed_sigma_m),
    )


def join_sources(parts: Sequence[SourceViews]) -> SourceViews:
    """The views of several scenes one after the other; labels only where all parts have them."""
    channels = [p.channel for p in parts if p.channel is not None]
    return SourceViews(
        torch.cat([p.rgb for p in parts]),
        torch.cat([p.depth_m for p in parts]),
        torch.cat([p.K for p in parts]),
        torch.cat([p.T_world_camera for p in parts]),
        torch.cat(channels) if len(channels) == len(parts) else None,
        None if all(p.depth_sigma_m is None for p in parts) else torch.cat([_spread(p) for p in parts]),
    )


def _spread(sources: SourceViews) -> torch.Tensor:
    return torch.zeros_like(sources.depth_m) if sources.depth_sigma_m is None else sources.depth_sigma_m


def select_sources(sources: SourceViews, index: torch.Tensor) -> SourceViews:
    """The views at ``index`` (k,) int64."""
    channel = None if sources.channel is None else sources.channel[index]
    spread = None if sources.depth_sigma_m is None else sources.depth_sigma_m[index]
    return SourceViews(
        sources.rgb[index], sources.depth_m[index], sources.K[index], sources.T_world_camera[index], channel, spread
    )


def withhold_labels(sources: SourceViews, fraction: float, generator: torch.Generator) -> SourceViews:
    """Set the known labels of a random fraction of the views to "none": most source views of a robot have none."""
    if sources.channel is None:
        return sources
    keep = (torch.rand(len(sources.rgb), generator=generator) >= fraction).to(sources.channel.device)
    return replace(sources, channel=torch.where(keep[:, None, None], sources.channel, -1))


def degrade_view(sources: SourceViews, index: int, generator: torch.Generator) -> SourceViews:
    """Spoil one view as a moving camera in bad light does, so that the field learns when to believe the others.

    Exposure and gamma, blur, noise, parts of the image covered; depth is lost in one of three cases.
    """

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=generator))

    rgb = sources.rgb[index].cpu()
    height, width = rgb.shape[-2:]
    rgb = rgb.clamp_min(1e-3) ** uniform(0.7, 1.4) * 2 ** uniform(-2.0, 0.5)
    if (sigma := uniform(-1.0, 2.5) * width / 160) > 0.3:
        rgb = blurred(rgb, sigma)
    rgb = rgb + uniform(0.0, 0.1) * torch.randn(rgb.shape, generator=generator)
    for _ in range(int(torch.randint(0, 4, (1,), generator=generator))):
        h, w = int(uniform(0.1, 0.5) * height), int(uniform(0.1, 0.5) * width)
        top, left = int(uniform(0, height - h)), int(uniform(0, width - w))
        rgb[:, top : top + h, left : left + w] = torch.rand(3, 1, 1, generator=generator)
    whole = sources.rgb.clone()
    whole[index] = rgb.clamp(0, 1).to(whole.device)
    depth_m = sources.depth_m
    if uniform(0, 1) < 1 / 3:
        depth_m = depth_m.clone()
        depth_m[index] = 0
    return replace(sources, rgb=whole, depth_m=depth_m)


def blurred(rgb: torch.Tensor, sigma: float) -> torch.Tensor:
    """(3, H, W) with a Gaussian of ``sigma`` pixels."""
    radius = max(1, round(2.5 * sigma))
    x = torch.arange(-radius, radius + 1, dtype=rgb.dtype, device=rgb.device)
    kernel = torch.exp(-(x**2) / (2 * sigma**2))
    kernel = (kernel / kernel.sum()).expand(3, 1, 1, -1)
    padded = functional.pad(rgb[None], (radius, radius, radius, radius), mode="replicate")
    across = functional.conv2d(padded, kernel, groups=3)
    return functional.conv2d(across, kernel.transpose(2, 3), groups=3)[0]


def natural_weights(drawn: torch.Tensor, channel: torch.Tensor, balanced_fraction: float) -> torch.Tensor:
    """(R,) weights that take back what ``draw_pixels`` did to the frequency of classes, in the mean over draws.

    Half of the rays drawn with all classes equally likely teach rare classes, but leave a field that expects them
    everywhere. A ray's weight is the probability of its pixel without balancing over that with it.

    Args:
        drawn: (R,) channels of the drawn pixels, -1 = ignore.
        channel: (H, W) that they were drawn from.
        balanced_fraction: Of ``draw_pixels``.
    """
    labelled = channel[channel >= 0]
    histogram = torch.bincount(labelled, minlength=int(drawn.max()) + 1 if len(drawn) else 1).float()
    classes = (histogram > 0).sum().clamp_min(1)
    favoured = len(labelled) / (classes * histogram.clamp_min(1))  # how much likelier a balanced draw is, by class
    return 1 / (1 - balanced_fraction + balanced_fraction * favoured[drawn.clamp_min(0)])
