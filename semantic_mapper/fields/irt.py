"""Implicit Ray-Transformer (Qi et al. 2023): a few labelled views of one scene label all the others.

A scene grid with features, fitted to the colours of all frames, stays as it is. Along a ray its points of greatest
weight become tokens; they attend to each other and to the texture of the ray's own pixel, where the image is there.
Composited like colours, beside that texture, they give the classes.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import GridConfig, IRTConfig, SamplingConfig
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.carried_labels import CarriedLabels
from semantic_mapper.fields.grid.field import GridField, RaySamples
from semantic_mapper.fields.grid.march import gather
from semantic_mapper.fields.nerf_math import relu_layers
from semantic_mapper.fields.source_maps import check_views, encoded_views
from semantic_mapper.fields.unet_field import own_view
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import RayBatch, SourceViews

TEXTURE = 32  # channels of an image's texture
GREY = 0.5
NEAR_VOXELS, NEAR_SHARE = 1.0, 0.02  # from a measured depth within which samples count: voxels, fraction of depth
VOTE_START = 4.0  # logits of a class that all votes are for


@dataclass(frozen=True, slots=True, eq=False)
class RayTexture:
    """Texture (R, 32) of each ray's own pixel, 0 where ``there`` (R,) is False: its image is not among the views."""

    values: torch.Tensor
    there: torch.Tensor


