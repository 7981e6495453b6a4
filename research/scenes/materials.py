"""Procedural materials, and the pools of a room from which all classes draw.

One small set of woods, fabrics, paints ... a room is shared by all of its furniture, so that colour alone does not
tell the class. On top of that, ``CAMOUFLAGE`` names pairs of classes that share one and the same material in some
rooms: a door with exactly the cabinet's wood.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np

from semantic_mapper.types import Float64

Color = tuple[float, float, float]

CAMOUFLAGE = (
    ("door", "cabinet", "wood"),
    ("desk", "table", "wood"),
    ("curtain", "sofa", "fabric"),
    ("picture", "cushion", "print"),
    ("refrigerator", "cabinet", "paint"),
    ("counter", "floor", "tile"),
)
# Bands of the hue circle that training rooms leave out and held-out rooms are fond of.
HELD_OUT_HUES = ((0.28, 0.38), (0.60, 0.70), (0.86, 0.96))


class Pattern(IntEnum):
    """How a material varies over a surface; ``textures`` and fast_textures.h both draw these."""

    PLAIN = 0  # low-contrast clouds
    WOOD = 1  # grain along the longest side
    STRIPES = 2
    CHECKER = 3
    TILES = 4  # tiles in shades of the first colour, joints in the second
    WEAVE = 5  # fine threads
    PRINT = 6  # blobs in three colours
    SPINES = 7  # upright stripes of random width and hue: rows of books
    PLANKS = 8  # boards with grain, each of its own shade
    GRAIN = 9  # year rings and knots, along the longest side
    STONE = 10  # clouds with light and dark speckles
    BRUSHED = 11  # metal, brushed along the longest side
    CARPET = 12  # marbled stripes
    PAGE = 13  # a printed page: text, headlines, pictures; the scale is the height of a line
    OUTSIDE = 14  # what is seen through a window: sky, trees, houses
    STAINS = 15  # worn paint: clouds, and streaks that run down
    FLAT = 16  # the first colour everywhere
    WINDOWS = 17  # a front of the first colour with panes of the second


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
        mirror: Fraction of the light that is a mirror image.
    """

    pattern: Pattern
    color_a: Color
    color_b: Color
    scale_m: float
    seed: int
    emission: float = 0.0
    gloss: float = 0.0
    mirror: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MaterialTable:
    """Materials as arrays: pattern (M,) int64, color_a and color_b (M, 3), scale_m (M,), seed (M,) int64,
    emission (M,), gloss (M,), mirror (M,), floats float64."""

    pattern: np.ndarray
    color_a: Float64
    color_b: Float64
    scale_m: Float64
    seed: np.ndarray
    emission: Float64
    gloss: Float64
    mirror: Float64


@dataclass(frozen=True, slots=True)
class Draw:
    """Random numbers for materials; ``held_out`` shifts colours to where training rooms have few or none."""

    rng: np.random.Generator
    held_out: bool

    def hue(self) -> float:
        """Anywhere on the circle but in ``HELD_OUT_HUES``; held out: half of the time inside them."""
        rng = self.rng
        if self.held_out and rng.uniform() < 0.5:
            return float(rng.uniform(*HELD_OUT_HUES[int(rng.integers(len(HELD_OUT_HUES)))]))
        while True:
            hue = float(rng.uniform())
            if self.held_out or not any(low <= hue < high for low, high in HELD_OUT_HUES):
                return hue

    def wood(self) -> tuple[float, float, float]:
        """Hue, saturation and value of a wood; held out: half of the time redder, yellower or greyer."""
        rng = self.rng
        if self.held_out and rng.uniform() < 0.5:
            hue = rng.uniform(0.0, 0.03) if rng.uniform() < 0.5 else rng.uniform(0.11, 0.14)
            return float(hue), float(rng.uniform(0.05, 0.8)), float(rng.uniform(0.15, 0.95))
        return float(rng.uniform(0.03, 0.11)), float(rng.uniform(0.2, 0.7)), float(rng.uniform(0.2, 0.9))

    def uniform(self, low: float, high: float) -> float:
        """A number between ``low`` and ``high``."""
        return float(self.rng.uniform(low, high))

    def one_of(self, *patterns: Pattern) -> Pattern:
        """One of ``patterns``."""
        return patterns[int(self.rng.integers(len(patterns)))]

    def seed(self) -> int:
        """For a pattern's noise."""
        return int(self.rng.integers(1 << 30))


