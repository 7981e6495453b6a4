"""Samples along rays, and volume rendering (S-Ray Eq. 2 and 13), as pure functions.

Sample positions are ascending z depths (R, N) in metres.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.fields.sampling import guided_samples
from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import FieldRender, RayBatch


def sample_inverse_depth(
    near_m: torch.Tensor, far_m: torch.Tensor, count: int, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Samples uniform in 1 / z between near and far, (R,) -> (R, count): interval midpoints without a generator; with
    one, a random place in each interval (stratified)."""
    steps = torch.arange(count, dtype=near_m.dtype, device=near_m.device)
    if generator is None:
        fraction = (steps + 0.5)[None, :].expand(len(near_m), count) / count
    else:
        noise = torch.rand(len(near_m), count, generator=generator, dtype=near_m.dtype, device=near_m.device)
        fraction = (steps + noise) / count
    near_inv, far_inv = 1 / near_m[:, None], 1 / far_m[:, None]
    return 1 / (near_inv + fraction * (far_inv - near_inv))


def sample_guided(rays: RayBatch, config: SamplingConfig) -> torch.Tensor:
    """``guided_samples`` of rays."""
    prior, near, far = (each.cpu().numpy() for each in (rays.prior_depth_m, rays.near_m, rays.far_m))
    return torch.from_numpy(guided_samples(prior, near, far, config)).to(rays.prior_depth_m.device)


def sample_from_weights(z: torch.Tensor, weights: torch.Tensor, count: int) -> torch.Tensor:
    """Depths (R, count) at evenly spaced quantiles of the piecewise-constant distribution that ``weights`` (R, N) put
    on intervals round z: inverse-CDF sampling in inverse depth. Not differentiable."""
    inv = 1 / z
    mid = (inv[:, 1:] + inv[:, :-1]) / 2
    edges = torch.cat((inv[:, :1], mid, inv[:, -1:]), dim=1)  # (R, N + 1)
    pdf = weights.detach() + 1e-5
    cdf = torch.cumsum(pdf / pdf.sum(dim=1, keepdim=True), dim=1)
    cdf = torch.cat((torch.zeros_like(cdf[:, :1]), cdf), dim=1)  # (R, N + 1)
    u = (torch.arange(count, dtype=z.dtype, device=z.device) + 0.5).expand(len(z), count) / count
    upper = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, z.shape[1])
    lower = upper - 1
    c0, c1 = cdf.gather(1, lower), cdf.gather(1, upper)
    e0, e1 = edges.gather(1, lower), edges.gather(1, upper)
    drawn = e0 + (u - c0) / (c1 - c0).clamp_min(1e-8) * (e1 - e0)
    return (1 / drawn).sort(dim=1).values


def interval_lengths(z: torch.Tensor, direction_norm: torch.Tensor) -> torch.Tensor:
    """Metric lengths delta_k = (z_{k+1} - z_k) |d|; the last interval repeats the one before it.
    ``z``: (R, N) ascending sample depths in metres, N >= 2. ``direction_norm``: (R,) length of the ray direction a
    metre of z. Returns (R, N) metres."""
    expect_shape(z, "R N", "z")
    delta = z[:, 1:] - z[:, :-1]
    return torch.cat((delta, delta[:, -1:]), dim=1) * direction_norm[:, None]


def compositing_weights(sigma: torch.Tensor, delta: torch.Tensor) -> torch.Tensor:
    """Weights T(z_k) (1 - exp(-sigma_k delta_k)), T(z_k) = exp(-sum_{k'<k} sigma_k' delta_k').

    Of densities (R, N) in 1 / m and interval lengths in m: (R, N) in [0, 1], whose sum is the ray's opacity.
    """
    optical_depth = sigma * delta
    alpha = -torch.expm1(-optical_depth)
    before = torch.cumsum(optical_depth, dim=1) - optical_depth
    return torch.exp(-before) * alpha


def composite(weights: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Sum of per-sample values over each ray: (R, N), (R, N, D) -> (R, D)."""
    return torch.einsum("rn,rnd->rd", weights, values)


def composite_depth(weights: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """Expected z of what the ray hits, (R,); 0 where the ray is transparent."""
    opacity = weights.sum(dim=1)
    return (weights * z).sum(dim=1) / opacity.clamp_min(1e-6) * (opacity > 1e-3)


def field_render(
    *, logits: torch.Tensor, depth_m: torch.Tensor, opacity: torch.Tensor, rgb: torch.Tensor, known: torch.Tensor
) -> FieldRender:
    """A ``FieldRender`` with zero logits, hence full entropy, where ``known`` (R,) is False."""
    logits = logits * known[:, None]
    log_p = torch.log_softmax(logits, dim=-1)
    return FieldRender(
        logits=logits, depth_m=depth_m, opacity=opacity, rgb=rgb, entropy=-(log_p.exp() * log_p).sum(-1), known=known
    )
