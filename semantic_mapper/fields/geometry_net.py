"""The geometry-aware network: where along each view ray the surface is, and the density sigma of S-Ray Eq. 13.

Per source view and pixel, a mixture of two logistic distributions over depth says where that view ray ends: the
nearer component sits on the measured depth (or on a prediction from the image where there is none), the farther one
behind it. From it follow, for a query sample that lands on this pixel at depth z, the probability that the view ray
hits something within the sample's interval, and the visibility of the sample from that view.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

GEOMETRY_CHANNELS = 5  # mu_1, s_1, mu_2, s_2 in metres, weight of component 1
NEAR_M, FAR_M = 0.2, 12.0
OWN_DENSITY_OFFSET = 6.0  # at the start the views decide alone: 0.0025 / m of density of its own
MEASURED_SHIFT = 0.05  # a measured depth may be moved by at most this fraction
MEASURED_SCALE = 0.01  # initial spread of a measured depth, fraction of z
PREDICTED_SCALE = 0.25  # initial spread of a predicted depth, fraction of z
COMMON_FOCAL = 0.69  # focal length in image widths at which a predicted depth is taken as it is
COLOUR_SCALE = 4.0  # of colours beside features: colours that differ by a quarter have a variance of about 1
LEAST_VISIBILITY = 1e-4  # a sample that is hidden from every view that it projects into takes all of them alike


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

    A first estimate comes from the views' hit probabilities: of the views that can see the sample, the share in which
    the view ray ends there is the sample's opacity. The network corrects it by a gain and adds density of its own.

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
