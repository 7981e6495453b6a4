"""Solid textures: colours carved out of noise that fills space, whose spectrum falls as those of photographs do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import product

import numpy as np

from semantic_mapper.types import Float32, Float64, Int64

_SIDE = 64  # of the noise, which repeats


class Grain(IntEnum):
    """How a place becomes a number in [0, 1]."""

    CLOUD = 0  # the noise itself
    RINGS = 1  # wood: distances from an axis, disturbed
    VEINS = 2  # marble: where the noise crosses zero
    BANDS = 3  # contour lines of the noise
    STRIPES = 4  # planes, slightly bent
    FIBRE = 5  # noise drawn out along one axis
    MOSAIC = 6  # cells, each of its own tone
    SLATS = 7  # planes, each of its own tone


@dataclass(frozen=True, slots=True, eq=False)
class Veneer:
    """What the materials of a scene reflect, in place of their patterns.

    Args:
        grain: (M,) int64 of ``Grain``, one a material.
        stops: (M, 3, 3) float64 linear RGB at 0, 1/2 and 1.
        scale_m: (M,) float64 size of the features.
        turn: (M, 3, 3) float64 rotation of the grain in the world.
        noise: (64, 64, 64) float32 in [0, 1], periodic.
        sky: Light from above over that from below, on a surface's ambient half.
    """

    grain: Int64
    stops: Float64
    scale_m: Float64
    turn: Float64
    noise: Float32
    sky: float


def solid_noise(rng: np.random.Generator, exponent: float) -> Float32:
    """(64, 64, 64) float32 periodic noise, evenly spread in [0, 1], with amplitudes 1 / f ** ``exponent``."""
    axes = np.meshgrid(*[np.fft.fftfreq(_SIDE) * _SIDE] * 3, indexing="ij")
    frequency = np.sqrt(sum(a * a for a in axes))
    frequency[0, 0, 0] = np.inf
    white = np.fft.fftn(rng.standard_normal((_SIDE,) * 3))
    field = np.fft.ifftn(white / frequency ** (exponent + 0.5)).real
    return (field.ravel().argsort().argsort() / field.size).reshape(field.shape).astype(np.float32)


def reflectance(veneer: Veneer, points: Float64, material: Int64) -> Float32:
    """Linear RGB (N, 3) float32 of materials (N,) at places (N, 3), world metres."""
    out = np.empty((len(points), 3), np.float32)
    for m in np.unique(material).tolist():
        at = material == m
        tone = np.clip(_tone(veneer, points[at] @ veneer.turn[m], m), 0.0, 1.0)
        out[at] = np.stack([np.interp(tone, (0.0, 0.5, 1.0), veneer.stops[m, :, c]) for c in range(3)], -1)
    return out


def _tone(veneer: Veneer, q: Float64, m: int) -> Float64:
    q = q / veneer.scale_m[m]
    grain = Grain(int(veneer.grain[m]))
    stretch = np.array((1.0, 1.0, 0.06)) if grain in (Grain.FIBRE, Grain.RINGS) else 1.0
    n = _between(veneer.noise, q * stretch * 8.0 + 7.0 * m)
    if grain == Grain.RINGS:
        return np.abs(((np.hypot(q[:, 0] + 9.0, q[:, 1]) + 0.8 * n) % 1.0) ** 0.7 * 2.0 - 1.0)
    if grain == Grain.VEINS:
        return 1.0 - np.exp(-np.abs(n - 0.5) * 16.0)
    if grain == Grain.BANDS:
        return np.floor(n * 7.0) % 2.0 * 0.7 + 0.3 * n
    if grain == Grain.STRIPES:
        return 0.5 + 0.5 * np.tanh(6.0 * np.sin(2.0 * np.pi * (q[:, 0] + 0.15 * n)))
    if grain in (Grain.MOSAIC, Grain.SLATS):
        cell = np.floor(q if grain == Grain.MOSAIC else q[:, :1])
        hashed = np.sin(cell @ np.array((12.99, 78.23, 37.72))[: cell.shape[1]]) * 43758.5453
        edge = np.abs(q[:, : cell.shape[1]] - cell - 0.5).max(1) > 0.46
        return np.where(edge, 0.0, 0.85 * (hashed % 1.0) + 0.15 * n)
    return n


def veneered(veneer: Veneer, lit: Float32, normal: Float64, points: Float64, material: Int64) -> Float32:
    """Light (N, 3) on white surfaces -> that of veneered ones; unit normals and places (N, 3), materials (N,)."""
    above = 1.0 + 0.5 * (veneer.sky - 1.0) * normal[:, 2:]
    return (lit * above * reflectance(veneer, points, material)).astype(np.float32)


def _between(noise: Float32, at: Float64) -> Float64:
    """The periodic noise (N,) between its numbers, at places (N, 3) in these; linear."""
    low = np.floor(at)
    part, low = at - low, low.astype(np.int64)
    out = np.zeros(len(at))
    for corner in product((0, 1), repeat=3):
        weight = np.where(corner, part, 1.0 - part).prod(axis=1)
        out += weight * noise[tuple(((low + corner) % _SIDE).T)]
    return out
