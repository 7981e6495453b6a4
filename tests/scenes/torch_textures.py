"""The procedural patterns in plain torch; fast_textures.h holds the compiled twins."""

from __future__ import annotations

import torch

from semantic_mapper.scenes.materials import Pattern

_MASK = 0xFFFFFFFF


def albedo(
    pattern: torch.Tensor,
    color_a: torch.Tensor,
    color_b: torch.Tensor,
    scale_m: torch.Tensor,
    seed: torch.Tensor,
    local: torch.Tensor,
    half: torch.Tensor,
    axis: torch.Tensor,
) -> torch.Tensor:
    """Linear albedo (N, 3) at N surface points.

    Args:
        pattern, scale_m, seed: (N,) of each point's material; color_a, color_b: (N, 3).
        local, half: (N, 3) point and half extents in the primitive's own axes, metres.
        axis: (N,) dominant axis of the normal; the pattern lies across it.
    """
    first = torch.where(axis == 0, 1, 0)
    second = torch.where(axis == 2, 1, 2)
    grained = (pattern == int(Pattern.WOOD)) | (pattern == int(Pattern.PLANKS))
    swap = grained & (_take(half, first) > _take(half, second))
    first, second = torch.where(swap, second, first), torch.where(swap, first, second)
    s, t = _take(local, first) / scale_m, _take(local, second) / scale_m
    blend, third = torch.zeros_like(s), torch.zeros_like(s)
    for kind in Pattern:
        mine = pattern == int(kind)
        if bool(mine.any()):
            blend[mine], third[mine] = _PATTERNS[kind](s[mine], t[mine], seed[mine])
    base = color_a * (1 - blend[:, None]) + color_b * blend[:, None]
    return base * (1 - third[:, None]) + third[:, None] * (0.5 * color_a.flip(-1) + 0.3 * color_b)


Weights = tuple[torch.Tensor, torch.Tensor]  # fraction of the second colour, fraction of a third one


def _plain(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    return _noise(s, t, seed), torch.zeros_like(s)


def _wood(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    return 0.7 * _noise(s, t * 0.06, seed) + 0.3 * _noise(s * 3.0, t * 0.2, seed + 1), torch.zeros_like(s)


def _stripes(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    return (s - s.floor() < 0.5).to(s.dtype), torch.zeros_like(s)


def _checker(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    return ((s.floor().long() + t.floor().long()) & 1).to(s.dtype), torch.zeros_like(s)


def _tiles(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    joint = (s - s.floor() < 0.04) | (t - t.floor() < 0.04)
    shade = 0.3 * _hash(s.floor().long(), t.floor().long(), seed).to(s.dtype)
    return torch.where(joint, 1.0, shade), torch.zeros_like(s)


def _weave(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    return 0.5 * _noise(s, t * 0.25, seed) + 0.5 * _noise(s * 0.25, t, seed + 1), torch.zeros_like(s)


def _print(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    n = 0.65 * _noise(s, t, seed) + 0.35 * _noise(s * 2.7, t * 2.7, seed + 1)
    return (n > 0.5).to(s.dtype), ((n > 0.44) & (n < 0.5)).to(s.dtype)


def _spines(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    shifted = s + 0.35 * _hash(s.floor().long(), torch.full_like(seed, 7), seed).to(s.dtype)
    cell = shifted.floor().long()
    first = _hash(cell, torch.ones_like(seed), seed).to(s.dtype)
    return first, 0.6 * _hash(cell, torch.full_like(seed, 2), seed).to(s.dtype)


def _planks(s: torch.Tensor, t: torch.Tensor, seed: torch.Tensor) -> Weights:
    row = s.floor().long()
    along = t * 0.125 + _hash(row, torch.full_like(seed, 3), seed).to(s.dtype)
    joint = (s - s.floor() < 0.03) | (along - along.floor() < 0.004)
    shade = 0.55 * _hash(row, along.floor().long(), seed).to(s.dtype) + 0.3 * _noise(s * 8.0, t * 0.5, seed + 1)
    return torch.where(joint, 1.0, shade), torch.zeros_like(s)


_PATTERNS = {
    Pattern.PLAIN: _plain,
    Pattern.WOOD: _wood,
    Pattern.STRIPES: _stripes,
    Pattern.CHECKER: _checker,
    Pattern.TILES: _tiles,
    Pattern.WEAVE: _weave,
    Pattern.PRINT: _print,
    Pattern.SPINES: _spines,
    Pattern.PLANKS: _planks,
}


def _take(values: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    return values.gather(1, axis[:, None])[:, 0]


def _hash(i: torch.Tensor, j: torch.Tensor, seed: torch.Tensor) -> torch.Tensor:
    """Two integers and a seed -> [0, 1) float64, the same on every machine."""
    h = (i * 374761393 + j * 668265263 + seed * 974634777) & _MASK
    h = ((h ^ (h >> 13)) * 1274126177) & _MASK
    h = ((h ^ (h >> 16)) * 1911520717) & _MASK
    return ((h ^ (h >> 15)) & 0xFFFFFF).double() / 16777216.0


def _noise(x: torch.Tensor, y: torch.Tensor, seed: torch.Tensor) -> torch.Tensor:
    """Smooth value noise in [0, 1]."""
    fx, fy = x.floor(), y.floor()
    i, j = fx.long(), fy.long()
    a, b = x - fx, y - fy
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    corner = [_hash(i + di, j + dj, seed).to(x.dtype) for dj in (0, 1) for di in (0, 1)]
    top = corner[0] * (1 - a) + corner[1] * a
    low = corner[2] * (1 - a) + corner[3] * a
    return top * (1 - b) + low * b