class Palette:
    """The materials of one room, by pool.

    Args:
        rng: Draws everything.
        held_out: Colours of a held-out room; see ``Draw``.
        camouflage: Chance that a pair of ``CAMOUFLAGE`` shares a material.
    """

    def __init__(self, rng: np.random.Generator, *, held_out: bool = False, camouflage: float = 0.3) -> None:
        self._materials: list[Material] = []
        self._pools: dict[str, list[int]] = {}
        draw = Draw(rng, held_out)
        for pool, count, make in _POOLS:
            self._pools[pool] = [self.add(make(draw)) for _ in range(count)]
        self._shared: dict[str, int] = {}
        for first, second, pool in CAMOUFLAGE:
            chosen, active = self.pick(rng, pool), rng.uniform() < camouflage
            if active:
                chosen = self._shared.get(first, self._shared.get(second, chosen))
                self._shared[first] = self._shared[second] = chosen

    @property
    def camouflage(self) -> dict[str, int]:
        """Roles that have a material in common with another class in this room, with its number."""
        return dict(self._shared)

    def add(self, material: Material) -> int:
        """Add a material; returns its number."""
        self._materials.append(material)
        return len(self._materials) - 1

    def pick(self, rng: np.random.Generator, *pools: str, role: str | None = None) -> int:
        """A random material of the given pools, or the one that this room's camouflage gives ``role``."""
        choices = [index for pool in pools for index in self._pools[pool]]
        drawn = int(choices[int(rng.integers(len(choices)))])
        return drawn if role is None else self._shared.get(role, drawn)

    def table(self) -> MaterialTable:
        """All materials as arrays."""
        return material_table(self._materials)


def material_table(items: Sequence[Material]) -> MaterialTable:
    """Materials as arrays; a primitive's ``material`` counts them."""
    return MaterialTable(
        pattern=np.array([int(m.pattern) for m in items], np.int64),
        color_a=np.array([m.color_a for m in items], np.float64),
        color_b=np.array([m.color_b for m in items], np.float64),
        scale_m=np.array([m.scale_m for m in items], np.float64),
        seed=np.array([m.seed for m in items], np.int64),
        emission=np.array([m.emission for m in items], np.float64),
        gloss=np.array([m.gloss for m in items], np.float64),
        mirror=np.array([m.mirror for m in items], np.float64),
    )


def joined_tables(first: MaterialTable, second: MaterialTable) -> MaterialTable:
    """One table; the numbers of ``second`` go on after those of ``first``."""
    pairs = ((f.name, getattr(first, f.name), getattr(second, f.name)) for f in fields(MaterialTable))
    return MaterialTable(**{name: np.concatenate((a, b)) for name, a, b in pairs})


def display_hsv(hue: float, saturation: float, value: float) -> Color:
    """Display HSV -> linear RGB."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))
    return r**2.2, g**2.2, b**2.2


def _scaled(color: Color, factor: float) -> Color:
    return color[0] * factor, color[1] * factor, color[2] * factor


def _wood(d: Draw) -> Material:
    """Fine or strong grain, or glued staves as of a butcher's block."""
    hue, saturation, value = d.wood()
    a = display_hsv(hue, saturation, value)
    b = display_hsv(hue, saturation * 1.15, value * d.uniform(0.4, 0.85))
    pattern = d.one_of(Pattern.WOOD, Pattern.GRAIN, Pattern.GRAIN, Pattern.GRAIN, Pattern.PLANKS)
    low, high = {Pattern.GRAIN: (0.008, 0.03), Pattern.PLANKS: (0.03, 0.06)}.get(pattern, (0.015, 0.05))
    return Material(pattern, a, b, d.uniform(low, high), d.seed(), gloss=d.uniform(0.0, 0.4))


def _parquet(d: Draw) -> Material:
    hue, saturation, value = d.wood()
    a = display_hsv(hue, saturation, value)
    b = display_hsv(hue, saturation * 1.1, value * d.uniform(0.5, 0.8))
    return Material(Pattern.PLANKS, a, b, d.uniform(0.07, 0.18), d.seed(), gloss=d.uniform(0.0, 0.35))


def _stone(d: Draw) -> Material:
    """Granite, terrazzo, laminate: half of them nearly black; the darkest may be polished."""
    dark = d.uniform(0, 1) < 0.5
    a = display_hsv(d.hue(), d.uniform(0.0, 0.25), d.uniform(0.08, 0.3) if dark else d.uniform(0.4, 0.9))
    b = _scaled(a, d.uniform(0.25, 0.7) if not dark or d.uniform(0, 1) < 0.5 else d.uniform(1.5, 4.0))
    shine = d.uniform(0.05, 0.2) if dark and d.uniform(0, 1) < 0.4 else 0.0
    return Material(Pattern.STONE, a, b, d.uniform(0.02, 0.09), d.seed(), gloss=d.uniform(0.2, 0.9), mirror=shine)


