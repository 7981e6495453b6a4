"""Procedural materials, and the pools of a room from which all classes draw.

One small set of woods, fabrics, paints ... a room is shared by all of its furniture, so that colour alone does not
tell the class: a door may have the cabinet's wood, a curtain the sofa's fabric.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from semantic_mapper.types import Float64

Color = tuple[float, float, float]


class Pattern(IntEnum):
    """How a material varies over a surface; ``textures`` and ``fast_shade`` both draw these."""

    PLAIN = 0  # low-contrast clouds
    WOOD = 1  # grain along the longest side
    STRIPES = 2
    CHECKER = 3
    TILES = 4  # tiles in shades of the first colour, joints in the second
    WEAVE = 5  # fine threads
    PRINT = 6  # blobs in three colours
    SPINES = 7  # upright stripes of random width and hue: rows of books


@dataclass(frozen=True, slots=True)
class Material:
    """One surface.

    Args:
        pattern: See ``Pattern``.
        color_a, color_b: Linear RGB in [0, 1].
        scale_m: Size of the pattern's features.
        seed: Of the pattern's noise.
        emission: Light given off, as a multiple of the albedo.
        gloss: Strength of the highlight.
    """

    pattern: Pattern
    color_a: Color
    color_b: Color
    scale_m: float
    seed: int
    emission: float = 0.0
    gloss: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MaterialTable:
    """Materials as arrays: pattern (M,) int64, color_a and color_b (M, 3), scale_m (M,), seed (M,) int64,
    emission (M,), gloss (M,), floats float64."""

    pattern: np.ndarray
    color_a: Float64
    color_b: Float64
    scale_m: Float64
    seed: np.ndarray
    emission: Float64
    gloss: Float64


class Palette:
    """The materials of one room, by pool."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._materials: list[Material] = []
        self._pools: dict[str, list[int]] = {}
        for pool, count, make in (
            ("wood", 3, _wood),
            ("fabric", 4, _fabric),
            ("paint", 3, _paint),
            ("wallpaint", 2, _wall_paint),
            ("metal", 2, _metal),
            ("ceramic", 1, _ceramic),
            ("tile", 2, _tile),
            ("print", 4, _print),
            ("books", 3, _books),
            ("plant", 1, _plant),
            ("daylight", 1, _daylight),
            ("lampshade", 1, _lampshade),
            ("dark", 1, _dark),
            ("object", 6, _object),
        ):
            self._pools[pool] = [self.add(make(rng)) for _ in range(count)]

    def add(self, material: Material) -> int:
        """Add a material; returns its number."""
        self._materials.append(material)
        return len(self._materials) - 1

    def pick(self, rng: np.random.Generator, *pools: str) -> int:
        """A random material of the given pools."""
        choices = [index for pool in pools for index in self._pools[pool]]
        return int(choices[int(rng.integers(len(choices)))])

    def table(self) -> MaterialTable:
        """All materials as arrays."""
        items = self._materials
        return MaterialTable(
            pattern=np.array([int(m.pattern) for m in items], np.int64),
            color_a=np.array([m.color_a for m in items], np.float64),
            color_b=np.array([m.color_b for m in items], np.float64),
            scale_m=np.array([m.scale_m for m in items], np.float64),
            seed=np.array([m.seed for m in items], np.int64),
            emission=np.array([m.emission for m in items], np.float64),
            gloss=np.array([m.gloss for m in items], np.float64),
        )


