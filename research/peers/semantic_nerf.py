"""Semantic-NeRF (Zhi et al., ICCV 2021): one scene in the weights of an MLP, the per-scene peer of S-Ray.

Read beside section 3 of that paper: position and direction go through NeRF's frequency encoding; a trunk of layers
sees the position (once more half way up); density and class logits are functions of the position alone, colour also
of the direction; all are composited along the ray.

The field does not look at source views at all. It knows nothing before it is fitted, and nothing of other scenes.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import msgspec
import torch
from torch import nn
from torch.nn import functional

from research.peers.config import SemanticNeRFConfig
from research.peers.seen_bounds import seen_bounds
from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import encode_frequencies, encoded_size, relu_layers
from semantic_mapper.fields.views import EncodedViews, check_views, encoded_views
from semantic_mapper.fields.volume import (
    composite,
    composite_depth,
    compositing_weights,
    field_render,
    interval_lengths,
)
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

DENSITY_START = 2.0  # log density of an untrained network: 7 / m, a third of the light gone after 5 cm
DENSITY_LIMIT = 8.0  # 3,000 / m: opaque within 1 mm, and no overflow


class SemanticNeRF(LearnedField):
    """An MLP of one scene inside a box.

    A ray is *known* once the field is fitted, where a sample of it lies in the box. Fitted means that rays were
    rendered in training mode with gradients, which the buffer ``fitted_steps`` counts, as batch norm counts its
    batches, and which is saved with the weights. While it trains, rays count as known from the first step on, or
    there would be no loss to begin with.

    Args:
        config: Shape of the network and the box; ``config_for_scene`` fits the box.
        label_set: Classes of the logits.
        sampling: Where rays are sampled; may be exchanged at any time, no weights depend on it.
    """

    kind = "semantic_nerf"
    holds_scene = True
    class_rows = ("classifier.weight", "classifier.bias")
    fitted_steps: torch.Tensor

    def __init__(self, config: SemanticNeRFConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        _check(config)
        self.config: SemanticNeRFConfig = config
        width = config.width
        position = encoded_size(3, config.position_frequencies)
        direction = encoded_size(3, config.direction_frequencies)
        below = config.depth // 2
        self.lower = relu_layers(position, width, below)
        self.upper = relu_layers(width + position, width, config.depth - below)
        self.sigma = nn.Linear(width, 1)
        self.radiance = nn.Sequential(relu_layers(width + direction, width // 2, 1), nn.Linear(width // 2, 3))
        self.semantic = relu_layers(width, width // 2, 1)
        self.classifier = nn.Linear(width // 2, len(label_set))
        self.register_buffer("fitted_steps", torch.zeros((), dtype=torch.int64))

    def encode(self, views: SourceViews) -> EncodedViews:
        """The views' cameras and colours, without features: nothing of them is looked at.

        Raises ShapeError: tensors that do not fit together.
        """
        check_views(views)
        return encoded_views(views, views.rgb[:, :0])

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N), metres; also the compositing weights (R, N)."""
        if self.training and torch.is_grad_enabled():
            self.fitted_steps += 1
        points = rays.origin[:, None, :] + z[..., None] * rays.direction[:, None, :]
        x = (points - points.new_tensor(self.config.centre_m)) / self.config.half_extent_m
        inside = (x.abs() <= 1).all(dim=-1)  # (R, N)
        known = inside.any(1) & ((self.fitted_steps > 0) | self.training)
        position = encode_frequencies(x.clamp(-1, 1), self.config.position_frequencies)
        trunk = self.upper(torch.cat((self.lower(position), position), dim=-1))
        # An exponential where NeRF has a ReLU: scenes are in metres here, and samples may stand a centimetre apart, so
        # densities from 0.1 / m to 1,000 / m have to be in reach of one learning rate.
        density = torch.exp((self.sigma(trunk)[..., 0] + DENSITY_START).clamp(max=DENSITY_LIMIT))
        sigma = density * (inside & known[:, None])
        weights = compositing_weights(sigma, interval_lengths(z, rays.direction.norm(dim=-1)))
        towards = encode_frequencies(functional.normalize(rays.direction, dim=-1), self.config.direction_frequencies)
        towards = towards[:, None].expand(-1, z.shape[1], -1)
        colour = torch.sigmoid(self.radiance(torch.cat((trunk, towards), dim=-1)))
        # The last layer of the head is linear, so it is applied once a ray: the same logits as a sample at a time.
        rendered = composite(weights, self.semantic(trunk))
        logits = functional.linear(rendered, self.classifier.weight) + weights.sum(1)[:, None] * self.classifier.bias
        depth, rgb = composite_depth(weights, z), composite(weights, colour)
        return field_render(logits=logits, depth_m=depth, opacity=weights.sum(dim=1), rgb=rgb, known=known), weights


def config_for_scene(
    views: SourceViews, far_m: float, config: SemanticNeRFConfig | None = None, margin_m: float = 0.2
) -> SemanticNeRFConfig:
    """The config with the smallest cube that holds what views of a scene can see.

    Args:
        views: Of the scene, any number.
        far_m: How far pixels without measured depth may see.
        margin_m: Added on every side.
    """
    bounds = seen_bounds(views, far_m)
    low, high = torch.tensor(bounds[0]), torch.tensor(bounds[1])
    centre = ((low + high) / 2).tolist()
    half = float((high - low).max()) / 2 + margin_m
    return msgspec.structs.replace(
        config or SemanticNeRFConfig(), centre_m=(centre[0], centre[1], centre[2]), half_extent_m=half
    )


def _check(config: SemanticNeRFConfig) -> None:
    if config.width < 2 or config.depth < 2:
        raise ConfigError(f"the MLP needs width >= 2 and depth >= 2, got {config.width} and {config.depth}")
    if config.position_frequencies < 0 or config.direction_frequencies < 0:
        raise ConfigError("position_frequencies and direction_frequencies must not be negative")
    if not config.half_extent_m > 0:
        raise ConfigError(f"half_extent_m must be positive, got {config.half_extent_m}")
