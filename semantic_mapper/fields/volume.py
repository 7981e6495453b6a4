"""Volume rendering as pure functions (S-Ray Eq. 2 and 13)."""

from __future__ import annotations

import torch

from semantic_mapper.geometry import expect_shape


def interval_lengths(z: torch.Tensor, direction_norm: torch.Tensor) -> torch.Tensor:
    """Metric lengths delta_k = (z_{k+1} - z_k) |d|; the last interval repeats the one before it.

    Args:
        z: (R, N) ascending sample depths in metres, N >= 2.
        direction_norm: (R,) length of the ray direction a metre of z.

    Returns:
        (R, N) metres.
    """
    expect_shape(z, "R N", "z")
    delta = z[:, 1:] - z[:, :-1]
    return torch.cat((delta, delta[:, -1:]), dim=1) * direction_norm[:, None]


def compositing_weights(sigma: torch.Tensor, delta: torch.Tensor) -> torch.Tensor:
    """Weights T(z_k) (1 - exp(-sigma_k delta_k)), T(z_k) = exp(-sum_{k'<k} sigma_k' delta_k').

    Args:
        sigma: (R, N) density, 1 / m, non-negative.
        delta: (R, N) interval lengths, m.

    Returns:
        (R, N) in [0, 1]; their sum over a ray is its opacity, at most 1. Differentiable.
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
