"""NeuRay (Liu et al., CVPR 2022) with a semantic head: the strongest baseline of the S-Ray paper.

Read beside sections 3.2 to 3.4 of the NeuRay paper. Each view predicts along each of its rays a mixture of logistics,
which gives the visibility v_j of a sample and the probability h_j that the view's ray ends in it (``geometry_net``).
Local features are aggregated over the views with these visibilities, the way of IBRNet: mean and variance, a small
network a view that sees both, mean and variance again. A ray transformer turns the aggregates into density
(``DensityNet``: as in S-Ray's published code, its geometry-aware network is NeuRay's, and both share it here), colours
are blended from the views, and a head with one hidden layer, as Semantic-NeRF adds it to NeRF, turns each sample's
aggregate into class logits. Nothing relates the samples of a view, or the views, to each other by attention: that is
S-Ray's addition.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import torch
from torch import nn
from torch.nn import functional

from research.peers.config import NeuRayConfig
from research.peers.rendering import composite_render, weighted_moments
from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.numbers import CUES, LEAST_VISIBILITY
from semantic_mapper.fields.sray import DensityNet, GeometryInit, contextual_space, softmax_weights
from semantic_mapper.fields.views import EncodedViews, check_views, depth_at, encoded_views, spread_at, sure_depth
from semantic_mapper.fields.volume import composite, compositing_weights
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews


class NeuRay(LearnedField):
    """Visibility-aware aggregation over views, a semantic head a sample, no cross-reprojection attention.

    Args:
        config: Shape of the network.
        label_set: Classes of the logits.
        sampling: Where rays are sampled; may be exchanged at any time, no weights depend on it.
    """

    kind = "neuray"
    class_rows = ("classifier.weight", "classifier.bias")

    def __init__(self, config: NeuRayConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        self.config: NeuRayConfig = config
        dim, hidden = config.feature_dim, 2 * config.feature_dim
        self.encoder = ImageEncoder(config.encoder, dim)
        self.geometry_init = GeometryInit(dim)
        self.density = DensityNet(dim)
        # Both together are one layer on (f_j, cues_j, mean, variance); the second part is the same for all views.
        self.view_in = nn.Linear(dim + CUES, hidden)
        self.context_in = nn.Linear(2 * dim, hidden, bias=False)
        self.view_out = nn.Linear(hidden, dim)
        self.pooled = nn.Sequential(nn.Linear(2 * dim, hidden), nn.ReLU(), nn.Linear(hidden, dim))
        self.colour_score = nn.Sequential(nn.Linear(dim + CUES, 16), nn.ReLU(), nn.Linear(16, 1))
        self.semantic = nn.Sequential(nn.Linear(dim, hidden), nn.ReLU())
        self.classifier = nn.Linear(hidden, len(label_set))

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode each view by itself: features, and the depth distribution of every pixel (from depth if measured).

        Raises ShapeError: tensors that do not fit together.
        """
        check_views(views)
        views = sure_depth(views, computed=self.config.encoder.computed_depth)
        feature = self.encoder(views)
        size = (feature.shape[-2], feature.shape[-1])
        geometry = self.geometry_init(feature, depth_at(views, *size), spread=spread_at(views, *size))
        return encoded_views(views, feature, geometry)

    def aggregate(
        self, feature: torch.Tensor, cues: torch.Tensor, visibility: torch.Tensor, valid: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Features of each view in the light of the others (m, R, N, C), and the aggregate of each sample (R, N, C).

        Both layers add to what they are given, as S-Ray's do: without, this peer learns several times slower and the
        comparison would be one of plumbing.

        Args:
            feature: (m, R, N, C).
            cues: (m, R, N, 4), see ``contextual_space``.
            visibility, valid: (m, R, N).
        """
        fraction = visibility_share(visibility, valid)
        context = self.context_in(torch.cat(weighted_moments(feature, fraction), dim=-1))  # (R, N, 2 C)
        hidden = functional.relu(self.view_in(torch.cat((feature, cues), dim=-1)) + context)
        view = feature + self.view_out(hidden)
        mean, variance = weighted_moments(view, fraction)
        return view, mean + self.pooled(torch.cat((mean, variance), dim=-1))

    def source_logits(self, sources: EncodedViews) -> torch.Tensor:
        """Logits (m, L, h, w): what the head says of each pixel's own surface with this view as the only one."""
        count, dim, height, width = sources.feature.shape
        feature = sources.feature.permute(0, 2, 3, 1).reshape(1, -1, 1, dim)
        spread = torch.log(sources.geometry[:, 1]).reshape(1, -1, 1)
        sure = torch.ones_like(spread)  # the view's ray ends here, is free up to here, and is the query ray
        _, sample = self.aggregate(feature, torch.stack((sure, sure, sure, spread), dim=-1), sure, sure > 0)
        logits = self.classifier(self.semantic(sample))
        return logits.view(count, height, width, -1).permute(0, 3, 1, 2)

    def render_samples(
        self, rays: RayBatch, z: torch.Tensor, sources: EncodedViews
    ) -> tuple[FieldRender, torch.Tensor]:
        """Render rays at given sample depths z (R, N), metres; also the compositing weights (R, N)."""
        space = contextual_space(rays, z, sources)
        view, sample = self.aggregate(space.feature, space.cues, space.visibility, space.valid)
        sigma = self.density(space.feature, space.hit, space.visibility, space.valid, space.delta)
        weights = compositing_weights(sigma, space.delta)
        score = self.colour_score(torch.cat((view, space.cues), dim=-1))[..., 0]
        colour = torch.einsum("mrn,mrnc->rnc", softmax_weights(score, space.valid), space.rgb)
        # The last layer of the head is linear, so it is applied once a ray: the same logits as a sample at a time.
        rendered = composite(weights, self.semantic(sample))
        logits = functional.linear(rendered, self.classifier.weight) + weights.sum(1)[:, None] * self.classifier.bias
        known = space.valid.flatten(2).any(2).any(0)
        return composite_render(weights, z, colour, logits, known), weights


def visibility_share(visibility: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Weights of the views at each sample, in proportion to their visibility: (m, R, N), sum 1 over valid views."""
    weight = (visibility + LEAST_VISIBILITY) * valid
    return weight / weight.sum(0).clamp_min(1e-6)
