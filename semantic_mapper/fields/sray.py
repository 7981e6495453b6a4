"""Semantic Ray (S-Ray, CVPR 2023): semantics of a query ray from its reprojections into posed source views.

Read top to bottom next to section 3 of the paper: ``encode`` gives the F_j, ``contextual_space`` is Eq. 3 to 5,
``attend`` Eq. 6 to 10, ``blend_views`` Eq. 11 and 12, ``render_samples`` Eq. 13.

``tokens = "samples"`` is the paper's order: attention among all samples, then blending of the views, then
compositing. ``tokens = "surface"`` composites first, each view by itself, so that attention and blending work on one
token a view; the tokens go through the semantic MLP before they are blended, and what is learned beyond that starts
without effect. So with trained image features, and nothing else trained, it is a vote of its views, weighted by
what they see. Beyond the paper, its density also depends on whether the views' colours agree, and depth that it
predicts from an image is proportional to the focal length.

In both orders attention adds to the features (M + f(M) in Eq. 9 and 10, which trains faster), and views count by how
much they see of a sample.
"""

from __future__ import annotations

# torch and safetensors leave parts of their interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import replace

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import SamplingConfig, SRayConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.source_views import check_views, depth_at, encoded_views, spread_at, sure_depth
from semantic_mapper.fields.sray_layers import (
    COLOUR_SCALE,
    CUES,
    LEAST_VISIBILITY,
    SURFACE_CUES,
    ContextualSpace,
    DensityNet,
    GeometryInit,
    MultiHeadAttention,
    ViewWeightNet,
    constrained_weights,
    contextual_space,
    cross_view_attention,
    radial_attention,
    softmax_weights,
    surface_space,
)
from semantic_mapper.fields.volume import composite, composite_depth, compositing_weights, field_render
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

TAU = 0.02  # Eq. 12: view weights lie in (tau / m, 1 / (tau m))
LABEL_LOGIT = 8.0  # what full agreement of the labelled views on a class adds to its logit before any training
HIDDEN = 0.05  # visibility below which a view is left out where another one sees the sample
LABEL_UNCERTAINTY = 0.05  # hit probability at which a label that a view carries over counts by half


