"""Semantic Ray (S-Ray, CVPR 2023): semantics of a query ray from its reprojections into posed source views.

Read top to bottom next to section 3 of the paper: ``SRay.encode`` gives the F_j, ``contextual_space`` is Eq. 3 to 5,
attention Eq. 6 to 10, ``blend_views`` Eq. 11 and 12, ``render_samples`` Eq. 13.

The geometry-aware network: per source view and pixel, a mixture of two logistic distributions over depth says where
that view ray ends: the nearer component sits on the measured depth (or on a prediction from the image where there is
none), the farther one behind it. From it follow, for a query sample that lands on this pixel at depth z, the
probability that the view ray ends within the sample's interval (hit), and that it is free before it (visibility).

``tokens = "samples"`` is the paper's order: attention among all samples, then blending of the views, then
compositing. ``tokens = "surface"`` composites first, each view by itself, so that attention and blending work on one
token a view. The tokens go through the semantic MLP before they are blended, and what is learned beyond that starts
without effect: with trained image features alone it is a vote of its views, weighted by what they see. Its density
also depends on whether the views' colours agree, and depth predicted from an image is proportional to the focal length.

In both orders attention adds to the features (M + f(M) in Eq. 9 and 10, which trains faster), and views count by how
much they see of a sample.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import SamplingConfig, SRayConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.numbers import (
    BACKGROUND_M,
    COLOUR_SCALE,
    COMMON_FOCAL,
    CUES,
    FAR_M,
    GEOMETRY_CHANNELS,
    HIDDEN,
    LABEL_UNCERTAINTY,
    LEAST_VISIBILITY,
    MEASURED_SCALE,
    MEASURED_SHIFT,
    NEAR_M,
    OWN_DENSITY_OFFSET,
    OWN_RADIUS_M,
    PREDICTED_SCALE,
    SURFACE_CUES,
    TAU,
)
from semantic_mapper.fields.views import (
    EncodedViews,
    check_views,
    depth_at,
    encoded_views,
    gather,
    reproject,
    spread_at,
    sure_depth,
)
from semantic_mapper.fields.volume import (
    composite,
    composite_depth,
    compositing_weights,
    field_render,
    interval_lengths,
)
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import FieldRender, RayBatch, SourceViews

LABEL_LOGIT = 8.0  # what full agreement of the labelled views on a class adds to its logit before any training


class GeometryInit(nn.Module):
    """Predict the mixture of each pixel from image features and, where there is one, the measured depth."""

    def __init__(self, feature_dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(feature_dim + 2, 16, 3, 1, 1), nn.ReLU(), nn.Conv2d(16, GEOMETRY_CHANNELS + 1, 3, 1, 1)
        )
        last = self.net[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        nn.init.normal_(last.weight, std=1e-3)
        nn.init.zeros_(last.bias)

    def forward(
        self,
        feature: torch.Tensor,
        depth_m: torch.Tensor,
        focal: torch.Tensor | None = None,
        spread: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Mixture parameters (m, 5, h, w) of features (m, C, h, w) and depths (m, h, w), 0 = none.
        ``focal``: (m,) in image widths; None = ``COMMON_FOCAL``. ``spread``: (m, h, w) of depth that was computed from
        pictures, as a fraction of it; 0 = measured."""
        measured = depth_m > 0
        inverse = torch.where(measured, 1 / depth_m.clamp_min(NEAR_M), torch.zeros_like(depth_m))
        raw = self.net(torch.cat((feature, inverse[:, None], measured[:, None].to(feature.dtype)), dim=1))
        shift, widen, behind, widen_behind, fraction, guess = raw.unbind(1)
        predicted = 1 / (1 / FAR_M + (1 / NEAR_M - 1 / FAR_M) * torch.sigmoid(guess - 2.0))
        if focal is not None:
            predicted = predicted * (focal / COMMON_FOCAL)[:, None, None]
        mu_1 = torch.where(measured, depth_m * (1 + MEASURED_SHIFT * torch.tanh(shift)), predicted)
        start = torch.where(measured, MEASURED_SCALE, PREDICTED_SCALE)
        if spread is not None:
            start = torch.maximum(start, spread)
        s_1 = mu_1 * start * torch.exp(widen.clamp(-3, 3))
        mu_2 = mu_1 * (1.02 + functional.softplus(behind))
        s_2 = mu_2 * PREDICTED_SCALE * torch.exp(widen_behind.clamp(-3, 3))
        return torch.stack((mu_1, s_1, mu_2, s_2, torch.sigmoid(fraction + 3.0)), dim=1)


