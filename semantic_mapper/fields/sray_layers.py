"""The layers of S-Ray: what source views know of a ray's samples, density, attention, and the weights of the views.

The geometry-aware network: per source view and pixel, a mixture of two logistic distributions over depth says where
that view ray ends: the nearer component sits on the measured depth (or on a prediction from the image where there is
none), the farther one behind it. From it follow, for a query sample that lands on this pixel at depth z, the
probability that the view ray hits something within the sample's interval, and the visibility of the sample from that
view.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
import math
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.source_views import GEOMETRY_CHANNELS, gather, reproject
from semantic_mapper.fields.volume import interval_lengths
from semantic_mapper.types import RayBatch

NEAR_M, FAR_M = 0.2, 12.0
OWN_DENSITY_OFFSET = 6.0  # at the start the views decide alone: 0.0025 / m of density of its own
MEASURED_SHIFT = 0.05  # a measured depth may be moved by at most this fraction
MEASURED_SCALE = 0.01  # initial spread of a measured depth, fraction of z
PREDICTED_SCALE = 0.25  # initial spread of a predicted depth, fraction of z
COMMON_FOCAL = 0.69  # focal length in image widths at which a predicted depth is taken as it is
COLOUR_SCALE = 4.0  # of colours next to features: colours that differ by a quarter have a variance of about 1
LEAST_VISIBILITY = 1e-4  # a sample that is hidden from every view that it projects into takes all of them alike
CUES = 4  # hit, visibility, view cosine, spread of the depth: what a view knows of a sample next to its feature
SURFACE_CUES = CUES + 1  # and whether the view is the query's own, for a token at the surface
BACKGROUND_M = 1e4  # where a ray ends that meets nothing
OWN_RADIUS_M = 1e-3  # a view whose camera is that near to the ray's origin is the query's own
FUSED_FROM = 16  # tokens from which one fused attention kernel is faster on a CPU; for few it is not


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
        """Mixture parameters (m, 5, h, w).

        Args:
            feature: (m, C, h, w).
            depth_m: (m, h, w), 0 = none.
            focal: (m,) focal length in image widths, which a predicted depth is proportional to: a thing looks the same
                through a lens of twice the focal length at twice the distance. None = ``COMMON_FOCAL``.
            spread: (m, h, w) of the given depth where it was computed from pictures, as a fraction of it; 0 = measured.
        """
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
    """Probability that a view ray ends within z +- half_interval, and that it is still free before it.

    Args:
        geometry: (..., 5) mixture parameters at the pixel that the sample lands on.
        z: (...) depth of the sample in the source camera, metres.
        half_interval: broadcastable to z, metres.

    Returns:
        hit, visibility: (...) in [0, 1].
    """
    mu_1, s_1, mu_2, s_2, fraction = geometry.unbind(-1)
    near, far = z - half_interval, z + half_interval
    cdf_near = fraction * torch.sigmoid((near - mu_1) / s_1) + (1 - fraction) * torch.sigmoid((near - mu_2) / s_2)
    cdf_far = fraction * torch.sigmoid((far - mu_1) / s_1) + (1 - fraction) * torch.sigmoid((far - mu_2) / s_2)
    return cdf_far - cdf_near, 1 - cdf_near


class DensityNet(nn.Module):
    """Density of each sample from what all views say about it, with one attention layer along the ray.

    A first estimate comes from the views' hit probabilities: of the views that can see the sample, the fraction in
    which the view ray ends there is the sample's opacity. The network corrects it by a gain and adds density of its
    own.

    Args:
        dim: Values a view and sample, C: features, and colours where views are to agree in these, too.
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
        """sigma (R, N) in 1 / m; 0 where no view sees the sample.

        Args:
            values: (m, R, N, C).
            hit, visibility, valid: (m, R, N).
            delta: (R, N) interval lengths, metres.
        """
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
    """The space M of Eq. 5 with what goes with it, view-first.

    Args:
        feature: (m, R, N, C).
        rgb: (m, R, N, 3).
        cues: (m, R, N, CUES); of tokens at the surface SURFACE_CUES.
        hit, visibility: (m, R, N) in [0, 1].
        valid: (m, R, N) bool.
        delta: (R, N) interval lengths, metres.
        channel: (m, R, N) int64 known label at the sample, -1 = none.
    """

    feature: torch.Tensor
    rgb: torch.Tensor
    cues: torch.Tensor
    hit: torch.Tensor
    visibility: torch.Tensor
    valid: torch.Tensor
    delta: torch.Tensor
    channel: torch.Tensor


def contextual_space(rays: RayBatch, z: torch.Tensor, sources: EncodedViews) -> ContextualSpace:
    """Reproject samples z (R, N) of whole rays into all views and gather M (S-Ray Eq. 3 to 5)."""
    where = reproject(rays, z, sources)
    found = gather(sources, where)
    delta = interval_lengths(z, rays.direction.norm(dim=-1))
    hit, visibility = hit_and_visibility(found.geometry, where.z, 0.5 * delta)
    hit, visibility = hit * where.valid, visibility * where.valid
    cues = torch.stack((hit, visibility, where.view_cosine, torch.log(found.geometry[..., 1])), dim=-1)
    return ContextualSpace(found.feature, found.rgb, cues, hit, visibility, where.valid, delta, found.channel)


