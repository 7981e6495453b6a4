"""Labelled views as tensors, and the draws that training makes from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional

from semantic_mapper.fields.source_maps import UNSURE_SPREAD
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.imaging import resize_depth, resize_label, resize_rgb, resize_spread, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.rays import pixel_rays
from semantic_mapper.types import CameraIntrinsics, PosedFrame, RayBatch, SourceViews


@dataclass(frozen=True, slots=True, eq=False)
class LabelledView:
    """One posed image at training resolution.

    Args:
        rgb: (3, H, W) float32 in [0, 1].
        depth_m: (H, W) float32, 0 = none.
        channel: (H, W) int64 class channels, -1 = ignore.
        intrinsics: Of (H, W).
        T_world_camera: (4, 4) float32.
        uncertainty: (H, W) float32 how likely a pixel is drawn among the hard examples
            (``uncertainty.with_uncertainty``); None = never.
        computed_m: (H, W) float32 depth that was computed from pictures, 0 = none: what a field is given in the place
            of ``depth_m``, which remains what it is to render. None = a field is given ``depth_m``.
        computed_sigma_m: (H, W) float32 its one-sigma spread.
    """

    rgb: torch.Tensor
    depth_m: torch.Tensor
    channel: torch.Tensor
    intrinsics: CameraIntrinsics
    T_world_camera: torch.Tensor
    uncertainty: torch.Tensor | None = None
    computed_m: torch.Tensor | None = None
    computed_sigma_m: torch.Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RayTargets:
    """What R query rays should render to: channel (R,) int64, rgb (R, 3), depth_m (R,) with 0 = none.

    ``weight`` (R,) is what each counts in the class loss; None = all alike.
    """

    channel: torch.Tensor
    rgb: torch.Tensor
    depth_m: torch.Tensor
    weight: torch.Tensor | None = None


def view_from_frame(frame: PosedFrame, label_set: LabelSet, width: int) -> LabelledView:
    """Resize a frame to the working width; colours by area, depth and labels by nearest pixel.

    Depth that was computed from pictures is what the view should render to where it is sure.
    """
    intrinsics = working_intrinsics(frame.intrinsics, width)
    if frame.label is None:
        channel = np.full((intrinsics.height, intrinsics.width), -1, np.int64)
    else:
        channel = label_set.to_channels(resize_label(frame.label, intrinsics), f"frame seq={frame.seq}")
    depth_m = torch.tensor(resize_depth(frame, intrinsics))  # a copy: the frame's own array is read-only
    spread = resize_spread(frame, intrinsics)
    sigma_m = None if spread is None else torch.tensor(spread)
    return LabelledView(
        torch.from_numpy(resize_rgb(frame, intrinsics)).permute(2, 0, 1).float().div_(255).contiguous(),
        depth_m if sigma_m is None else depth_m * (sigma_m <= UNSURE_SPREAD * depth_m),
        torch.from_numpy(channel),
        intrinsics,
        torch.tensor(frame.T_world_camera, dtype=torch.float32),
        computed_m=None if sigma_m is None else depth_m,
        computed_sigma_m=sigma_m,
    )


def mirrored_view(view: LabelledView) -> LabelledView:
    """The view in the mirror image of the world (x to -x): left and right change sides, geometry stays consistent."""
    k = view.intrinsics
    mirror = torch.diag(view.T_world_camera.new_tensor((-1.0, 1.0, 1.0, 1.0)))
    return LabelledView(
        view.rgb.flip(-1),
        view.depth_m.flip(-1),
        view.channel.flip(-1),
        CameraIntrinsics(k.fx, k.fy, k.width - 1 - k.cx, k.cy, k.width, k.height),
        mirror @ view.T_world_camera @ mirror,
        computed_m=None if view.computed_m is None else view.computed_m.flip(-1),
        computed_sigma_m=None if view.computed_sigma_m is None else view.computed_sigma_m.flip(-1),
    )


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


def stack_sources(views: Sequence[LabelledView], *, with_labels: bool = False) -> SourceViews:
    """Views of one resolution as the input of ``SemanticField.encode``, with what is known of their labels if asked."""
    return SourceViews(
        torch.stack([v.rgb for v in views]),
        torch.stack([v.depth_m if v.computed_m is None else v.computed_m for v in views]),
        torch.stack([torch.from_numpy(camera_matrix(v.intrinsics)).float() for v in views]).to(views[0].rgb.device),
        torch.stack([v.T_world_camera for v in views]),
        torch.stack([v.channel for v in views]) if with_labels else None,
        _stacked_spreads(views),
    )


def _stacked_spreads(views: Sequence[LabelledView]) -> torch.Tensor | None:
    if all(v.computed_sigma_m is None for v in views):
        return None
    return torch.stack(
        [torch.zeros_like(v.depth_m) if v.computed_sigma_m is None else v.computed_sigma_m for v in views]
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


def withhold_depth(sources: SourceViews, fraction: float, generator: torch.Generator) -> SourceViews:
    """Set the depth of a random fraction of the views to "none", so that the field learns to work without."""
    keep = torch.rand(len(sources.depth_m), generator=generator) >= fraction
    return replace(sources, depth_m=sources.depth_m * keep.to(sources.depth_m.device)[:, None, None])


def jitter_colours(sources: SourceViews, strength: float, generator: torch.Generator) -> SourceViews:
    """Random gain a view and channel, and gamma a view: exposure and white balance drift."""
    return replace(sources, rgb=jittered(sources.rgb, strength, generator))


def jittered(rgb: torch.Tensor, strength: float, generator: torch.Generator) -> torch.Tensor:
    """Colours (m, 3, H, W) of ``jitter_colours``."""
    count = len(rgb)
    gain = 1 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    tint = 1 + 0.5 * strength * (2 * torch.rand(count, 3, 1, 1, generator=generator) - 1)
    gamma = 1 + strength * (2 * torch.rand(count, 1, 1, 1, generator=generator) - 1)
    rgb = (rgb.clamp_min(1e-3) ** gamma.to(rgb.device)) * (gain * tint).to(rgb.device)
    return rgb.clamp(0, 1)


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


def draw_pixels(
    channel: torch.Tensor, count: int, balanced_fraction: float, generator: torch.Generator, classes: int
) -> torch.Tensor:
    """Flat indices of labelled pixels (count,): partly uniform, partly with every class present equally likely.

    Args:
        channel: (H, W) int64, -1 = not to be drawn.
        classes: L.
    """
    flat = channel.flatten()
    labelled = (flat >= 0).nonzero()[:, 0]
    if len(labelled) == 0:
        return labelled
    uniform = labelled[torch.randint(len(labelled), (count - int(count * balanced_fraction),), generator=generator)]
    histogram = torch.bincount(flat[labelled], minlength=classes).float()
    weight = torch.where(histogram > 0, 1 / histogram.clamp_min(1), torch.zeros_like(histogram))[flat[labelled]]
    cumulative = torch.cumsum(weight.double(), 0)
    u = torch.rand(int(count * balanced_fraction), generator=generator, dtype=torch.float64) * cumulative[-1]
    balanced = labelled[torch.searchsorted(cumulative, u).clamp_max(len(labelled) - 1)]
    return torch.cat((uniform, balanced))


def draw_hard_examples(doubt: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """Flat indices (count,) of pixels of ``doubt`` (H, W), each as likely as its doubt is high."""
    cumulative = torch.cumsum(doubt.flatten().double(), 0)
    u = torch.rand(count, generator=generator, dtype=torch.float64) * cumulative[-1]
    return torch.searchsorted(cumulative, u, right=True).clamp_max(len(cumulative) - 1)


def query_rays(
    view: LabelledView, flat_index: torch.Tensor, *, near_m: float, far_m: float, prior: torch.Tensor | None
) -> tuple[RayBatch, RayTargets]:
    """Rays through chosen pixels of a view, with what they should render to.

    Args:
        flat_index: (R,) row-major pixel indices.
        prior: (R,) depth priors in metres, 0 = none; None for none at all.
    """
    width = view.intrinsics.width
    pixels = torch.stack((flat_index % width, flat_index // width), dim=-1).float()
    rays = pixel_rays(pixels, view.intrinsics, view.T_world_camera, near_m=near_m, far_m=far_m, prior_depth_m=prior)
    targets = RayTargets(
        view.channel.flatten()[flat_index],
        view.rgb.flatten(1)[:, flat_index].T.contiguous(),
        view.depth_m.flatten()[flat_index],
    )
    return rays, targets