def _lacquer(d: Draw) -> Material:
    """Glossy fronts, most of them in a strong colour."""
    a = display_hsv(d.hue(), d.uniform(0.55, 1.0) if d.uniform(0, 1) < 0.7 else d.uniform(0, 0.1), d.uniform(0.25, 0.9))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.75), d.uniform(0.1, 0.5), d.seed(), gloss=d.uniform(0.4, 1.2))


def _steel(d: Draw) -> Material:
    value = d.uniform(0.12, 0.35) if d.uniform(0, 1) < 0.5 else d.uniform(0.4, 0.75)
    a = display_hsv(d.uniform(0.0, 1.0), d.uniform(0, 0.08), value)
    return Material(Pattern.BRUSHED, a, _scaled(a, d.uniform(0.6, 0.85)), 0.03, d.seed(), gloss=d.uniform(0.5, 1.0))


def _carpet(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0.0, 0.35), d.uniform(0.25, 0.8))
    b = display_hsv(d.hue(), d.uniform(0.0, 0.3), d.uniform(0.1, 0.5))
    return Material(Pattern.CARPET, a, b, d.uniform(0.02, 0.06), d.seed())


def _paper(d: Draw) -> Material:
    """White sheets with text, and covers in strong colours."""
    a = display_hsv(d.hue(), d.uniform(0, 0.06), d.uniform(0.85, 1.0))
    b = display_hsv(d.hue(), d.uniform(0.0, 0.8), d.uniform(0.05, 0.4))
    if d.uniform(0, 1) < 0.4:
        a, b = (
            display_hsv(d.hue(), d.uniform(0.4, 1.0), d.uniform(0.2, 0.8)),
            display_hsv(d.hue(), d.uniform(0, 0.3), 0.95),
        )
    return Material(Pattern.PAGE, a, b, d.uniform(0.006, 0.02), d.seed(), gloss=d.uniform(0.0, 0.4))


def _fabric(d: Draw) -> Material:
    hue, saturation, value = d.hue(), d.uniform(0.0, 0.7), d.uniform(0.2, 0.9)
    a = display_hsv(hue, saturation, value)
    b = display_hsv(hue + float(d.rng.normal(0, 0.04)), saturation * 0.8, value * d.uniform(0.4, 0.9))
    pattern = d.one_of(Pattern.WEAVE, Pattern.WEAVE, Pattern.STRIPES, Pattern.CHECKER, Pattern.PRINT)
    scale = d.uniform(0.008, 0.02) if pattern == Pattern.WEAVE else d.uniform(0.04, 0.15)
    return Material(pattern, a, b, scale, d.seed())


def _paint(d: Draw) -> Material:
    white = d.uniform(0, 1) < 0.4
    a = display_hsv(d.hue(), d.uniform(0, 0.08) if white else d.uniform(0.1, 0.6), d.uniform(0.55, 0.97))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.85), d.uniform(0.1, 0.5), d.seed(), gloss=d.uniform(0, 0.3))


def _wall_paint(d: Draw) -> Material:
    """Often nearly white or grey, now and then in a colour or papered."""
    plain = d.uniform(0, 1) < 0.5
    a = display_hsv(d.hue(), d.uniform(0.0, 0.08) if plain else d.uniform(0.0, 0.45), d.uniform(0.45, 0.97))
    pattern = d.one_of(Pattern.PLAIN, Pattern.PLAIN, Pattern.STAINS, Pattern.STAINS, Pattern.STRIPES, Pattern.PRINT)
    b = _scaled(a, d.uniform(0.7, 0.92))
    return Material(pattern, a, b, d.uniform(0.08, 0.5), d.seed())


def _metal(d: Draw) -> Material:
    a = display_hsv(d.uniform(0.5, 0.7), d.uniform(0, 0.1), d.uniform(0.2, 0.85))
    pattern = d.one_of(Pattern.PLAIN, Pattern.BRUSHED)
    return Material(pattern, a, _scaled(a, 0.75), 0.05, d.seed(), gloss=d.uniform(0.4, 1.0))


def _ceramic(d: Draw) -> Material:
    a = display_hsv(d.hue(), float(d.rng.choice([0.02, 0.05, 0.25])), d.uniform(0.75, 0.97))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.93), 0.2, d.seed(), gloss=0.5)


def _tile(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0.0, 0.45), d.uniform(0.4, 0.95))
    b = _scaled(a, d.uniform(0.4, 0.8))
    pattern = d.one_of(*[Pattern.TILES] * 5, Pattern.CHECKER)
    return Material(pattern, a, b, d.uniform(0.03, 0.4), d.seed(), gloss=d.uniform(0.1, 0.4))