def background_space(rays: RayBatch, sources: EncodedViews) -> ContextualSpace:
    """What the views hold in the direction of each ray, infinitely far away: M with N = 1.

    The sky, or what lies beyond the sensor's range: it has no depth, but every view that looks that way has an opinion.
    """
    where = reproject(rays, rays.origin.new_full((len(rays.origin), 1), BACKGROUND_M), sources)
    found = gather(sources, where)
    hit, visibility = hit_and_visibility(found.geometry, where.z, where.z.new_zeros(()))
    visibility = visibility * where.valid
    cues = torch.stack((hit, visibility, where.view_cosine, torch.log(found.geometry[..., 1])), dim=-1)
    nowhere = rays.origin.new_zeros(len(rays.origin), 1)
    channel = torch.full_like(found.channel, -1)
    return ContextualSpace(found.feature, found.rgb, cues, hit, visibility, where.valid, nowhere, channel)


def surface_space(
    space: ContextualSpace, weights: torch.Tensor, rays: RayBatch, sources: EncodedViews
) -> ContextualSpace:
    """M with one token a view (N = 1): its samples composited, what lies infinitely far behind them included.

    The query's own view sees all of its ray, wherever that ends: its samples land on one pixel. So it outweighs the
    others where no depth is known and their visibilities are guesses.

    Args:
        space: Of N samples a ray.
        weights: (R, N) compositing weights; what they leave of 1 belongs to the background.
    """
    far = background_space(rays, sources)
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
        channel=far.channel,
    )


def masked_attention(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, key_valid: torch.Tensor) -> torch.Tensor:
    """Scaled dot-product attention of Eq. 7 in which invalid keys get no weight.

    Args:
        q, k, v: (B, H, S, d_k).
        key_valid: (B, S) bool.

    Returns:
        (B, H, S, d_k); zeros where no key is valid.
    """
    if q.shape[-2] >= FUSED_FROM and q.device.type == "cpu":
        some = key_valid.any(-1, keepdim=True)  # without any valid key the kernel would give NaN
        allowed = (key_valid | ~some)[:, None, None, :]
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=allowed) * some[:, :, None, None]
    score = (q @ k.transpose(-1, -2)) / math.sqrt(q.shape[-1])  # (B, H, S, S)
    score = score.masked_fill(~key_valid[:, None, None, :], -1e9)
    weight = torch.softmax(score, dim=-1) * key_valid[:, None, None, :]
    return weight @ v


class MultiHeadAttention(nn.Module):
    """f(Q, K, V) = Concat(A_1 .. A_H) W_o of Eq. 6 to 8, with d_k = C / H.

    Args:
        dim: C.
        heads: H.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.out = nn.Linear(dim, dim, bias=False)

    def forward(self, x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        """Attend over the S tokens of each row: (B, S, C), (B, S) bool -> (B, S, C)."""
        rows, tokens, dim = x.shape
        qkv = self.qkv(x).view(rows, tokens, 3, self.heads, dim // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)  # (B, H, S, d_k) each
        attended = masked_attention(q, k, v, valid)
        return self.out(attended.transpose(1, 2).reshape(rows, tokens, dim))


def radial_attention(x: torch.Tensor, valid: torch.Tensor, layer: MultiHeadAttention) -> torch.Tensor:
    """Intra-view radial attention, Eq. 9: over the N samples of one view. x (R, m, N, C), valid (R, m, N)."""
    rays, views, samples, dim = x.shape
    out = layer(x.reshape(rays * views, samples, dim), valid.reshape(rays * views, samples))
    return out.view(rays, views, samples, dim)


def cross_view_attention(x: torch.Tensor, valid: torch.Tensor, layer: MultiHeadAttention) -> torch.Tensor:
    """Cross-view sparse attention, Eq. 10: over the m views at one sample. x (R, m, N, C), valid (R, m, N)."""
    rays, views, samples, dim = x.shape
    out = layer(
        x.transpose(1, 2).reshape(rays * samples, views, dim), valid.transpose(1, 2).reshape(rays * samples, views)
    )
    return out.view(rays, samples, views, dim).transpose(1, 2)


def constrained_weights(score: torch.Tensor, valid: torch.Tensor, tau: float) -> torch.Tensor:
    """Map free scores to view weights in C(tau): tau / m < w_i < 1 / (tau m), sum 1, over the m valid views (Eq. 12).

    Scores are squashed to +-ln(1 / tau) / 2 before the softmax, so no two views differ by more than a factor of tau;
    both bounds follow from that for any m. Invalid views get exactly 0; all are 0 where no view is valid.

    Args:
        score: (m, ...) one score a view.
        valid: (m, ...) bool.
        tau: in (0, 1).
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

    def start_alike(self) -> None:
        """Let all views have the same scores until training says otherwise."""
        last = self.net[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, feature: torch.Tensor, extra: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(m, R, N, C), (m, R, N, E) -> semantic and colour score, (m, R, N) each."""
        semantic, colour = self.net(torch.cat((feature, extra), dim=-1)).unbind(-1)
        return semantic, colour
