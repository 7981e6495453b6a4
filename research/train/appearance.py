"""What photographs have and rendered rooms lack: uneven light, textures on everything, other colours, blur and noise.

For steps on single images, where views need not agree with each other. Labels stay as they are, and depth where it is
left: sensors other than the rendered ones lose margins, the distance, what is near, whole surfaces and patches. Pieces
of other pictures lie about, as clutter does that no room holds; they have no label.

Without other colours a network learns the colours of the rooms: the first shipped weights lost 13 of 60 points of mIoU
on a real kitchen where it was shown in grey. So hues turn, some images are grey, and some with depth lose their colours
altogether, so that geometry has to do.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch.nn import functional

from research.train.view_draws import blurred
from semantic_mapper.types import SourceViews

TEXTURED = 0.5  # of the classes in an image
TINT = 0.3  # sigma of the logarithm of a class's colour
TURNED = 0.3  # of the images, by any angle of hue
GREY = 0.15  # of the images
COLOURLESS = 0.1  # of the images with depth: one colour, and noise
LOST = 0.3  # of the images with depth, each of margins, distance, patches, what is near, surfaces, and shadows
SURFACES_LOST = 0.3  # of the classes in such an image: dark, shining or seen at a flat angle
PIECES = 16  # of other pictures in one, at most
PIECE_SIZES = (0.03, 0.2)  # of the width of the picture
LOW_FREQUENCIES = 0.1  # of each side of the spectrum: light and colour, not shapes


def vary_appearance(
    views: SourceViews, channel: torch.Tensor, fraction: float, generator: torch.Generator
) -> SourceViews:
    """A random ``fraction`` of the images with another light, texture, colour and sharpness, and gaps in their depth.

    Args:
        channel: (m, H, W) int64 classes, half of which get a texture and a tint; -1 is one of them.
        generator: Of the CPU, so that draws are the same whatever the device.
    """
    chosen = torch.rand(len(views.rgb), generator=generator) < fraction
    if not bool(chosen.any()):
        return views
    rgb, depth_m = views.rgb.clone(), views.depth_m.clone()
    for i in chosen.nonzero()[:, 0].tolist():
        other = views.rgb[int(torch.randint(len(views.rgb), (1,), generator=generator))]
        rgb[i] = _vary(views.rgb[i], other, channel[i], generator)
        if float(torch.rand(1, generator=generator)) < COLOURLESS and bool(views.depth_m[i].any()):
            plain = torch.rand(3, 1, 1, generator=generator) + 0.1 * torch.randn(rgb[i].shape, generator=generator)
            rgb[i] = plain.clamp(0, 1).to(rgb.device)
        depth_m[i] = _with_gaps(depth_m[i], channel[i], generator)
    return replace(views, rgb=rgb, depth_m=depth_m)


def strew(
    views: SourceViews, channel: torch.Tensor, fraction: float, generator: torch.Generator
) -> tuple[SourceViews, torch.Tensor]:
    """A random ``fraction`` of the images with pieces of others strewn on them, a little nearer than what they hide.

    Of all that was done to pictures of rooms, such pieces cost most (``research/docs/benchmarks.md``).

    Args:
        channel: (m, H, W) int64 classes.

    Returns:
        The views, and their classes with -1 where a piece lies.
    """
    rgb, depth_m, channel = views.rgb.clone(), views.depth_m.clone(), channel.clone()
    height, width = depth_m.shape[1:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    chosen = torch.rand(len(rgb), generator=generator) < fraction
    for i in chosen.nonzero()[:, 0].tolist():
        for _ in range(int(torch.randint(1, PIECES + 1, (1,), generator=generator))):
            other = int(torch.randint(len(rgb), (1,), generator=generator))
            u = torch.rand(9, generator=generator).tolist()
            half = [width / 2 * PIECE_SIZES[0] * (PIECE_SIZES[1] / PIECE_SIZES[0]) ** one for one in u[:2]]
            cos, sin = math.cos(math.pi * u[2]), math.sin(math.pi * u[2])
            right, down = x - u[3] * width, y - u[4] * height
            across, along = (cos * right + sin * down) / half[0], (cos * down - sin * right) / half[1]
            round_ = 2.0 ** (1 + 4 * u[5])  # from an ellipse to a box
            piece = (across.abs() ** round_ + along.abs() ** round_ < 1).to(rgb.device)
            shift = (int(u[6] * height), int(u[7] * width))
            shown = torch.roll(views.rgb[other], shift, (1, 2))
            tint = (TINT * torch.randn(3, 1, 1, generator=generator)).exp().to(rgb.device)
            rgb[i] = torch.where(piece, (shown * tint).clamp(0, 1), rgb[i])
            nearer = 0.75 + 0.25 * u[8] if u[8] > LOST else 0.0  # not measured
            depth_m[i] = torch.where(piece, depth_m[i] * nearer, depth_m[i])
            channel[i] = torch.where(piece, -1, channel[i])
    return replace(views, rgb=rgb, depth_m=depth_m), channel


def _vary(rgb: torch.Tensor, other: torch.Tensor, channel: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=generator))

    size = (rgb.shape[1], rgb.shape[2])
    rgb = mix_amplitudes(rgb, other, uniform(0, 0.5))
    texture = _texture(size, uniform, generator).to(rgb.device)
    classes = channel.unique()
    textured = classes[torch.rand(len(classes), generator=generator).to(classes.device) < TEXTURED]
    for one in textured.tolist():
        tint = (TINT * torch.randn(3, 1, 1, generator=generator)).to(rgb.device)
        rgb = torch.where(channel == one, rgb * (texture + tint).exp(), rgb)
    light = _smooth_noise(size, (3, 4), generator).to(rgb.device) * uniform(0, 0.4)
    rgb = rgb * light.exp()
    if uniform(0, 1) < TURNED:
        rgb = torch.einsum("ij,jhw->ihw", hue_rotation(uniform(-math.pi, math.pi)).to(rgb), rgb)
    grey = rgb.mean(0, keepdim=True)
    rgb = grey + (rgb - grey) * (0.0 if uniform(0, 1) < GREY else uniform(0.3, 1.4))
    rgb = rgb.clamp(1e-3, 1) ** uniform(0.7, 1.5) * uniform(0.6, 1.4)
    rgb = rgb.mean() + (rgb - rgb.mean()) * uniform(0.7, 1.2)
    if (sigma := uniform(-0.8, 1.2) * size[1] / 160) > 0.3:
        rgb = blurred(rgb, sigma)
    noise = torch.randn(rgb.shape, generator=generator).to(rgb.device)
    return (rgb + max(uniform(-0.03, 0.06), 0) * noise).clamp(0, 1)


def _with_gaps(depth_m: torch.Tensor, channel: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """(H, W) without what other sensors do not measure: margins (depth registered to colour), distance, patches, what
    is near, surfaces, and what is seen beside near things."""
    lost = torch.rand(6, generator=generator) < LOST
    amount = torch.rand(6, generator=generator)
    height, width = depth_m.shape
    keep = torch.ones(height, width, dtype=torch.bool)
    if lost[0]:
        margins = (0.1 * torch.rand(2, 2, generator=generator) * torch.tensor([[height], [width]])).long().tolist()
        keep = torch.zeros_like(keep)
        keep[margins[0][0] : height - margins[0][1], margins[1][0] : width - margins[1][1]] = True
    noise = _smooth_noise((height, width), (8, 11), generator)[0]
    if lost[2]:
        keep &= noise > torch.quantile(noise, 0.2 * float(amount[2]))
    keep = keep.to(depth_m.device)
    if lost[3]:
        keep &= depth_m > 0.4 + 0.6 * float(amount[3])
    if lost[4]:
        classes = channel.unique().tolist()
        gone = [one for one in classes if float(torch.rand(1, generator=generator)) < SURFACES_LOST]
        surface = torch.isin(channel, torch.tensor(gone, device=channel.device))
        keep &= ~(surface & (noise < torch.quantile(noise, 0.3 + 0.7 * float(amount[4]))).to(depth_m.device))
    if lost[5]:
        reach = max(1, round(0.04 * width * float(amount[5])))
        away = torch.where(depth_m > 0, depth_m, torch.inf)
        nearest = -functional.max_pool1d(-functional.pad(away, (0, reach), value=torch.inf), reach + 1, 1)
        keep &= depth_m < 1.1 * nearest
    kept = depth_m * keep
    return kept * (kept < 3.0 + 4.0 * float(amount[1])) if lost[1] else kept


def hue_rotation(angle: float) -> torch.Tensor:
    """(3, 3) rotation of colours round the grey axis."""
    cos, sin = math.cos(angle), math.sin(angle)
    same, after, before = (1 + 2 * cos) / 3, (1 - cos) / 3 - sin / math.sqrt(3), (1 - cos) / 3 + sin / math.sqrt(3)
    return torch.tensor(((same, after, before), (before, same, after), (after, before, same)))


def mix_amplitudes(rgb: torch.Tensor, other: torch.Tensor, share: float) -> torch.Tensor:
    """(3, H, W) with ``share`` of the other image's low-frequency amplitudes, phases kept (Yang and Soatto, FDA, CVPR
    2020; mixed as in Xu et al., CVPR 2021)."""
    own, theirs = torch.fft.fft2(rgb), torch.fft.fft2(other)
    rows = torch.fft.fftfreq(rgb.shape[1], device=rgb.device).abs()[:, None] < LOW_FREQUENCIES / 2
    columns = torch.fft.fftfreq(rgb.shape[2], device=rgb.device).abs()[None] < LOW_FREQUENCIES / 2
    weight = share * (rows & columns)
    amplitude = (1 - weight) * own.abs() + weight * theirs.abs()
    return torch.fft.ifft2(torch.polar(amplitude, own.angle())).real.clamp(0, 1)


def _texture(
    size: tuple[int, int], uniform: Callable[[float, float], float], generator: torch.Generator
) -> torch.Tensor:
    """(1, H, W) logarithm of a reflectance: noise of several scales, stretched along one of the axes."""
    strength, stretch = uniform(0, 0.35), 2 ** uniform(-2, 2)
    texture = torch.zeros(1, *size)
    for octave in range(2, 6):
        cells = 2**octave
        grid = (max(2, round(cells * min(stretch, 1))), max(2, round(cells * min(1 / stretch, 1))))
        texture += _smooth_noise(size, grid, generator) * uniform(0, 1)
    return strength * texture / texture.std().clamp_min(1e-6)


def _smooth_noise(size: tuple[int, int], grid: tuple[int, int], generator: torch.Generator) -> torch.Tensor:
    """(1, H, W) normal noise of a coarse grid, interpolated."""
    coarse = torch.randn(1, 1, *grid, generator=generator)
    return functional.interpolate(coarse, size=size, mode="bicubic", align_corners=False)[0]