def _print(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0.1, 0.9), d.uniform(0.2, 0.95))
    b = display_hsv(d.hue(), d.uniform(0.1, 0.9), d.uniform(0.2, 0.95))
    pattern = d.one_of(Pattern.PRINT, Pattern.PAGE, Pattern.OUTSIDE, Pattern.STRIPES, Pattern.CHECKER, Pattern.STONE)
    low, high = {Pattern.PAGE: (0.012, 0.04), Pattern.OUTSIDE: (0.1, 0.4)}.get(pattern, (0.06, 0.25))
    return Material(pattern, a, b, d.uniform(low, high), d.seed())


def _screen(d: Draw) -> Material:
    """A picture that gives off light: lit pictures and screens are decoys for windows."""
    p = _daylight(d) if d.uniform(0, 1) < 0.5 else _print(d)
    return Material(p.pattern, p.color_a, p.color_b, d.uniform(0.1, 0.4), d.seed(), d.uniform(0.3, 0.9), gloss=0.4)


def _books(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0.2, 0.8), d.uniform(0.3, 0.9))
    b = display_hsv(d.hue(), d.uniform(0.2, 0.8), d.uniform(0.3, 0.9))
    return Material(Pattern.SPINES, a, b, d.uniform(0.025, 0.05), d.seed())


def _plant(d: Draw) -> Material:
    a = display_hsv(d.uniform(0.22, 0.4), d.uniform(0.4, 0.8), d.uniform(0.3, 0.7))
    return Material(Pattern.PRINT, a, _scaled(a, 0.35), d.uniform(0.03, 0.06), d.seed())


def _daylight(d: Draw) -> Material:
    """What stands outside a window: so bright that it burns out, bright, or dim as at dusk."""
    a = display_hsv(d.uniform(0.5, 0.65), d.uniform(0.0, 0.5), d.uniform(0.4, 1.0))
    b = display_hsv(d.uniform(0.1, 0.45), d.uniform(0.0, 0.6), d.uniform(0.15, 0.7))
    kind = d.uniform(0, 1)
    lit = d.uniform(0.0, 0.25) if kind < 0.35 else d.uniform(0.25, 1.2) if kind < 0.75 else d.uniform(1.5, 4.0)
    pattern = d.one_of(Pattern.OUTSIDE, Pattern.OUTSIDE, Pattern.OUTSIDE, Pattern.PRINT)
    return Material(pattern, a, b, d.uniform(0.15, 0.5), d.seed(), emission=lit, gloss=0.5)


def _lampshade(d: Draw) -> Material:
    a = display_hsv(d.uniform(0.05, 0.17), d.uniform(0.0, 0.4), d.uniform(0.8, 1.0))
    return Material(Pattern.WEAVE, a, _scaled(a, 0.9), 0.02, d.seed(), emission=d.uniform(0.0, 0.8))


def _dark(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0, 0.2), d.uniform(0.05, 0.25))
    return Material(Pattern.PLAIN, a, _scaled(a, 0.6), 0.2, d.seed(), gloss=0.6)


def _object(d: Draw) -> Material:
    a = display_hsv(d.hue(), d.uniform(0.1, 0.9), d.uniform(0.2, 0.95))
    b = display_hsv(d.hue(), d.uniform(0.1, 0.9), d.uniform(0.2, 0.95))
    if d.uniform(0, 1) < 0.35:  # white, grey or black
        a = display_hsv(d.hue(), d.uniform(0.0, 0.1), d.uniform(0.03, 0.98))
    pattern = d.one_of(Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.WEAVE, Pattern.PAGE, Pattern.PRINT)
    second = _scaled(a, 0.75) if pattern == Pattern.PLAIN else b
    return Material(pattern, a, second, d.uniform(0.01, 0.08), d.seed(), gloss=d.uniform(0.0, 0.8))


def _mirror(d: Draw) -> Material:
    a = display_hsv(d.uniform(0.4, 0.6), 0.05, 0.6)
    return Material(Pattern.PLAIN, a, a, 0.5, d.seed(), gloss=0.3, mirror=d.uniform(0.75, 0.92))


_POOLS: tuple[tuple[str, int, Callable[[Draw], Material]], ...] = (
    ("wood", 3, _wood),
    ("parquet", 1, _parquet),
    ("stone", 2, _stone),
    ("lacquer", 1, _lacquer),
    ("steel", 1, _steel),
    ("carpet", 1, _carpet),
    ("paper", 4, _paper),
    ("fabric", 4, _fabric),
    ("paint", 3, _paint),
    ("wallpaint", 2, _wall_paint),
    ("metal", 2, _metal),
    ("ceramic", 1, _ceramic),
    ("tile", 2, _tile),
    ("print", 5, _print),
    ("screen", 2, _screen),
    ("books", 3, _books),
    ("plant", 1, _plant),
    ("daylight", 1, _daylight),
    ("lampshade", 1, _lampshade),
    ("dark", 1, _dark),
    ("object", 9, _object),
    ("mirror", 1, _mirror),
)