def _hsv(hue: float, saturation: float, value: float) -> Color:
    """Display HSV -> linear RGB."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))
    return r**2.2, g**2.2, b**2.2


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 30))


def _wood(rng: np.random.Generator) -> Material:
    hue, saturation, value = rng.uniform(0.03, 0.11), rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.9)
    a = _hsv(hue, saturation, value)
    b = _hsv(hue, saturation * 1.1, value * rng.uniform(0.55, 0.85))
    return Material(Pattern.WOOD, a, b, rng.uniform(0.015, 0.05), _seed(rng), gloss=rng.uniform(0.0, 0.25))


def _fabric(rng: np.random.Generator) -> Material:
    hue, saturation, value = rng.uniform(), rng.uniform(0.0, 0.7), rng.uniform(0.2, 0.9)
    a = _hsv(hue, saturation, value)
    b = _hsv(hue + rng.normal(0, 0.08), saturation * 0.8, value * rng.uniform(0.4, 0.9))
    pattern = Pattern(int(rng.choice([Pattern.WEAVE, Pattern.WEAVE, Pattern.STRIPES, Pattern.CHECKER, Pattern.PRINT])))
    fine = pattern == Pattern.WEAVE
    return Material(pattern, a, b, rng.uniform(0.008, 0.02) if fine else rng.uniform(0.04, 0.15), _seed(rng))


def _paint(rng: np.random.Generator) -> Material:
    white = rng.uniform() < 0.4
    a = _hsv(rng.uniform(), rng.uniform(0, 0.08) if white else rng.uniform(0.1, 0.6), rng.uniform(0.75, 0.97))
    b = _scaled(a, 0.85)
    return Material(Pattern.PLAIN, a, b, rng.uniform(0.1, 0.5), _seed(rng), gloss=rng.uniform(0, 0.3))


def _wall_paint(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0.0, 0.35), rng.uniform(0.6, 0.95))
    pattern = Pattern(int(rng.choice([Pattern.PLAIN, Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.PRINT])))
    b = _scaled(a, 0.88 if pattern == Pattern.PLAIN else rng.uniform(0.7, 0.92))
    return Material(pattern, a, b, rng.uniform(0.08, 0.4), _seed(rng))


def _metal(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(0.5, 0.7), rng.uniform(0, 0.1), rng.uniform(0.25, 0.85))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.8), 0.05, _seed(rng), gloss=0.6)


def _ceramic(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.choice([0.02, 0.05, 0.25]), rng.uniform(0.8, 0.97))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.93), 0.2, _seed(rng), gloss=0.5)


def _tile(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0.0, 0.45), rng.uniform(0.45, 0.95))
    b = _scaled(a, rng.uniform(0.4, 0.8))
    pattern = Pattern(int(rng.choice([Pattern.TILES, Pattern.TILES, Pattern.CHECKER])))
    return Material(pattern, a, b, rng.uniform(0.12, 0.4), _seed(rng), gloss=rng.uniform(0.1, 0.4))


def _print(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0.1, 0.9), rng.uniform(0.2, 0.95))
    b = _hsv(rng.uniform(), rng.uniform(0.1, 0.9), rng.uniform(0.2, 0.95))
    pattern = Pattern(int(rng.choice([Pattern.PRINT, Pattern.PRINT, Pattern.STRIPES, Pattern.CHECKER])))
    lit = rng.uniform(0.2, 0.6) if rng.uniform() < 0.2 else 0.0  # lit pictures: decoys for windows
    return Material(pattern, a, b, rng.uniform(0.06, 0.25), _seed(rng), emission=lit)


def _books(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.9))
    b = _hsv(rng.uniform(), rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.9))
    return Material(Pattern.SPINES, a, b, rng.uniform(0.025, 0.05), _seed(rng))


def _plant(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(0.22, 0.4), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.7))
    return Material(Pattern.PRINT, a, _scaled(a, 0.35), rng.uniform(0.03, 0.06), _seed(rng))


def _daylight(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(0.5, 0.65), rng.uniform(0.0, 0.4), rng.uniform(0.3, 0.95))
    b = _hsv(rng.uniform(0.2, 0.6), rng.uniform(0.0, 0.4), rng.uniform(0.25, 0.9))
    return Material(Pattern.PRINT, a, b, rng.uniform(0.2, 0.6), _seed(rng), emission=rng.uniform(0.1, 0.9), gloss=0.5)


def _lampshade(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(0.05, 0.17), rng.uniform(0.0, 0.4), rng.uniform(0.8, 1.0))
    return Material(Pattern.WEAVE, a, _scaled(a, 0.9), 0.02, _seed(rng), emission=rng.uniform(0.0, 0.8))


def _dark(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0, 0.2), rng.uniform(0.05, 0.25))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.6), 0.2, _seed(rng), gloss=0.6)


def _object(rng: np.random.Generator) -> Material:
    a = _hsv(rng.uniform(), rng.uniform(0.1, 0.9), rng.uniform(0.2, 0.95))
    b = _hsv(rng.uniform(), rng.uniform(0.1, 0.9), rng.uniform(0.2, 0.95))
    pattern = Pattern(int(rng.choice([Pattern.PLAIN, Pattern.STRIPES, Pattern.WEAVE])))
    return Material(pattern, a, _scaled(a, 0.8) if pattern == Pattern.PLAIN else b, rng.uniform(0.02, 0.08), _seed(rng))


def _scaled(color: Color, factor: float) -> Color:
    return color[0] * factor, color[1] * factor, color[2] * factor