def hit_and_visibility(
    geometry: torch.Tensor, z: torch.Tensor, half_interval: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Probability that a view ray ends within z +- half_interval, and that it is still free before it: (...) in [0, 1].
    ``geometry``: (..., 5) mixture parameters at the pixel that the sample lands on. ``z, half_interval``: (...) of the
    sample in the source camera, metres."""
    mu_1, s_1, mu_2, s_2, fraction = geometry.unbind(-1)
    near, far = z - half_interval, z + half_interval
    cdf_near = fraction * torch.sigmoid((near - mu_1) / s_1) + (1 - fraction) * torch.sigmoid((near - mu_2) / s_2)
    cdf_far = fraction * torch.sigmoid((far - mu_1) / s_1) + (1 - fraction) * torch.sigmoid((far - mu_2) / s_2)
    return cdf_far - cdf_near, 1 - cdf_near


class DensityNet(nn.Module):
    """Density of each sample from ``dim`` values a view, with one attention layer along the ray.

    Of the views that can see a sample, the fraction whose ray ends there is its opacity, which the network corrects by
    a gain; it adds density of its own.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.token = nn.Sequential(nn.Linear(2 * dim + 4, 32), nn.ReLU(), nn.Linear(32, 16))
        self.qkv = nn.Linear(16, 48, bias=False)
        self.out = nn.Sequential(nn.Linear(16, 16), nn.ReLU(), nn.Linear(16, 2))

    def forward(
        self,
        values: torch.Tensor,
        hit: torch.Tensor,
        visibility: torch.Tensor,
        valid: torch.Tensor,
        delta: torch.Tensor,
    ) -> torch.Tensor:
        """sigma (R, N) in 1 / m of values (m, R, N, C); 0 where no view sees the sample."""
        weight = (visibility + LEAST_VISIBILITY) * valid
        total = weight.sum(0).clamp_min(1e-6)  # (R, N)
        fraction = weight / total
        mean = torch.einsum("mrn,mrnc->rnc", fraction, values)
        var = torch.einsum("mrn,mrnc->rnc", fraction, values * values) - mean * mean
        seen = (visibility * valid).sum(0)
        opacity = ((hit * valid).sum(0) / seen.clamp_min(1e-3)).clamp(0, 0.999)
        prior = -torch.log1p(-opacity) / delta.clamp_min(1e-4)
        views = valid.sum(0).clamp_min(1)
        extra = torch.stack((opacity, seen / views, (hit * valid).sum(0) / views, delta.clamp(max=1.0)), dim=-1)
        token = self.token(torch.cat((mean, var, extra), dim=-1))  # (R, N, 16)
        q, k, v = self.qkv(token).chunk(3, dim=-1)
        any_view = valid.any(0)
        score = (q @ k.transpose(-1, -2) / 4.0).masked_fill(~any_view[:, None, :], -1e9)
        token = token + torch.softmax(score, dim=-1) @ v
        gain, own = self.out(token).unbind(-1)
        sigma = prior * torch.exp(gain.clamp(-4, 4)) + functional.softplus(own - OWN_DENSITY_OFFSET)
        return sigma * any_view


@dataclass(frozen=True, slots=True, eq=False)
class ContextualSpace:
    """The space M of Eq. 5 with what goes with it, view-first."""

    feature: torch.Tensor  # (m, R, N, C)
    rgb: torch.Tensor  # (m, R, N, 3)
    cues: torch.Tensor  # (m, R, N, CUES); of tokens at the surface SURFACE_CUES
    hit: torch.Tensor  # (m, R, N) in [0, 1]
    visibility: torch.Tensor  # (m, R, N) in [0, 1]
    valid: torch.Tensor  # (m, R, N) bool
    delta: torch.Tensor  # (R, N) interval lengths, metres
    channel: torch.Tensor  # (m, R, N) int64 known label at the sample, -1 = none


def contextual_space(rays: RayBatch, z: torch.Tensor, sources: EncodedViews) -> ContextualSpace:
    """Reproject samples z (R, N) of whole rays into all views and gather M (S-Ray Eq. 3 to 5)."""
    return _gather_space(rays, z, sources, interval_lengths(z, rays.direction.norm(dim=-1)))


def _gather_space(rays: RayBatch, z: torch.Tensor, sources: EncodedViews, delta: torch.Tensor) -> ContextualSpace:
    where = reproject(rays, z, sources)
    found = gather(sources, where)
    hit, visibility = hit_and_visibility(found.geometry, where.z, 0.5 * delta)
    hit, visibility = hit * where.valid, visibility * where.valid
    cues = torch.stack((hit, visibility, where.view_cosine, torch.log(found.geometry[..., 1])), dim=-1)
    return ContextualSpace(found.feature, found.rgb, cues, hit, visibility, where.valid, delta, found.channel)


def surface_space(
    space: ContextualSpace, weights: torch.Tensor, rays: RayBatch, sources: EncodedViews
) -> ContextualSpace:
    """M with one token a view (N = 1): its samples composited, what lies infinitely far behind them included.

    What the compositing weights (R, N) leave of 1 belongs to the background: the sky, or what lies beyond the sensor's
    range, of which every view that looks that way has an opinion. The query's own view sees all of its ray, wherever
    that ends: so it outweighs the others where no depth is known and their visibilities are guesses.
    """
    behind = rays.origin.new_full((len(rays.origin), 1), BACKGROUND_M)
    far = _gather_space(rays, behind, sources, torch.zeros_like(behind))
    rest = (1 - weights.sum(1, keepdim=True)).clamp_min(0)
    weight = torch.cat((weights, rest), dim=1)

    def both(name: str) -> torch.Tensor:
        return torch.cat((getattr(space, name), getattr(far, name)), dim=2)

    T = sources.T_camera_world
    origin = torch.einsum("mij,rj->mri", T[:, :3, :3], rays.origin) + T[:, None, :3, 3]
    own = origin.square().sum(-1) < OWN_RADIUS_M**2  # (m, R)
    valid, hit = both("valid"), both("hit")
    visibility = torch.where(own[..., None], valid.to(hit.dtype), both("visibility"))
    seen = weight * valid  # (m, R, N + 1)
    fraction = seen * (visibility + LEAST_VISIBILITY)
    fraction = fraction / fraction.sum(2, keepdim=True).clamp_min(1e-12)

    def mean(values: torch.Tensor) -> torch.Tensor:
        return torch.einsum("mrn,mrnc->mrc", fraction, values)

    visible, hits = (seen * visibility).sum(2), (seen * hit).sum(2)
    geometry = mean(both("cues")[..., 2:CUES])
    cues = torch.cat((torch.stack((hits, visible), dim=-1), geometry, own.to(hits.dtype)[..., None]), dim=-1)
    return ContextualSpace(
        feature=mean(both("feature"))[:, :, None],
        rgb=mean(both("rgb"))[:, :, None],
        cues=cues[:, :, None],
        hit=hits[..., None],
        visibility=visible[..., None],
        valid=(seen.sum(2) > 0)[..., None],
        delta=far.delta,
        channel=torch.full_like(far.channel, -1),
    )


class MultiHeadAttention(nn.Module):
    """f(Q, K, V) = Concat(A_1 .. A_H) W_o of Eq. 6 to 8, with d_k = C / H."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.out = nn.Linear(dim, dim, bias=False)

    def forward(self, x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        """Eq. 7 over the S tokens of each row: (B, S, C), (B, S) bool -> (B, S, C); zeros where none is valid."""
        rows, tokens, dim = x.shape
        qkv = self.qkv(x).view(rows, tokens, 3, self.heads, dim // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)  # (B, H, S, d_k) each
        score = (q @ k.transpose(-1, -2)) / math.sqrt(q.shape[-1])  # (B, H, S, S)
        score = score.masked_fill(~valid[:, None, None, :], -1e9)
        attended = (torch.softmax(score, dim=-1) * valid[:, None, None, :]) @ v
        return self.out(attended.transpose(1, 2).reshape(rows, tokens, dim))


def radial_attention(x: torch.Tensor, valid: torch.Tensor, layer: MultiHeadAttention) -> torch.Tensor:
    """Intra-view radial attention, Eq. 9: over the N samples of one view. x (R, m, N, C), valid (R, m, N)."""
    rays, views, samples, dim = x.shape
    out = layer(x.reshape(rays * views, samples, dim), valid.reshape(rays * views, samples))
    return out.view(rays, views, samples, dim)


def cross_view_attention(x: torch.Tensor, valid: torch.Tensor, layer: MultiHeadAttention) -> torch.Tensor:
    """Cross-view sparse attention, Eq. 10: over the m views at one sample. x (R, m, N, C), valid (R, m, N)."""
    return radial_attention(x.transpose(1, 2), valid.transpose(1, 2), layer).transpose(1, 2)


def constrained_weights(score: torch.Tensor, valid: torch.Tensor, tau: float) -> torch.Tensor:
    """Map free scores to view weights in C(tau): tau / m < w_i < 1 / (tau m), sum 1, over the m valid views (Eq. 12).

    Scores are squashed to +-ln(1 / tau) / 2 before the softmax, so no two views differ by more than a factor of tau;
    both bounds follow from that for any m. Invalid views get exactly 0; all are 0 where no view is valid.
    """
    bounded = 0.5 * math.log(1 / tau) * torch.tanh(score)
    unnormalised = torch.exp(bounded) * valid
    return unnormalised / unnormalised.sum(0, keepdim=True).clamp_min(1e-12)


def softmax_weights(score: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Unconstrained softmax over the valid views, (m, ...)."""
    masked = score.masked_fill(~valid, -1e9)
    return torch.softmax(masked, dim=0) * valid


class ViewWeightNet(nn.Module):
    """Score every view at every sample, once for its semantics and once for its colour."""

    def __init__(self, feature_dim: int, extra: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(feature_dim + extra, 16), nn.ReLU(), nn.Linear(16, 2))

    def forward(self, feature: torch.Tensor, extra: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(m, R, N, C), (m, R, N, E) -> semantic and colour score, (m, R, N) each."""
        semantic, colour = self.net(torch.cat((feature, extra), dim=-1)).unbind(-1)
        return semantic, colour


class SRay(LearnedField):
    """The S-Ray field."""

    kind = "sray"
    class_rows = ("classifier.weight", "classifier.bias")

    def __init__(self, config: SRayConfig, label_set: LabelSet, sampling: SamplingConfig | None = None) -> None:
        super().__init__(config, label_set, sampling)
        dim, heads = config.feature_dim, config.heads
        if dim % 4 or dim % heads:
            raise ConfigError(f"feature_dim must be a multiple of 4 and of heads ({heads}), got {dim}")
        self.config: SRayConfig = config
        self.at_surface = config.tokens == "surface"
        self.encoder = ImageEncoder(config.encoder, dim)
        self.geometry_init = GeometryInit(dim)
        self.density = DensityNet(dim + 3 if self.at_surface else dim)
        self.radial = MultiHeadAttention(dim, heads)
        self.cross = MultiHeadAttention(dim, heads)
        self.weights = ViewWeightNet(dim, SURFACE_CUES if self.at_surface else CUES)
        self.semantic = nn.Sequential(nn.Linear(dim, 2 * dim), nn.ReLU(), nn.Linear(2 * dim, dim))
        self.classifier = nn.Linear(dim, len(label_set))
        self.label_logit = nn.Parameter(torch.tensor(LABEL_LOGIT))
        if self.at_surface:
            for last in (self.weights.net[2], self.radial.out, self.cross.out):
                for parameter in last.parameters():
                    nn.init.zeros_(parameter)
            # Of the own view's blending weight: 1 = one vote among others, large = the own image alone; for rays with
            # measured depth and for those without, whose views may look at different things. Not learned by
            # gradients: on the pixels that it was trained on, the own image is always right.
            self.own_view_factor: torch.Tensor
            self.register_buffer("own_view_factor", torch.ones(2))

    def encode(self, views: SourceViews) -> EncodedViews:
        """Encode each view by itself: features F_j and the depth distribution of every pixel.
        Raises ShapeError: tensors that do not fit together."""
        check_views(views)
        views = sure_depth(views, computed=self.config.encoder.computed_depth)
        feature = self.encoder(views)
        focal = views.K[:, 0, 0] / views.rgb.shape[-1] if self.at_surface else None
        size = (feature.shape[-2], feature.shape[-1])
        geometry = self.geometry_init(feature, depth_at(views, *size), focal, spread_at(views, *size))
        encoded = encoded_views(views, feature, geometry)
        return encoded if views.channel is None else replace(encoded, channel=views.channel.to(torch.int16))

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

    def attend(
        self, space: ContextualSpace, layer: MultiHeadAttention, attention: Callable[..., torch.Tensor]
    ) -> ContextualSpace:
        """M with what attention adds to its features (Eq. 6 to 10)."""
        x = space.feature.transpose(0, 1)  # (R, m, N, C)
        x = x + attention(self._normalised(x), space.valid.transpose(0, 1), layer)
        return replace(space, feature=x.transpose(0, 1))

    def blend_views(
        self, space: ContextualSpace, content: torch.Tensor, own_factor: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Semantic ray s (Eq. 11, 12) of ``content`` (m, R, N, C), and colour of each sample: (R, N, C), (R, N, 3).

        The weights of Eq. 12 are times the views' visibilities: the bounds hold among views that see the sample alike.
        ``own_factor``: (R,) times which the own view's weight counts.
        """
        semantic_score, colour_score = self.weights(self._normalised(space.feature), space.cues)
        colour_weight = softmax_weights(colour_score, space.valid)
        seen = space.visibility + LEAST_VISIBILITY
        semantic_weight = constrained_weights(semantic_score, space.valid, TAU) * seen
        if self.at_surface:
            semantic_weight = semantic_weight * torch.where(space.cues[..., CUES] > 0, own_factor[:, None], 1)
            colour_weight = colour_weight * seen
            colour_weight = colour_weight / colour_weight.sum(0).clamp_min(1e-12)
        semantic_weight = semantic_weight / semantic_weight.sum(0).clamp_min(1e-12)
        s = torch.einsum("mrn,mrnc->rnc", semantic_weight, content)
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

        With ``sample_weight_threshold`` samples of less than that fraction of their ray's weight take no part in the
        attention, and the others' semantics and colour stand for theirs.
        """
        space = contextual_space(rays, z, sources)
        weights = kept = compositing_weights(self.find_density(space), space.delta)
        opacity = weights.sum(dim=1)
        seen = space if self.at_surface else self.mask_occluded(space)
        if sample_weight_threshold > 0:
            heavy = weights >= sample_weight_threshold * opacity[:, None]
            seen = replace(seen, valid=seen.valid & heavy)
            kept = weights * seen.valid.any(0)
            kept = kept * (opacity / kept.sum(1).clamp_min(1e-12))[:, None]
        if self.config.intra_view_attention:
            seen = self.attend(seen, self.radial, radial_attention)
        if self.at_surface:
            seen = self.mask_occluded(surface_space(seen, kept, rays, sources))
        if self.config.cross_view_attention:
            seen = self.attend(seen, self.cross, cross_view_attention)
        content = seen.feature + self.semantic(seen.feature) if self.at_surface else seen.feature
        s, colour = self.blend_views(seen, content, self.own_view_factors(rays))
        if self.at_surface:
            logits, colour = self.classifier(s[:, 0]), colour[:, 0]
        else:
            # The classifier is linear, so logits of blended features equal blended logits: classify once a ray.
            rendered = composite(kept, s + self.semantic(s))
            colour = composite(kept, colour)
            logits = functional.linear(rendered, self.classifier.weight) + opacity[:, None] * self.classifier.bias
        logits = logits + self.label_logit * composite(weights, self.propagate_labels(space))
        known, depth = space.valid.flatten(2).any(2).any(0), composite_depth(weights, z)
        return field_render(logits=logits, depth_m=depth, opacity=opacity, rgb=colour, known=known), weights
