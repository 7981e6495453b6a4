"""The procedural patterns in plain torch; fast_textures.h holds the compiled twins."""

from __future__ import annotations

import torch

from research.scenes.materials import Pattern

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
    footprint: torch.Tensor,
) -> torch.Tensor:
    """Linear albedo (N, 3) at N surface points.

    Args:
        pattern, scale_m, seed: (N,) of each point's material; color_a, color_b: (N, 3).
        local, half: (N, 3) point and half extents in the primitive's own axes, metres.
        axis: (N,) dominant axis of the normal; the pattern lies across it.
        footprint: (N,) width of a pixel at the point, metres.
    """
    first = torch.where(axis == 0, 1, 0)
    second = torch.where(axis == 2, 1, 2)
    grained = torch.isin(pattern, torch.tensor(_GRAINED, device=pattern.device))
    swap = grained & (_take(half, first) > _take(half, second))
    first, second = torch.where(swap, second, first), torch.where(swap, first, second)
    x, y = _take(local, first), _take(local, second)
    place = torch.stack((x / scale_m, y / scale_m, y / _take(half, second), footprint / scale_m))  # 4 N
    blend, third = torch.zeros_like(x), torch.zeros_like(x)
    for kind in _PATTERNS:
        mine = pattern == int(kind)
        if bool(mine.any()):
            found = _PATTERNS[kind](*place[:, mine], seed[mine])
            blend[mine], third[mine] = (weight.to(x.dtype) for weight in found)  # hashes are float64
    uneven = (
        1
        + 0.3 * (_noise(x / 0.45, y / 0.45, seed + 11) - 0.5)
        + 0.2 * _fine(x / 0.05, y / 0.05, seed + 12, footprint / 0.05)
    )
    uneven = torch.where(pattern == int(Pattern.FLAT), 1.0, uneven)
    base = color_a * (1 - blend[:, None]) + color_b * blend[:, None]
    return uneven[:, None] * (base * (1 - third[:, None]) + third[:, None] * (0.5 * color_a.flip(-1) + 0.3 * color_b))


T = torch.Tensor
Weights = tuple[T, T]  # fraction of the second colour, fraction of a third one


def _resolved(wavelength: float, p: T) -> T:
    return (0.5 * wavelength / p.clamp_min(1e-9) - 1).clamp(0, 1)


def _fine(x: T, y: T, seed: T, p: T) -> T:
    return _resolved(1.0, p) * (_noise(x, y, seed) - 0.5)


def _clouds(x: T, y: T, seed: T, p: T) -> T:
    return (
        0.5
        + 0.55 * _fine(x, y, seed, p)
        + 0.28 * _fine(2.3 * x, 2.3 * y, seed + 1, 2.3 * p)
        + 0.17 * _fine(5.7 * x, 5.7 * y, seed + 2, 5.7 * p)
    )


def _at(i: T | int, j: T | int, seed: T) -> T:
    """Hash in [0, 1) float of integers or floored floats."""
    i, j = (torch.full_like(seed, k) if isinstance(k, int) else k.floor().long() for k in (i, j))
    return _hash(i, j, seed)


def _frac(x: T) -> T:
    return x - x.floor()


