"""Implicit Ray-Transformer (Qi et al. 2023): a few labelled views of one scene label all the others.

A scene grid with features, fitted to the colours of all frames, stays as it is. Along a ray its points of greatest
weight become tokens; they attend to each other and to the texture of the ray's own pixel, where the image is there.
Composited like colours, next to that texture, they give the classes.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import GridConfig, IRTConfig, SamplingConfig
from semantic_mapper.fields.numbers import MIN_DEPTH_M
from semantic_mapper.fields.scene.grid import GridField, RaySamples, heaviest, ray_fraction, relu_layers
from semantic_mapper.fields.views import EncodedViews, check_views, encoded_views, own_view
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import RayBatch, SourceViews

TEXTURE = 32  # channels of an image's texture
POINTS = 6  # of a ray that are looked at, those of greatest weight
WIDTH, HEADS, LAYERS = 64, 4, 2  # of the transformer
GREY = 0.5
NEAR_VOXELS, NEAR_SHARE = 1.0, 0.02  # from a measured depth within which samples count: voxels, fraction of depth
VOTE_START = 4.0  # logits of a class that all votes are for
TOLERANCE = 0.03  # relative difference of depth at which a carried label's vote counts 1 / e


@dataclass(frozen=True, slots=True, eq=False)
class RayTexture:
    """Texture of each ray's own pixel."""

    values: torch.Tensor  # (R, 32), 0 where none is there
    there: torch.Tensor  # (R,) whether the ray's image is among the views


