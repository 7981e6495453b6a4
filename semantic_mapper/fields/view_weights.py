"""The semantic-aware weight network (S-Ray Eq. 11 and 12)."""

from __future__ import annotations

import math

import torch
from torch import nn


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