def _plain(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    return _clouds(s, t, seed, p), torch.zeros_like(s)


def _wood(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    f = 0.5 + 0.7 * _fine(s, t * 0.06, seed, p) + 0.3 * _fine(s * 3.0, t * 0.2, seed + 1, 3 * p)
    return f.clamp(0, 1), torch.zeros_like(s)


def _stripes(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    return 0.5 + _resolved(1.0, p) * torch.where(_frac(s) < 0.5, 0.5, -0.5), torch.zeros_like(s)


def _checker(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    odd = (s.floor().long() + t.floor().long()) & 1
    return 0.5 + _resolved(2.0, p) * (odd - 0.5), torch.zeros_like(s)


def _tiles(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    joint = (_frac(s) < 0.04) | (_frac(t) < 0.04)
    n = torch.where(joint, 1.0, 0.3 * _at(s, t, seed))
    f = 0.2 + _resolved(1.0, p) * (n - 0.2) + 0.15 * _fine(3.0 * s, 3.0 * t, seed + 1, 3.0 * p)
    return f, torch.zeros_like(s)


def _weave(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    f = 0.5 + 0.5 * _fine(s, t * 0.25, seed, p) + 0.5 * _fine(s * 0.25, t, seed + 1, p)
    return f, torch.zeros_like(s)


def _print(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    n = 0.65 * _noise(s, t, seed) + 0.35 * _noise(s * 2.7, t * 2.7, seed + 1)
    return (n > 0.5).to(s.dtype), ((n > 0.44) & (n < 0.5)).to(s.dtype)


def _spines(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    cell = s + 0.35 * _at(s, 7, seed)
    return 0.5 + _resolved(2.0, p) * (_at(cell, 1, seed) - 0.5), 0.6 * _at(cell, 2, seed)


def _planks(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    along = t * 0.125 + _at(s, 3, seed)
    joint = (_frac(s) < 0.03) | (_frac(along) < 0.004)
    shade = 0.55 * _at(s, along, seed) + 0.3 * _noise(s * 8.0, t * 0.5, seed + 1)
    return torch.where(joint, 1.0, shade), torch.zeros_like(s)


def _grain(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    ring = 0.9 * s + 2.6 * _noise(0.3 * s, 0.035 * t, seed)
    dx, dy = (_frac(0.12 * s) - 0.5) * 5.0, (_frac(0.04 * t) - 0.5) * 4.0
    knot = torch.where(_at(0.12 * s, 0.04 * t, seed + 3) < 0.45, (1 - dx * dx - dy * dy).clamp_min(0), 0.0)
    r = _frac(ring + 2.0 * knot * knot)
    year = torch.where(r < 0.75, r / 0.75, (1 - r) / 0.25)
    f = 0.5 + 0.55 * _resolved(1.1, p) * (year - 0.5) + 0.5 * _fine(5.0 * s, 0.15 * t, seed + 1, 5.0 * p)
    f = f + 0.4 * _fine(0.2 * s, 0.05 * t, seed + 2, 0.2 * p) + 0.5 * knot * knot
    return f.clamp(0, 1), torch.zeros_like(s)


def _stone(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    n, sharp = _at(6.0 * s, 6.0 * t, seed + 3), _resolved(0.33, p)
    f = 0.5 + 1.3 * (_clouds(s, t, seed, p) - 0.5) + sharp * torch.where(n < 0.12, 0.45, 0.0)
    return f.clamp(0, 1), torch.where(n > 0.93, 0.7 * sharp, 0.0)


def _brushed(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    f = 0.5 + 0.4 * _fine(4.0 * s, t * 0.04, seed, 4.0 * p) + 0.3 * _fine(12.0 * s, t * 0.1, seed + 1, 12.0 * p)
    return f + 0.5 * _fine(s * 0.15, t * 0.1, seed + 2, 0.15 * p), torch.zeros_like(s)


def _carpet(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    n = _fine(2.5 * s, 0.1 * t, seed, 2.5 * p) + 0.5 * _fine(0.4 * s, 0.04 * t, seed + 1, 0.4 * p)
    return (0.5 + 1.7 * n + 0.5 * _fine(14.0 * s, 14.0 * t, seed + 2, 14.0 * p)).clamp(0, 1), torch.zeros_like(s)


def _page(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    column = s * 0.09
    block = t * 0.14 + 3.0 * _at(column, 5, seed)
    kind, none = _at(column, block, seed), torch.zeros_like(s)
    inked = (_frac(t) < 0.5) & (_at(1.4 * s, t, seed + 1) > 0.2)
    text = 0.3 + _resolved(1.6, p) * (torch.where(inked, 0.8, 0.0) - 0.3)
    head = ((_frac(0.35 * t) < 0.5) & (_at(0.6 * s, 0.35 * t, seed + 2) > 0.25)).to(s.dtype)
    photo = (2.2 * (_clouds(0.35 * s, 0.35 * t, seed + 4, 0.35 * p) - 0.5) + 0.5).clamp(0, 1)
    is_photo = (kind >= 0.5) & (kind < 0.78)
    f = torch.where(kind < 0.35, text, torch.where(kind < 0.5, head, torch.where(is_photo, photo, none)))
    return f, torch.where(is_photo, _at(column, block, seed + 3), none)


def _outside(s: T, h_: T, h: T, p: T, seed: T) -> Weights:
    horizon = -0.5 + 0.7 * _at(0, 9, seed)
    x, plot = _frac(0.8 * s), 0.8 * s
    roof = horizon + 0.15 + 0.9 * _at(plot, 1, seed)
    house = (_at(plot, 2, seed) < 0.45) & (x > 0.08) & (x < 0.92)
    house = house & (h < roof - 0.35 * (x - 0.5).abs()) & (h > horizon - 0.1)
    u, v = _frac(5.0 * x), _frac(5.0 * h)
    wall = torch.where((u > 0.3) & (u < 0.75) & (v > 0.3) & (v < 0.8), 1.0, 0.25)
    half = torch.full_like(s, 0.5)
    trees = horizon + 0.55 * _noise(1.7 * s, half, seed + 1) + 0.2 * _noise(7.0 * s, half, seed + 2)
    leaves = (0.8 + 0.9 * (_clouds(4.0 * s, 4.0 * h, seed + 3, 4.0 * p) - 0.5)).clamp(0, 1)
    cloud = (3.0 * (_clouds(0.8 * s, 2.0 * h, seed + 4, 2.0 * p) - 0.5)).clamp(0, 1)
    sky = 0.12 * (1 - h) * (1 - cloud)
    far = torch.where(h < trees, torch.where(h < horizon, 0.8, leaves), sky)
    return torch.where(house, wall, far), torch.where(house, 0.85, 0.0)


def _stains(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    n = _noise(2.0 * s, 0.25 * t, seed + 4)
    return (_clouds(s, t, seed, p) + 0.5 * n * n - 0.12).clamp(0, 1), torch.zeros_like(s)


def _windows(s: T, t: T, h: T, p: T, seed: T) -> Weights:
    pane = (_frac(s) > 0.28) & (_frac(s) < 0.72) & (_frac(t) > 0.3) & (_frac(t) < 0.8)
    return 0.22 + _resolved(1.0, p) * (pane.to(s.dtype) - 0.22), torch.zeros_like(s)


_GRAINED = (Pattern.WOOD, Pattern.PLANKS, Pattern.GRAIN, Pattern.BRUSHED)
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
    Pattern.GRAIN: _grain,
    Pattern.STONE: _stone,
    Pattern.BRUSHED: _brushed,
    Pattern.CARPET: _carpet,
    Pattern.PAGE: _page,
    Pattern.OUTSIDE: _outside,
    Pattern.STAINS: _stains,
    Pattern.WINDOWS: _windows,
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
