"""MVSNeRF (Chen et al., ICCV 2021) with a semantic head: the second generalizing baseline of the S-Ray paper.

Read beside section 3 of the MVSNeRF paper. 3.1: image features of a few views, warped onto planes of constant depth in
the reference view's frustum; their variance over the views is the cost volume P. 3.2: a 3D network turns P into the
neural encoding volume S, and an MLP A turns, at any point x, (S(x), position x in the reference frustum, direction d,
colours c of the views at x) into density and radiance. 3.3: volume rendering. The semantic head follows Semantic-NeRF:
one hidden layer on the MLP's trunk, which does not know the direction.

Measured depth plays no part in it: depth reaches this field only through where rays are sampled.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import weakref
from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional

from research.peers.config import MVSNeRFConfig
from research.peers.cost_volume import (
    COLOUR_CHANNELS,
    EncodingVolumeNet,
    Sweep,
    colours_and_masks,
    cost_volume,
    nearest_views,
)
from research.peers.rendering import composite_render, density_from
from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import (
    MAX_SOURCE_VIEWS,
    EncodedViews,
    Reprojection,
    check_views,
    encoded_views,
    gather,
    reproject,
)
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import encode_frequencies, encoded_size, relu_layers
from semantic_mapper.fields.volume import composite, compositing_weights, interval_lengths
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews


@dataclass(frozen=True, slots=True)
class _KeptVolume:
    """The last encoding volume made without gradients, and what it was made from."""

    feature: weakref.ref[torch.Tensor]
    views: tuple[int, ...]
    weights: tuple[int, ...]
    volume: torch.Tensor


class MVSNeRF(LearnedField):
    """Cost volume on the reference view, 3D network, MLP, semantic head.

    A query is rendered from the ``config.views`` source views nearest to it, the nearest being the reference; others
    are ignored, so a ray is known where one of *these* views sees it.

    Args:
        config: Shape of the network.
        label_set: Classes of the logits.
        sampling: Where rays are sampled; may be exchanged at any time, no weights depend on it.
    """

    kind = "mvsnerf"
    class_rows = ("classifier.weight", "classifier.bias")

    def __init__(self, config: MVSNeRFConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        _check(config)
        self.config: MVSNeRFConfig = config
        width, colours = config.width, COLOUR_CHANNELS * config.views
        self.sweep = Sweep(config.planes, config.plane_near_m, config.plane_far_m)
        self.encoder = ImageEncoder(config.encoder, config.feature_dim)
        self.volume_net = EncodingVolumeNet(config.feature_dim + colours, config.volume_channels)
        c_in = encoded_size(3, config.position_frequencies) + config.volume_channels + colours
        self.trunk = relu_layers(c_in, width, config.depth)
        self.sigma = nn.Linear(width, 1)
        self.radiance = nn.Sequential(relu_layers(width + 3, width // 2, 1), nn.Linear(width // 2, 3))
        self.semantic = relu_layers(width, width, 1)
        self.classifier = nn.Linear(width, len(label_set))
        self._kept: _KeptVolume | None = None

    def encode(self, views: SourceViews) -> EncodedViews:
        """Image features of each view by itself; the cost volume needs the query and is built when rays are rendered.

        Raises:
            ShapeError: tensors that do not fit together.
        """
        check_views(views)
        return encoded_views(views, self.encoder(views))

    def encoding_volume(self, sources: EncodedViews, views: tuple[int, ...]) -> torch.Tensor:
        """S (1, volume_channels, planes, h, w) over the reference ``views[0]``, from the source views ``views``.

        Without gradients the last volume is kept, so that a view rendered in chunks is swept once. It is made again for
        other sources, other views, or weights that were changed since.
        """
        weights = tuple(p._version for p in self.volume_net.parameters())
        kept = self._kept
        if torch.is_grad_enabled():
            return self._build_volume(sources, views)
        if kept is None or kept.feature() is not sources.feature or (kept.views, kept.weights) != (views, weights):
            volume = self._build_volume(sources, views)
            self._kept = kept = _KeptVolume(weakref.ref(sources.feature), views, weights, volume)
        return kept.volume

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N), metres; also the compositing weights (R, N)."""
        index = nearest_views(rays, sources, self.config.views)
        volume = self.encoding_volume(sources, tuple(index.tolist()))
        used = sources.select(index)
        where = reproject(rays, z, used)
        trunk = self.trunk(torch.cat(self._samples(volume, used, where), dim=-1))  # (R, N, width)
        seen = where.valid.any(0)
        sigma = density_from(self.sigma(trunk)[..., 0]) * seen
        weights = compositing_weights(sigma, interval_lengths(z, rays.direction.norm(dim=-1)))
        towards = functional.normalize(rays.direction @ used.T_camera_world[0, :3, :3].T, dim=-1)
        towards = towards[:, None].expand(-1, z.shape[1], -1)
        colour = torch.sigmoid(self.radiance(torch.cat((trunk, towards), dim=-1)))
        # The last layer of the head is linear, so it is applied once a ray: the same logits as a sample at a time.
        rendered = composite(weights, self.semantic(trunk))
        logits = functional.linear(rendered, self.classifier.weight) + weights.sum(1)[:, None] * self.classifier.bias
        return composite_render(weights, z, colour, logits, seen.any(1)), weights

    def _build_volume(self, sources: EncodedViews, views: tuple[int, ...]) -> torch.Tensor:
        used = sources.select(torch.tensor(views, device=sources.feature.device))
        return self.volume_net(cost_volume(used, self.sweep, self.config.views))

    def _samples(
        self, volume: torch.Tensor, used: EncodedViews, where: Reprojection
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What the MLP sees of each sample: encoded place in the reference frustum, S there, colours of the views."""
        height, width = used.feature.shape[-2:]
        size = where.uv.new_tensor((width, height))
        place = torch.cat(
            (((where.uv[0] + 0.5) * (2 / size) - 1), self.sweep.place(where.z[0])[..., None]), dim=-1
        ).clamp(-2, 2)  # (R, N, 3); inside the frustum it is within -1 .. 1
        inside = functional.grid_sample(volume, place[None, None], align_corners=False)[0, :, 0]  # zeros outside
        local = inside.permute(1, 2, 0) * where.valid[0, :, :, None]
        colours = gather(replace(used, feature=used.feature[:, :0]), where).rgb
        return (
            encode_frequencies(place, self.config.position_frequencies),
            local,
            colours_and_masks(colours, where.valid, self.config.views),
        )


def _check(config: MVSNeRFConfig) -> None:
    if not 1 <= config.views <= MAX_SOURCE_VIEWS:
        raise ConfigError(f"views must lie in 1 .. {MAX_SOURCE_VIEWS}, got {config.views}")
    if not 0 < config.plane_near_m < config.plane_far_m or config.planes < 2:
        raise ConfigError(
            f"a sweep needs 2 planes or more with 0 < plane_near_m < plane_far_m, got {config.planes} planes from "
            f"{config.plane_near_m} to {config.plane_far_m} m"
        )
    if config.volume_channels < 4 or config.volume_channels % 4:
        raise ConfigError(f"volume_channels must be a multiple of 4, got {config.volume_channels}")
    if config.width < 2 or config.depth < 1 or config.position_frequencies < 0:
        raise ConfigError(
            f"the MLP needs width >= 2, depth >= 1 and position_frequencies >= 0, got {config.width}, {config.depth}, "
            f"{config.position_frequencies}"
        )