class IRT(GridField):
    """Classes of one scene from its geometry, its colours and the texture of the query's own image.

    Args:
        config: The box, the variant, sizes.
        label_set: Classes of the logits.
        sampling: As of ``GridField``.
    """

    kind = "irt"
    reads_own_view = True
    class_rows = ("classifier.weight", "classifier.bias")

    def __init__(self, config: IRTConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.shape = config
        assert self.trunk is not None
        width, classes = config.width, len(label_set)
        has_token, joined = config.variant in ("RTT", "RTTC"), config.variant in ("BC", "RTC", "RTTC")
        self.texture = TextureNet(config.texture) if has_token or joined else None
        self.image_head = nn.Linear(TEXTURE, classes) if self.texture is not None else None
        self.points = PointNet(config) if config.variant in ("B", "BC") else RayTransformer(config, token=has_token)
        self.beyond = nn.Parameter(torch.zeros(width))  # what light that no point stops stands for
        self.carried = CarriedLabels(config.carried, config.carried_size, classes) if config.carried else None
        self.vote = vote_layer(self.carried.channels, classes) if self.carried is not None else None
        self.classifier = nn.Linear(width + (TEXTURE if joined else 0), classes)
        self._joined = joined

    def encode(self, views: SourceViews) -> EncodedViews:
        """The views' cameras, colours and, as ``feature``, the texture (m, 32, H, W) of their images.

        Raises:
            ShapeError: tensors that do not fit together.
        """
        check_views(views)
        return encoded_views(views, views.rgb[:, :0] if self.texture is None else self.texture(views.rgb))

    def classify(self, samples: RaySamples, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
        """Class logits (R, L), and where they are known (R,): where a ray meets something, where its depth was
        measured, or where its image is there."""
        texture = self.texture_of(samples.rays, sources)
        samples = at_measured(samples, self.grid.config)
        logits = self.logits(samples, texture, self.carried_to(samples))
        seen = texture.there & self.crosses(samples.rays) & self.fitted
        return logits, self.known(samples) | seen

    def logits(self, samples: RaySamples, texture: RayTexture, carried: torch.Tensor | None) -> torch.Tensor:
        """Class logits (R, L) of rays, given the texture of their pixels and the labels carried to them."""
        samples = self.selected(samples)
        assert self.trunk is not None
        r = self.trunk(samples.points)
        share = samples.weight * (samples.opacity / samples.weight.sum(1).clamp_min(1e-6))[:, None]
        s = self.points(r, samples.weight > 0, texture)
        parts = [torch.einsum("rk,rkc->rc", share, s) + samples.light[:, None] * self.beyond]
        if self._joined:
            parts.append(texture.values)
        logits = self.classifier(torch.cat(parts, 1))
        return logits if carried is None or self.vote is None else logits + self.vote(carried)

    def selected(self, samples: RaySamples) -> RaySamples:
        """The points that are looked at: k a ray."""
        k = self.shape.points
        if samples.z.shape[1] <= k:
            return samples
        rank = samples.weight if self.shape.select == "weight" else self._density(samples)
        index = rank.topk(k, dim=1).indices.sort(dim=1).values
        points = samples.points.gather(1, index[..., None].expand(-1, -1, 3))
        return RaySamples(
            samples.rays, points, samples.z.gather(1, index), samples.weight.gather(1, index), samples.light
        )

    def texture_of(self, rays: RayBatch, sources: EncodedViews) -> RayTexture:
        """Texture of each ray's own pixel."""
        if self.texture is None or sources.feature.shape[1] == 0:
            return no_texture(rays)
        index, same = own_view(rays, sources)
        uv, inside = _pixels(rays, sources, index)
        return texture_at(sources.feature, index, uv, same & inside)

    def carried_to(self, samples: RaySamples) -> torch.Tensor | None:
        """What labelled frames say of rays (R, L + 1); None without any."""
        if self.carried is None:
            return None
        return self.carried(surface(samples), torch.ones(self.shape.carried, device=samples.z.device))

    def crosses(self, rays: RayBatch) -> torch.Tensor:
        """Whether rays (R,) meet the box."""
        box = self.config.grid
        low = rays.origin.new_tensor(box.origin_m)
        high = low + box.voxel_m * (rays.origin.new_tensor(box.shape) - 1)
        slope = torch.where(rays.direction.abs() < 1e-9, torch.full_like(rays.direction, 1e-9), rays.direction)
        a, b = (low - rays.origin) / slope, (high - rays.origin) / slope
        enter, leave = torch.minimum(a, b).amax(1), torch.maximum(a, b).amin(1)
        return (leave > enter) & (leave > rays.near_m)

    def _density(self, samples: RaySamples) -> torch.Tensor:
        raw = gather(self.grid.values, samples.points)[..., 0]
        return torch.where(samples.weight > 0, raw, torch.full_like(raw, -torch.inf))


def surface(samples: RaySamples) -> torch.Tensor:
    """Points (R, 3) of the world where rays end: measured depth where it is known, else that of the grid."""
    mean = (samples.weight * samples.z).sum(1) / samples.weight.sum(1).clamp_min(1e-6)
    prior = samples.rays.prior_depth_m
    z = torch.where(prior > 0, prior, mean)
    return samples.rays.origin + z[:, None] * samples.rays.direction


def at_measured(samples: RaySamples, box: GridConfig) -> RaySamples:
    """Rays whose depth was measured, inside the box, end there; depth that was filled in from other pixels ends none.

    Samples elsewhere fade, and one more at that depth takes the rest.
    """
    rays = samples.rays
    prior = rays.prior_depth_m if rays.measured is None else rays.prior_depth_m * rays.measured
    xyz = samples.rays.origin + prior[:, None] * samples.rays.direction
    point = (xyz - xyz.new_tensor(box.origin_m)) / box.voxel_m
    measured = (prior > 0) & ((point >= 0) & (point <= point.new_tensor(box.shape) - 1)).all(1)
    spread = NEAR_VOXELS * box.voxel_m + NEAR_SHARE * prior[:, None]
    near = torch.exp(-(((samples.z - prior[:, None]) / spread) ** 2))
    weight = torch.where(measured[:, None], samples.weight * near, samples.weight)
    rest = ((1 - weight.sum(1)) * measured).clamp_min(0)
    return RaySamples(
        samples.rays,
        torch.cat((samples.points, point[:, None]), 1),
        torch.cat((samples.z, prior[:, None]), 1),
        torch.cat((weight, rest[:, None]), 1),
        samples.light * ~measured,
    )


def vote_layer(channels: int, classes: int) -> nn.Linear:
    """Carried votes (R, L + 1) -> logits; it starts by believing them."""
    layer = nn.Linear(channels, classes, bias=False)
    nn.init.zeros_(layer.weight)
    with torch.no_grad():
        layer.weight[:, :classes] = VOTE_START * torch.eye(classes)
    return layer


def no_texture(rays: RayBatch) -> RayTexture:
    """That of rays whose images nobody has."""
    count = len(rays.near_m)
    none = torch.zeros(count, dtype=torch.bool, device=rays.near_m.device)
    return RayTexture(rays.near_m.new_zeros(count, TEXTURE), none)


def texture_at(feature: torch.Tensor, view: torch.Tensor, uv: torch.Tensor, there: torch.Tensor) -> RayTexture:
    """Texture of maps (m, C, H, W) at pixels uv (R, 2) of views (R,), bilinear."""
    height, width = feature.shape[-2:]
    u, v = uv[:, 0].clamp(0, width - 1), uv[:, 1].clamp(0, height - 1)
    left, top = u.floor().long(), v.floor().long()
    right, below = (left + 1).clamp_max(width - 1), (top + 1).clamp_max(height - 1)
    du, dv = (u - left)[:, None], (v - top)[:, None]

    def at(row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
        return feature[view, :, row, column]

    above = at(top, left) * (1 - du) + at(top, right) * du
    under = at(below, left) * (1 - du) + at(below, right) * du
    return RayTexture((above * (1 - dv) + under * dv) * there[:, None], there)


def _pixels(rays: RayBatch, sources: EncodedViews, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pixel uv (R, 2) of each ray in the view that it was taken from, and whether it lies in the image (R,)."""
    d = torch.einsum("rij,rj->ri", sources.T_camera_world[index, :3, :3], rays.direction)
    K = sources.K[index]
    z = d[:, 2].clamp_min(1e-6)
    u, v = K[:, 0, 0] * d[:, 0] / z + K[:, 0, 2], K[:, 1, 1] * d[:, 1] / z + K[:, 1, 2]
    height, width = sources.feature.shape[-2:]
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    return torch.stack((u, v), 1), inside


class TextureNet(nn.Module):
    """Texture of images: three convolutions, or ("colour") a network of each pixel's colour.

    Images are continued beyond their edges, so that a pixel's texture is that of its patch wherever it lies.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        sizes, kernel = ((3, 16, TEXTURE), 1) if kind == "colour" else ((3, 16, 32, TEXTURE), 3)
        layers: list[nn.Module] = []
        for c_in, c_out in pairwise(sizes):
            layers += [nn.Conv2d(c_in, c_out, kernel), nn.ReLU()]
        self.net = nn.Sequential(*layers)
        self.margin = (kernel // 2) * (len(sizes) - 1)  # pixels on either side that a pixel's texture depends on

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        """(m, 3, H, W) -> (m, 32, H, W)."""
        return self.net(functional.pad(rgb - GREY, (self.margin,) * 4, mode="replicate"))

    def of_patches(self, patches: torch.Tensor) -> torch.Tensor:
        """Texture (R, 32) in the middle of patches (R, 3, 2 margin + 1, 2 margin + 1)."""
        return self.net(patches - GREY)[:, :, 0, 0]


class PointNet(nn.Module):
    """Points by themselves: variant B."""

    def __init__(self, config: IRTConfig) -> None:
        super().__init__()
        self.net = nn.Sequential(
            relu_layers(config.trunk_width, config.width, 1), nn.Linear(config.width, config.width)
        )

    def forward(self, r: torch.Tensor, there: torch.Tensor, texture: RayTexture) -> torch.Tensor:
        """(R, k, trunk_width) -> (R, k, width)."""
        return self.net(r)


class RayTransformer(nn.Module):
    """Points of a ray attend to each other, and to a token of the texture of its pixel.

    Args:
        config: Sizes.
        token: Whether there is one.
    """

    def __init__(self, config: IRTConfig, *, token: bool) -> None:
        super().__init__()
        width = config.width
        self.enter = nn.Linear(config.trunk_width, width)
        self.token = nn.Linear(TEXTURE, width, bias=False) if token else None
        self.token_type = nn.Parameter(0.02 * torch.randn(width)) if token else None
        self.layers = nn.ModuleList(Attention(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, r: torch.Tensor, there: torch.Tensor, texture: RayTexture) -> torch.Tensor:
        """(R, k, trunk_width) -> (R, k, width); points that are not ``there`` (R, k) are not attended to."""
        x = self.enter(r)
        if self.token is not None:
            c = (self.token(texture.values) + self.token_type) * texture.there[:, None]
            x = torch.cat((x, c[:, None]), 1)
            there = torch.cat((there, torch.ones_like(there[:, :1])), 1)
        there = there | ~there.any(1, keepdim=True)
        for layer in self.layers:
            x = layer(x, there)
        return self.norm(x[:, : r.shape[1]])


class Attention(nn.Module):
    """Self-attention, then two linear layers; norms before each."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.qkv, self.out = nn.LayerNorm(width), nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.feed = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: torch.Tensor, there: torch.Tensor) -> torch.Tensor:
        """(R, n, width), of which those ``there`` (R, n) are attended to."""
        rays, n, width = x.shape
        q, k, v = self.qkv(self.norm(x)).view(rays, n, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=there[:, None, None])
        x = x + self.out(mixed.transpose(1, 2).reshape(rays, n, width))
        return x + self.feed(x)