class TextureNet(nn.Module):
    """Texture of images: three convolutions.
    Images are continued beyond their edges, so that a pixel's texture is that of its patch wherever it lies."""

    layers: tuple[int, ...] = (3, 16, 32, TEXTURE)  # channels
    kernel = 3

    def __init__(self) -> None:
        super().__init__()
        net: list[nn.Module] = []
        for c_in, c_out in pairwise(self.layers):
            net += [nn.Conv2d(c_in, c_out, self.kernel), nn.ReLU()]
        self.net = nn.Sequential(*net)
        self.margin = (self.kernel // 2) * (len(self.layers) - 1)  # pixels on either side that a texture depends on

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        """(m, 3, H, W) -> (m, 32, H, W)."""
        return self.net(functional.pad(rgb - GREY, (self.margin,) * 4, mode="replicate"))

    def of_patches(self, patches: torch.Tensor) -> torch.Tensor:
        """Texture (R, 32) in the middle of patches (R, 3, 2 margin + 1, 2 margin + 1)."""
        return self.net(patches - GREY)[:, :, 0, 0]


class IRT(GridField):
    """Classes of one scene from its geometry, its colours and the texture of the query's own image."""

    kind = "irt"
    knows_classes = True
    class_rows = ("classifier.weight", "classifier.bias")
    points_of_ray: int = POINTS
    texture_net: type[TextureNet] = TextureNet

    def __init__(self, config: IRTConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.shape = config
        assert self.trunk is not None
        classes = len(label_set)
        has_token, joined = config.variant in ("RTT", "RTTC"), config.variant in ("BC", "RTC", "RTTC")
        self.texture = self.texture_net() if has_token or joined else None
        self.image_head = nn.Linear(TEXTURE, classes) if self.texture is not None else None
        self.points = (
            PointNet(config.trunk_width)
            if config.variant in ("B", "BC")
            else RayTransformer(config.trunk_width, token=has_token)
        )
        self.beyond = nn.Parameter(torch.zeros(WIDTH))  # what light that no point stops stands for
        self.carried = CarriedLabels(config.carried, config.carried_size, classes) if config.carried else None
        self.vote = None if self.carried is None else nn.Linear(classes + 1, classes, bias=False)
        if self.vote is not None:  # starts by believing the votes
            nn.init.zeros_(self.vote.weight)
            self.vote.weight.data[:, :classes] = VOTE_START * torch.eye(classes)
        self.classifier = nn.Linear(WIDTH + (TEXTURE if joined else 0), classes)
        self._joined = joined

    def encode(self, views: SourceViews) -> EncodedViews:
        """The views' cameras, colours and, as ``feature``, the texture (m, 32, H, W) of their images.
        Raises ShapeError: tensors that do not fit together."""
        check_views(views)
        return encoded_views(views, views.rgb[:, :0] if self.texture is None else self.texture(views.rgb))

    def classify(self, samples: RaySamples, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
        """Class logits (R, L), and where they are known (R,): where a ray meets something, where its depth was
        measured, or where its image is there."""
        texture = self.texture_of(samples.rays, sources)
        samples = at_measured(samples, self.grid.config)
        logits = self.logits(samples, texture, self.carried_to(samples))
        enter, leave = self.grid.span(samples.rays)
        seen = texture.there & (leave > enter) & self.fitted
        return logits, self.known(samples) | seen

    def logits(self, samples: RaySamples, texture: RayTexture, carried: torch.Tensor | None) -> torch.Tensor:
        """Class logits (R, L) of rays, given the texture of their pixels and the labels carried to them."""
        samples = heaviest(samples, self.points_of_ray)
        assert self.trunk is not None
        r = self.trunk(samples.points)
        fraction = ray_fraction(samples)
        s = self.points(r, samples.weight > 0, texture)
        parts = [torch.einsum("rk,rkc->rc", fraction, s) + samples.light[:, None] * self.beyond]
        if self._joined:
            parts.append(texture.values)
        logits = self.classifier(torch.cat(parts, 1))
        return logits if carried is None or self.vote is None else logits + self.vote(carried)

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


def surface(samples: RaySamples) -> torch.Tensor:
    """Points (R, 3) of the world where rays end: measured depth where it is known, else that of the grid."""
    prior = samples.rays.prior_depth_m
    z = torch.where(prior > 0, prior, samples.depth_m)
    return samples.rays.origin + z[:, None] * samples.rays.direction


def at_measured(samples: RaySamples, box: GridConfig) -> RaySamples:
    """Rays whose depth was measured, inside the box, end there; depth that was filled in from other pixels ends none.
    Samples elsewhere fade, and one more at that depth takes the rest."""
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


class PointNet(nn.Module):
    """Points by themselves: variants B and BC."""

    def __init__(self, channels_in: int) -> None:
        super().__init__()
        self.net = nn.Sequential(relu_layers(channels_in, WIDTH, 1), nn.Linear(WIDTH, WIDTH))

    def forward(self, r: torch.Tensor, there: torch.Tensor, texture: RayTexture) -> torch.Tensor:
        """(R, k, trunk_width) -> (R, k, WIDTH)."""
        return self.net(r)


class RayTransformer(nn.Module):
    """Points of a ray attend to each other, and to a token of the texture of its pixel where there is one."""

    def __init__(self, channels_in: int, *, token: bool) -> None:
        super().__init__()
        self.enter = nn.Linear(channels_in, WIDTH)
        self.token = nn.Linear(TEXTURE, WIDTH, bias=False) if token else None
        self.token_type = nn.Parameter(0.02 * torch.randn(WIDTH)) if token else None
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, dropout=0.0, batch_first=True, norm_first=True)
            for _ in range(LAYERS)
        )
        self.norm = nn.LayerNorm(WIDTH)

    def forward(self, r: torch.Tensor, there: torch.Tensor, texture: RayTexture) -> torch.Tensor:
        """(R, k, trunk_width) -> (R, k, WIDTH); points that are not ``there`` (R, k) are not attended to."""
        x = self.enter(r)
        if self.token is not None:
            c = (self.token(texture.values) + self.token_type) * texture.there[:, None]
            x = torch.cat((x, c[:, None]), 1)
            there = torch.cat((there, torch.ones_like(there[:, :1])), 1)
        there = there | ~there.any(1, keepdim=True)
        for layer in self.layers:
            x = layer(x, src_key_padding_mask=~there)
        return self.norm(x[:, : r.shape[1]])


class CarriedLabels(nn.Module):
    """Votes of labelled frames of one size for the class of a point of the world, by how well their depth agrees."""

    depth_m: torch.Tensor
    channel: torch.Tensor
    K: torch.Tensor
    T_camera_world: torch.Tensor

    def __init__(self, frames: int, size: tuple[int, int], classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.register_buffer("depth_m", torch.zeros(frames, *size))
        self.register_buffer("channel", torch.full((frames, *size), -1, dtype=torch.int16))
        self.register_buffer("K", torch.eye(3, dtype=torch.float64).repeat(frames, 1, 1))
        self.register_buffer("T_camera_world", torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1))

    def forward(self, xyz: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
        """Votes (R, L + 1) for points (R, 3): fractions by class, and how many there are, as n / (1 + n).
        ``counted``: (R, F) or (F,) weight of each frame; 0 = its labels are not known."""
        T, K = self.T_camera_world.float(), self.K.float()
        p = torch.einsum("fij,rj->rfi", T[:, :3, :3], xyz) + T[:, :3, 3]
        z = p[..., 2]
        safe = z.clamp_min(MIN_DEPTH_M)
        height, width = self.depth_m.shape[1:]
        u = (K[:, 0, 0] * p[..., 0] / safe + K[:, 0, 2]).round().long()
        v = (K[:, 1, 1] * p[..., 1] / safe + K[:, 1, 2]).round().long()
        inside = (z > MIN_DEPTH_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
        frame = torch.arange(len(K), device=xyz.device) * (height * width) + index
        depth, channel = self.depth_m.flatten()[frame], self.channel.flatten()[frame].long()
        seen = inside & (depth > 0) & (channel >= 0)
        weight = torch.exp(-(((depth - z) / (TOLERANCE * safe)) ** 2)) * seen * counted
        votes = torch.zeros(len(xyz), self.classes, device=xyz.device)
        votes.scatter_add_(1, channel.clamp_min(0), weight)
        total = votes.sum(1, keepdim=True)
        return torch.cat((votes / total.clamp_min(1e-3), total / (1 + total)), 1)
