"""Cross-reprojection attention (S-Ray Eq. 6 to 10): radial within a view, then sparse across views."""

from __future__ import annotations

import math

import torch
from torch import nn
from torch.nn import functional

PUBLISHED_HEAD_DIM = 4
FUSED_FROM = 16  # tokens from which one fused kernel is faster on a CPU; for few it is not


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


def published_attention(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """As the published code: invalid *query rows* are flattened to uniform weights, invalid keys stay in."""
    score = (q @ k.transpose(-1, -2)) / math.sqrt(q.shape[-1])
    score = score.masked_fill(~valid[:, None, :, None], -1e9)
    return torch.softmax(score, dim=-1) @ v


class MultiHeadAttention(nn.Module):
    """f(Q, K, V) = Concat(A_1 .. A_H) W_o of Eq. 6 to 8, with d_k = C / H.

    Args:
        dim: C.
        heads: H.
        published: d_k = 4 and masked query rows, as the published code has it.
    """

    def __init__(self, dim: int, heads: int, *, published: bool = False) -> None:
        super().__init__()
        self.heads = heads
        self.head_dim = PUBLISHED_HEAD_DIM if published else dim // heads
        self.published = published
        inner = self.heads * self.head_dim
        self.qkv = nn.Linear(dim, 3 * inner, bias=False)
        self.out = nn.Linear(inner, dim, bias=False)

    def forward(self, x: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        """Attend over the S tokens of each row: (B, S, C), (B, S) bool -> (B, S, C)."""
        rows, tokens, _ = x.shape
        qkv = self.qkv(x).view(rows, tokens, 3, self.heads, self.head_dim)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)  # (B, H, S, d_k) each
        attend = published_attention if self.published else masked_attention
        attended = attend(q, k, v, valid)
        return self.out(attended.transpose(1, 2).reshape(rows, tokens, -1))


def positional_encoding(samples: int, dim: int, like: torch.Tensor) -> torch.Tensor:
    """Sinusoid of the sample index, (N, C). Off by default: the paper uses no positional encoding."""
    position = torch.arange(samples, dtype=like.dtype, device=like.device)[:, None]
    rate = torch.exp(torch.arange(0, dim, 2, dtype=like.dtype, device=like.device) * (-math.log(10000.0) / dim))
    code = like.new_zeros(samples, dim)
    code[:, 0::2] = torch.sin(position * rate)
    code[:, 1::2] = torch.cos(position * rate)
    return code


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