class SRay(LearnedField):
    """The S-Ray field.

    Args:
        config: Shape of the network.
        label_set: Classes of the logits.
        sampling: Where rays are sampled; may be exchanged at any time, no weights depend on it.
    """

    kind = "sray"
    class_rows = ("classifier.weight", "classifier.bias")
    encoding_parts = ("encoder", "geometry_init")
    image_parts = ("semantic", "classifier")

    def __init__(self, config: SRayConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        _check(config)
        dim = config.feature_dim
        self.config: SRayConfig = config
        self.at_surface = config.tokens == "surface"
        self.encoder = ImageEncoder(config.encoder, dim)
        self.geometry_init = GeometryInit(dim)
        self.density = DensityNet(dim + 3 if self.at_surface else dim)
        self.radial = MultiHeadAttention(dim, config.heads)
        self.cross = MultiHeadAttention(dim, config.heads)
        self.weights = ViewWeightNet(dim, SURFACE_CUES if self.at_surface else CUES)
        self.semantic = nn.Sequential(nn.Linear(dim, 2 * dim), nn.ReLU(), nn.Linear(2 * dim, dim))
        self.classifier = nn.Linear(dim, len(label_set))
        self.label_logit = nn.Parameter(torch.tensor(LABEL_LOGIT))
        if self.at_surface:
            self.weights.start_alike()
            nn.init.zeros_(self.radial.out.weight)
            nn.init.zeros_(self.cross.out.weight)
            # Of the own view's blending weight: 1 = one vote among others, large = the own image alone; for rays with
            # measured depth and for those without, whose views may look at different things. Not learned by
            # gradients: on the pixels that it was trained on, the own image is always right.
            self.own_view_factor: torch.Tensor
            self.register_buffer("own_view_factor", torch.ones(2))

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode each view by itself: features F_j and the depth distribution of every pixel.

        Raises:
            ShapeError: tensors that do not fit together.
        """
        check_views(views)
        views = sure_depth(views, computed=self.config.encoder.computed_depth)
        feature = self.encoder(views)
        focal = views.K[:, 0, 0] / views.rgb.shape[-1] if self.at_surface else None
        size = (feature.shape[-2], feature.shape[-1])
        geometry = self.geometry_init(feature, depth_at(views, *size), focal, spread_at(views, *size))
        encoded = encoded_views(views, feature, geometry)
        if views.channel is None:
            return encoded
        return replace(encoded, channel=views.channel.to(torch.int16))

    def find_density(self, space: ContextualSpace) -> torch.Tensor:
        """sigma (R, N) in 1 / m, from what the views hold at the samples: where features (of tokens at the surface also
        colours) agree, there is the surface."""
        values = space.feature
        if self.at_surface:
            values = torch.cat((values, COLOUR_SCALE * space.rgb), dim=-1)
        return self.density(values, space.hit, space.visibility, space.valid, space.delta)

    def propagate_labels(self, space: ContextualSpace) -> torch.Tensor:
        """What views with known labels say of each sample: (R, N, L), each entry and their sum in [0, 1].

        Not in the paper: labels are to a source view what depth is, an input that it may have. A view's label counts
        by the probability that its ray ends in the sample, so what is hidden from it takes no label from it.
        """
        weight = space.hit * (space.channel >= 0)
        votes = weight.new_zeros(*weight.shape[1:], len(self.label_set))
        index = space.channel.clamp_min(0).permute(1, 2, 0)
        votes = votes.scatter_add(2, index, weight.permute(1, 2, 0))
        return votes / (weight.sum(0) + LABEL_UNCERTAINTY)[..., None]

    def source_logits(self, sources: EncodedViews) -> torch.Tensor:
        """Logits (m, L, h, w) of the image features by themselves."""
        s = sources.feature.permute(0, 2, 3, 1)
        return self.classifier(s + self.semantic(s)).permute(0, 3, 1, 2)

    def weigh_own_view(self, factor: float, without_depth: float) -> bool:
        """Set ``own_view_factor``, where tokens are at the surface."""
        if self.at_surface:
            self.own_view_factor.copy_(torch.tensor((factor, without_depth)))
        return self.at_surface

    def own_view_factors(self, rays: RayBatch) -> torch.Tensor:
        """(R,) how much the own view counts on each ray."""
        with_depth, without = self.own_view_factor if self.at_surface else rays.prior_depth_m.new_ones(2)
        measured = rays.prior_depth_m > 0 if rays.measured is None else rays.measured
        return torch.where(measured, with_depth, without)

    def mask_occluded(self, space: ContextualSpace) -> ContextualSpace:
        """M without the views to which a sample is hidden, where some other view sees it.

        Not in the paper, which leaves it to the attention to find out. A hidden view shows another surface at that
        pixel, and within the bounds of Eq. 12 it would still weigh up to tau of a seen one.
        """
        clear = space.valid & (space.visibility >= HIDDEN)
        return replace(space, valid=torch.where(clear.any(0), clear, space.valid))

    def pruned(self, space: ContextualSpace, weights: torch.Tensor, least: float) -> ContextualSpace:
        """M without the samples whose fraction of the compositing weights (R, N) of their ray is below ``least``."""
        return replace(space, valid=space.valid & (weights >= least * weights.sum(1, keepdim=True)))

    def attend(self, space: ContextualSpace) -> torch.Tensor:
        """Cross-reprojection attention: M -> M'' (m, R, N, C) (Eq. 6 to 10)."""
        x = space.feature.transpose(0, 1)  # (R, m, N, C)
        valid = space.valid.transpose(0, 1)
        if self.config.intra_view_attention:
            x = x + radial_attention(self._normalised(x), valid, self.radial)
        if self.config.cross_view_attention and not self.at_surface:
            x = x + cross_view_attention(x, valid, self.cross)
        return x.transpose(0, 1)

    def attend_at_surface(self, space: ContextualSpace) -> torch.Tensor:
        """Eq. 10 among one token a view: (m, R, 1, C)."""
        if not self.config.cross_view_attention:
            return space.feature
        x = space.feature.transpose(0, 1)
        x = x + cross_view_attention(self._normalised(x), space.valid.transpose(0, 1), self.cross)
        return x.transpose(0, 1)

    def blend_views(
        self,
        refined: torch.Tensor,
        space: ContextualSpace,
        content: torch.Tensor | None = None,
        own_factor: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Semantic ray s (Eq. 11, 12) and colour of each sample: (R, N, C), (R, N, 3).

        The weights of Eq. 12 are times the views' visibilities: the bounds hold among views that see the sample alike.

        Args:
            content: (m, R, N, C) what is blended, where that is not what the weights are made of.
            own_factor: (R,) times which the own view's weight counts; None = once.
        """
        semantic_score, colour_score = self.weights(self._normalised(refined), space.cues)
        colour_weight = softmax_weights(colour_score, space.valid)
        semantic_weight = constrained_weights(semantic_score, space.valid, TAU) * (space.visibility + LEAST_VISIBILITY)
        if own_factor is not None:
            is_own = space.cues[..., CUES] > 0
            semantic_weight = semantic_weight * torch.where(is_own, own_factor[:, None], 1)
        semantic_weight = semantic_weight / semantic_weight.sum(0).clamp_min(1e-12)
        if self.at_surface:
            colour_weight = colour_weight * (space.visibility + LEAST_VISIBILITY)
            colour_weight = colour_weight / colour_weight.sum(0).clamp_min(1e-12)
        s = torch.einsum("mrn,mrnc->rnc", semantic_weight, refined if content is None else content)
        return s, torch.einsum("mrn,mrnc->rnc", colour_weight, space.rgb)

    def _normalised(self, x: torch.Tensor) -> torch.Tensor:
        """Layer norm of tokens at the surface; the paper has none."""
        return functional.layer_norm(x, x.shape[-1:]) if self.at_surface else x

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        """As every field renders; streaming, without samples below ``sampling.sample_weight_threshold``."""
        least = self.sampling.sample_weight_threshold if self.sampling.mode == "streaming" else 0.0
        return self.render_samples(rays, self.sample(rays, sources), sources, least)[0]

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews, sample_weight_threshold: float = 0.0
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N) (Eq. 13); also returns the compositing weights (R, N).

        The density of a sample does not depend on the attention. With ``sample_weight_threshold`` samples of less than
        their ray's weight take no part in it, and the others' semantics and colour stand for theirs.
        """
        space = contextual_space(rays, z, sources)
        sigma = self.find_density(space)
        weights = compositing_weights(sigma, space.delta)
        opacity = weights.sum(dim=1)
        known = space.valid.flatten(2).any(2).any(0)
        kept = weights
        seen = space if self.at_surface else self.mask_occluded(space)
        if sample_weight_threshold > 0:
            seen = self.pruned(seen, weights, sample_weight_threshold)
            kept = weights * seen.valid.any(0)
            kept = kept * (opacity / kept.sum(1).clamp_min(1e-12))[:, None]
        refined = self.attend(seen)
        if self.at_surface:
            seen = replace(seen, feature=refined)
            seen = self.mask_occluded(surface_space(seen, kept, rays, sources))
            token = self.attend_at_surface(seen)
            content, own_factor = token + self.semantic(token), self.own_view_factors(rays)
            s, colour = (blended[:, 0] for blended in self.blend_views(token, seen, content, own_factor))
            logits = self.classifier(s)
        else:
            s, colour = self.blend_views(refined, seen)
            # The classifier is linear, so logits of blended features equal blended logits: classify once a ray.
            rendered = composite(kept, s + self.semantic(s))
            colour = composite(kept, colour)
            logits = functional.linear(rendered, self.classifier.weight) + opacity[:, None] * self.classifier.bias
        logits = logits + self.label_logit * composite(weights, self.propagate_labels(space))
        depth = composite_depth(weights, z)
        return field_render(logits=logits, depth_m=depth, opacity=opacity, rgb=colour, known=known), weights


def _check(config: SRayConfig) -> None:
    if config.feature_dim <= 0 or config.feature_dim % 4 or config.feature_dim % config.heads:
        raise ConfigError(
            f"feature_dim must be a multiple of 4 and of heads ({config.heads}), got {config.feature_dim}"
        )
