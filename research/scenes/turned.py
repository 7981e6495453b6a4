"""A second generator of rooms, which no weights were trained on: turned and rounded furniture, rooms that are no boxes.

Nothing of ``furniture``, ``shell``, ``materials`` and ``room_templates`` is in it: pieces are bodies of revolution,
hoops and superellipsoids, rooms have a sloping ceiling, a chimney in a corner or a wall cut off, surfaces are solid
textures (``veneer``), and light comes from a wall of windows. Cameras and sensors are those of ROOMS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from research.scenes.config import SUITE_VERSION, RoomConfig
from research.scenes.layout import Layout
from research.scenes.materials import Material, Palette, Pattern, display_hsv, material_table
from research.scenes.primitives import Assembly, Part, Primitives, Top, pack, part_bounds, place_parts
from research.scenes.scene import Lights, Scene, extremes, shadow_cubes
from research.scenes.shell import Shell, wall_pose
from research.scenes.veneer import Grain, Veneer, solid_noise
from semantic_mapper.types import Float64

_STREAM = 7
_POOLS: dict[str, tuple[int, tuple[Grain, ...], tuple[float, float], tuple[float, float]]] = {  # scale, saturation
    "wood": (5, (Grain.RINGS, Grain.FIBRE, Grain.FIBRE), (0.03, 0.12), (0.1, 0.6)),
    "cloth": (6, (Grain.STRIPES, Grain.BANDS, Grain.CLOUD, Grain.FIBRE), (0.04, 0.3), (0.0, 0.8)),
    "plain": (5, (Grain.CLOUD,), (0.3, 1.0), (0.0, 0.35)),
    "stone": (4, (Grain.VEINS, Grain.MOSAIC, Grain.BANDS), (0.05, 0.3), (0.0, 0.3)),
    "thing": (8, tuple(Grain), (0.02, 0.15), (0.1, 0.9)),
    "floor": (2, (Grain.SLATS, Grain.MOSAIC, Grain.VEINS, Grain.CLOUD, Grain.FIBRE), (0.08, 0.5), (0.0, 0.5)),
    "wall": (2, (Grain.CLOUD, Grain.CLOUD, Grain.FIBRE, Grain.STRIPES, Grain.BANDS), (0.2, 1.2), (0.0, 0.3)),
}


class Stock:
    """The materials of one room; all classes draw from the same few, by kind."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._veneers: list[tuple[Grain, Float64, float, Float64]] = []
        self._emission: list[float] = []
        self._pools = {
            name: [self._add(grains, scale, colour) for _ in range(count)]
            for name, (count, grains, scale, colour) in _POOLS.items()
        }
        self._pools["pane"] = [self._add((Grain.CLOUD, Grain.BANDS), (0.5, 1.5), (0.0, 0.4), rng.uniform(0.3, 2.5))]

    def _add(
        self, grains: Sequence[Grain], scale: tuple[float, float], colour: tuple[float, float], emission: float = 0.0
    ) -> int:
        rng = self.rng
        hue, value = rng.uniform(), rng.uniform(0.25, 0.95)
        contrast = float(rng.choice((0.15, 0.35, 0.7)))
        stops = [
            display_hsv(hue + d * rng.uniform(-0.15, 0.15), rng.uniform(*colour), value * (1 - contrast * d))
            for d in rng.permutation((0.0, 0.5, 1.0))
        ]
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0] if rng.uniform() < 0.4 else np.eye(3)[rng.permutation(3)]
        grain = grains[int(rng.integers(len(grains)))]
        self._veneers.append((grain, np.array(stops), float(np.exp(rng.uniform(*np.log(scale)))), turn))
        self._emission.append(emission)
        return len(self._emission) - 1

    def pick(self, *pools: str) -> int:
        """A random material of these kinds."""
        return int(self.rng.choice([m for pool in pools for m in self._pools[pool]]))

    def white(self) -> list[Material]:
        """What light falls on before the veneer takes its part."""
        gloss = self.rng.choice((0.0, 0.0, 0.2, 0.5), len(self._emission))
        one = (1.0, 1.0, 1.0)
        return [
            Material(Pattern.FLAT, one, one, 1.0, 0, emission, float(shine))
            for emission, shine in zip(self._emission, gloss, strict=True)
        ]

    def veneer(self) -> Veneer:
        """The textures; photographs have spectra between 1 / f ** 0.8 and 1 / f ** 1.5."""
        grain, stops, scale, turn = zip(*self._veneers, strict=True)
        noise = solid_noise(self.rng, self.rng.uniform(0.8, 1.5))
        return Veneer(
            np.array(grain, np.int64), np.array(stops), np.array(scale), np.array(turn), noise, self.rng.uniform(1, 2)
        )


Builder = Callable[[Assembly, np.random.Generator, Stock], None]


def _lathe(a: Assembly, m: int, x: float, y: float, profile: Sequence[tuple[float, float]], **options: object) -> None:
    """A body of revolution through (height, radius), as discs of at most 3 cm."""
    for (z0, r0), (z1, r1) in pairwise(profile):
        n = 1 if r0 == r1 else int(np.ceil((z1 - z0) / 0.03))
        for k in range(n):
            r, high = r0 + (r1 - r0) * (k + 0.5) / n, (z1 - z0) / n
            a.cylinder(m, (x, y, z0 + (k + 0.5) * high), (2 * r, 2 * r, high), **options)


def _leg(a: Assembly, m: int, x: float, y: float, high: float, r: float, look: float) -> None:
    """Turned: a foot, a waist, a ball."""
    knee = high * (0.35 + 0.3 * look)
    _lathe(a, m, x, y, [(0, r * 0.7), (0.03, r), (knee, r * 0.45), (high, r * (0.6 + 0.4 * look))])
    a.ellipsoid(m, (x, y, knee), (2.4 * r, 2.4 * r, 2.8 * r))


def _hoop(a: Assembly, m: int, center: tuple[float, float, float], w: float, h: float, thick: float) -> None:
    a.torus(m, center, (w, h, thick), tilt=np.pi / 2)


def _chair(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A round or soft seat on turned legs, one foot or a drum; a back of a hoop, a disc, or spindles."""
    m, seat, w, high = s.pick("wood", "plain"), s.pick("wood", "cloth"), rng.uniform(0.38, 0.5), rng.uniform(0.42, 0.5)
    kind, look = int(rng.integers(3)), rng.uniform()
    if kind == 0:
        for angle in np.arange(3 if look < 0.3 else 4) * 2 * np.pi / (3 if look < 0.3 else 4) + np.pi / 4:
            _leg(a, m, w * 0.36 * np.cos(angle), w / 2 + w * 0.36 * np.sin(angle), high - 0.04, 0.025, look)
    elif kind == 1:
        _lathe(a, m, 0, w / 2, [(0, w * 0.4), (0.04, w * 0.3), (0.12, 0.03), (high - 0.1, 0.03), (high - 0.04, 0.12)])
    else:
        _lathe(a, m, 0, w / 2, [(0, w * 0.3), (high * 0.5, w * 0.22), (high - 0.04, w * 0.4)])
    add = a.pillow if rng.uniform() < 0.4 else a.cylinder
    add(seat, (0, w / 2, high - 0.01), (w, w, rng.uniform(0.05, 0.11)))
    tall, y = rng.uniform(0.35, 0.55), 0.03
    back = int(rng.integers(3))
    if back == 0:
        _hoop(a, m, (0, y, high + tall / 2), w, tall, 0.05)
        a.cylinder(m, (0, y, high + tall / 2), (0.03, 0.03, tall))
    elif back == 1:
        a.cylinder(seat, (0, y, high + tall * 0.6), (w * 0.95, tall * 0.8, 0.04), tilt=np.pi / 2 + 0.1)
        a.cylinder(m, (0, y, high + 0.1), (0.04, 0.04, 0.22))
    else:
        for x in np.linspace(-0.42, 0.42, 5):
            _lathe(a, m, x * w, y, [(high, 0.008), (high + tall / 2, 0.016), (high + tall, 0.008)])
        a.ellipsoid(m, (0, y, high + tall), (w, 0.05, 0.09))


def _slab(a: Assembly, rng: np.random.Generator, m: int, w: float, d: float, high: float) -> None:
    """A top: round or oval, six-sided, or soft-edged."""
    kind = int(rng.integers(3))
    if kind == 0:
        a.cylinder(m, (0, d / 2, high - 0.02), (w, d, 0.04))
    elif kind == 1:
        angles = np.arange(6) * np.pi / 3
        a.prism(m, [(w / 2 * np.cos(t), d / 2 + d / 2 * np.sin(t)) for t in angles], (high - 0.04, high))
    else:
        a.pillow(m, (0, d / 2, high - 0.03), (w, d, 0.06))
    a.tops.append(Top(-w * 0.3, w * 0.3, d * 0.22, d * 0.78, high))


def _table(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """On a turned column, a drum, or turned legs; low, at sitting or at standing height."""
    w, d, high = rng.uniform(0.8, 1.5), rng.uniform(0.7, 1.0), float(rng.choice((0.42, 0.72, 0.76, 1.0)))
    m, leg, look = s.pick("wood", "stone", "plain"), s.pick("wood", "plain"), rng.uniform()
    kind = int(rng.integers(3))
    if kind == 0:
        _lathe(a, leg, 0, d / 2, [(0, 0.32), (0.05, 0.1), (high * 0.5, 0.045), (high * 0.6, 0.09), (high - 0.04, 0.05)])
    elif kind == 1:
        _lathe(a, leg, 0, d / 2, [(0, d * 0.4), (high * 0.5, d * 0.25), (high - 0.04, d * 0.4)])
    else:
        for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            _leg(a, leg, x * w * 0.28, d / 2 + y * d * 0.28, high - 0.04, 0.035, look)
    _slab(a, rng, m, w, d, high)


def _desk(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A soft-edged top at a wall with drums of drawers, or legs; a screen on it."""
    w, d, high = rng.uniform(1.1, 1.6), rng.uniform(0.55, 0.7), rng.uniform(0.7, 0.78)
    m, knob = s.pick("wood", "plain"), s.pick("thing")
    a.pillow(m, (0, d / 2, high - 0.02), (w, d, 0.04))
    for x in (-w / 2 + 0.24, w / 2 - 0.24):
        if rng.uniform() < 0.6:
            _lathe(a, m, x, d / 2, [(0, 0.17), (0.05, 0.2), (high - 0.08, 0.2), (high - 0.03, 0.14)])
            for z in (0.2, 0.4, 0.58):
                a.ellipsoid(knob, (x, d / 2 + 0.2, z), (0.05, 0.05, 0.05))
        else:
            for y in (0.1, d - 0.1):
                _leg(a, m, x, y, high - 0.03, 0.03, 0.5)
    if rng.uniform() < 0.6:
        dark = s.pick("thing", "plain")
        a.pillow(dark, (0, 0.2, high + 0.28), (0.55, 0.06, 0.34), label="otherprop", item=1)
        _lathe(a, dark, 0, 0.18, [(high, 0.12), (high + 0.02, 0.02), (high + 0.12, 0.02)], label="otherprop", item=1)
    a.tops.append(Top(-w * 0.42, w * 0.42, 0.25, d - 0.1, high))


def _sofa(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """Bubbles in a row, or one shell round a thick disc."""
    m, seats, high = s.pick("cloth"), int(rng.integers(1, 4)), rng.uniform(0.36, 0.44)
    w, d = seats * 0.68 + 0.3, rng.uniform(0.8, 0.95)
    if rng.uniform() < 0.5:
        for k in range(seats):
            x = (k - (seats - 1) / 2) * 0.68
            a.pillow(m, (x, d / 2 + 0.08, high / 2 + 0.03), (0.72, d - 0.15, high))
            a.ellipsoid(m, (x, 0.2, high + 0.2), (0.74, 0.36, 0.6))
        for x in (-w / 2 + 0.1, w / 2 - 0.1):
            a.ellipsoid(m, (x, d / 2, high * 0.7), (0.3, d, high * 1.3))
    else:
        a.cylinder(m, (0, d / 2 + 0.05, high / 2 + 0.04), (w * 0.85, d * 0.9, high - 0.06))
        for angle in np.linspace(-0.35, np.pi + 0.35, 9 + 2 * seats):
            x, y = w * 0.43 * np.cos(angle), d / 2 - (d / 2 - 0.13) * np.sin(angle)
            tall = 0.78 + 0.1 * float(np.sin(angle))
            a.cylinder(m, (x, y, tall / 2), (0.26, 0.26, tall))
    for k in range(int(rng.integers(0, 3))):
        x = rng.uniform(-0.3, 0.3) * w
        a.ellipsoid(
            s.pick("cloth", "thing"), (x, d * 0.45, high + 0.16), (0.4, 0.2, 0.36), label="otherprop", item=k + 1
        )


def _bed(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A soft mattress on a plinth or balls, with an arch, hoops or a roll at its head, and bolsters."""
    w, d, low = rng.uniform(0.9, 1.7), rng.uniform(1.9, 2.1), rng.uniform(0.2, 0.4)
    m, sheet, cover = s.pick("wood", "cloth"), s.pick("cloth", "plain"), s.pick("cloth")
    a.pillow(m, (0, d / 2, low * 0.75), (w, d, low * 0.5))
    for x in (-1, 1):
        for y in (0.15, d - 0.15):
            a.ellipsoid(m, (x * (w / 2 - 0.15), y, low * 0.3), (0.16, 0.16, low * 0.6))
    a.pillow(sheet, (0, d / 2, low + 0.08), (w, d, 0.22))
    a.pillow(cover, (0, d * 0.62, low + 0.14), (w * 1.04, d * 0.74, 0.2))
    kind = int(rng.integers(3))
    if kind == 0:
        a.cylinder(m, (0, 0.03, low + 0.5), (w, 0.9, 0.06), tilt=np.pi / 2)
    elif kind == 1:
        for x in (-0.25, 0.25):
            _hoop(a, m, (x * w, 0.04, low + 0.35), w * 0.52, 0.8, 0.07)
    else:
        a.cylinder(cover, (0, 0.14, low + 0.4), (0.26, 0.26, w), yaw=np.pi / 2, tilt=np.pi / 2)
    for k in range(1 if w < 1.3 else 2):
        x = 0.0 if w < 1.3 else (k - 0.5) * w * 0.5
        size = (0.2, 0.2, rng.uniform(0.45, 0.65))
        a.cylinder(
            s.pick("cloth"), (x, 0.42, low + 0.28), size, yaw=np.pi / 2, tilt=np.pi / 2, label="otherprop", item=k + 1
        )


def _cabinet(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A swollen chest with rows of knobs, a drum, or a tall one with a round head."""
    m, knob, kind = s.pick("wood", "plain"), s.pick("thing", "stone"), int(rng.integers(3))
    w, d, h = rng.uniform(0.5, 1.3), rng.uniform(0.4, 0.55), float(rng.choice((0.6, 0.85, 1.2, 1.8)))
    if kind == 1:
        w = d = rng.uniform(0.45, 0.6)
        a.cylinder(m, (0, d / 2, h / 2), (w, d, h))
    else:
        a.pillow(m, (0, d / 2, 0.1 + (h - 0.1) / 2), (w, d, h - 0.1))
        if kind == 2:
            a.cylinder(m, (0, d / 2, h - 0.15), (w * 0.9, w * 0.5, d * 0.9), tilt=np.pi / 2)
    for x in (-1, 1):
        for y in (0.1, d - 0.1):
            a.ellipsoid(m, (x * (w / 2 - 0.1), y, 0.07), (0.1, 0.1, 0.14))
    for z in np.arange(0.3, h - 0.1, 0.25):
        for x in (-0.2, 0.2) if w > 0.7 else (0.0,):
            a.ellipsoid(knob, (x * w, d + 0.005, float(z)), (0.05, 0.05, 0.05))
    if kind < 2:
        a.tops.append(Top(-w * 0.32, w * 0.32, d * 0.2, d * 0.75, h))


def _bookshelf(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """Round shelves on turned posts, with books fanned out on them."""
    m, w, d, h = s.pick("wood", "plain"), rng.uniform(0.7, 1.1), rng.uniform(0.32, 0.42), rng.uniform(1.3, 2.0)
    levels = int(rng.integers(4, 6))
    for x in (-1, 1):
        _lathe(a, m, x * w * 0.42, d / 2, [(0, 0.04), (h / 2, 0.02), (h, 0.04)])
    if rng.uniform() < 0.5:
        a.cylinder(m, (0, 0.01, h / 2), (w * 0.9, h, 0.02), tilt=np.pi / 2)
    item = 0
    for z in np.linspace(0.08, h - 0.28, levels):
        a.cylinder(m, (0, d / 2, float(z)), (w, d, 0.03))
        x = -w * 0.34
        while x < w * 0.3 and rng.uniform() < 0.9:
            thick, tall, item = rng.uniform(0.04, 0.12), rng.uniform(0.14, 0.25), item + 1
            if rng.uniform() < 0.75:
                center = (x, d / 2, float(z) + 0.015 + tall / 2)
                a.box(
                    s.pick("thing"),
                    center,
                    (thick, 0.2, tall),
                    label="otherprop",
                    item=item,
                    yaw=rng.uniform(-0.2, 0.2),
                )
            x += thick * 1.15
    a.cylinder(m, (0, d / 2, h), (w, d, 0.03))


def _counter(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A run of drums under one slab with round ends, with a bowl of a sink and round plates of a stove."""
    w, d, high = rng.uniform(1.5, 2.6), rng.uniform(0.58, 0.66), rng.uniform(0.86, 0.95)
    front, slab, dark = s.pick("wood", "plain"), s.pick("stone", "wood"), s.pick("thing", "stone")
    for x in np.linspace(-w / 2 + 0.3, w / 2 - 0.3, int(w / 0.55)):
        a.pillow(front, (float(x), d / 2, high / 2), (0.58, d - 0.06, high - 0.04))
        a.ellipsoid(dark, (float(x), d - 0.02, high * 0.7), (0.12, 0.05, 0.03))
    a.box(slab, (0, d / 2, high - 0.02), (w - d, d, 0.04))
    for x in (-1, 1):
        a.cylinder(slab, (x * (w - d) / 2, d / 2, high - 0.02), (d, d, 0.04))
    basin = rng.choice((-1, 1)) * w * 0.22
    a.torus(s.pick("stone", "plain"), (basin, d / 2, high + 0.01), (0.42, 0.42, 0.1), label="sink", item=1)
    a.cylinder(s.pick("stone", "plain"), (basin, d / 2, high + 0.003), (0.3, 0.3, 0.012), label="sink", item=1)
    _lathe(a, dark, basin, 0.08, [(high, 0.03), (high + 0.28, 0.012)], label="sink", item=1)
    for x in (-0.13, 0.13):
        a.cylinder(dark, (-basin + x, d / 2, high + 0.008), (0.2, 0.2, 0.016))
    a.tops.append(Top(-w * 0.12, w * 0.12, 0.12, d - 0.1, high))


def _refrigerator(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """Round-shouldered, of one door or two, with a bar of a handle."""
    m = s.pick("plain", "thing", "stone")
    w, d, h = rng.uniform((0.55, 0.55, 1.4), (0.75, 0.68, 1.9)).tolist()
    split = h * rng.uniform(0.6, 0.72)
    a.pillow(m, (0, d / 2, split / 2 + 0.02), (w, d, split))
    a.pillow(m, (0, d / 2, (h + split) / 2), (w, d, h - split))
    a.box(m, (0, d / 2, h / 2), (w * 0.8, d * 0.8, h * 0.85))
    bar = s.pick("thing", "stone")
    for z, long in ((split * 0.8, 0.3), ((h + split) / 2, 0.18)):
        a.cylinder(bar, (w * 0.35, d + 0.01, z), (0.03, 0.03, long))


def _toilet(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """An egg of a bowl with a ring, and a drum of a tank."""
    m, high = s.pick("plain", "stone"), rng.uniform(0.38, 0.44)
    _lathe(a, m, 0, 0.42, [(0, 0.13), (0.15, 0.1), (high, 0.2)])
    a.torus(s.pick("plain", "thing", "wood"), (0, 0.43, high + 0.02), (0.4, 0.5, 0.1))
    a.cylinder(m, (0, 0.11, high + 0.18), (0.44, 0.2, 0.42))


def _sink(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A turned foot that carries a bowl."""
    m, r, high = s.pick("plain", "stone"), rng.uniform(0.2, 0.28), rng.uniform(0.8, 0.9)
    _lathe(a, m, 0, 0.3, [(0, 0.16), (0.1, 0.07), (high - 0.2, 0.07), (high, r)])
    a.torus(m, (0, 0.3, high), (2 * r + 0.1, 2 * r + 0.06, 0.1))
    _lathe(a, s.pick("thing", "stone"), 0, 0.08, [(high, 0.03), (high + 0.2, 0.012)])


def _bathtub(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """An oval that stands free on balls."""
    m = s.pick("plain", "stone", "thing")
    w, d, high = rng.uniform((1.4, 0.7, 0.5), (1.8, 0.85, 0.62)).tolist()
    for k in range(8):
        f = 0.72 + 0.28 * (k / 7) ** 0.6
        a.cylinder(m, (0, d / 2, 0.1 + (k + 0.5) * (high - 0.1) / 8), (w * f * 0.95, d * f * 0.95, (high - 0.1) / 8))
    a.torus(m, (0, d / 2, high), (w, d, 0.14))
    for x in (-0.3, 0.3):
        for y in (0.3, 0.7):
            a.ellipsoid(s.pick("thing"), (x * w, y * d, 0.07), (0.12, 0.12, 0.14))


def _round_door(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A leaf with a round head in a frame, with a ball to hold."""
    m, frame, w, h = s.pick("wood", "plain"), s.pick("wood", "plain"), rng.uniform(0.75, 0.9), rng.uniform(1.65, 1.8)
    for material, grow, thick in ((frame, 0.12, 0.03), (m, 0.0, 0.05)):
        a.box(material, (0, thick / 2, h / 2), (w + grow, thick, h))
        a.cylinder(material, (0, thick / 2, h), (w + grow, (w + grow) * 0.8, thick), tilt=np.pi / 2)
    for z in (0.5, 1.3):
        a.ellipsoid(frame, (0, 0.05, z), (w * 0.6, 0.04, 0.5))
    a.ellipsoid(s.pick("thing"), (w * 0.4, 0.08, 1.02), (0.07, 0.07, 0.07))


def _window(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A porthole, or two to four lancets; some with a curtain of folds at each side."""
    pane, frame, z = s.pick("pane"), s.pick("wood", "plain"), rng.uniform(1.3, 1.6)
    if rng.uniform() < 0.35:
        w = rng.uniform(0.8, 1.2)
        a.cylinder(pane, (0, 0.01, z), (w, w, 0.02), tilt=np.pi / 2, casts_shadow=False)
        _hoop(a, frame, (0, 0.051, z), w * 1.25, w * 1.25, 0.1)
        a.box(frame, (0, 0.026, z), (0.04, 0.05, w))
    else:
        n = int(rng.integers(2, 5))
        w, one, h = n * 0.42, 0.34, rng.uniform(0.9, 1.3)
        for x in (np.arange(n) - (n - 1) / 2) * 0.42:
            a.box(frame, (float(x), 0.005, z), (one + 0.08, 0.01, h + 0.08))
            a.box(pane, (float(x), 0.015, z), (one, 0.01, h), casts_shadow=False)
            a.cylinder(pane, (float(x), 0.012, z + h / 2), (one, one * 1.4, 0.012), tilt=np.pi / 2, casts_shadow=False)
    if rng.uniform() < 0.5:
        cloth, long = s.pick("cloth", "plain"), rng.uniform(1.3, 2.1)
        for side in (-1, 1):
            for k in range(6):
                r = rng.uniform(0.05, 0.1)
                x = side * (w / 2 + 0.1 + 0.06 * k)
                a.cylinder(cloth, (x, 0.1, 2.25 - long / 2), (r, r, long), label="curtain", item=1 + (side > 0))


def _picture(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """An oval in a round frame."""
    w, z = rng.uniform(0.3, 0.7), rng.uniform(1.4, 1.7)
    h = w * rng.uniform(0.8, 1.5)
    a.cylinder(s.pick("thing", "cloth"), (0, 0.012, z), (w, h, 0.02), tilt=np.pi / 2)
    _hoop(a, s.pick("wood", "thing"), (0, 0.031, z), w * 1.2, h * 1.2, 0.06)


def _furniture(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A mushroom of a lamp, a pouf, or a stand for coats."""
    m, kind, h = s.pick("wood", "thing"), int(rng.integers(3)), rng.uniform(1.3, 1.7)
    if kind == 1:
        a.ellipsoid(s.pick("cloth"), (0, 0.3, 0.21), (0.58, 0.58, 0.42))
        return
    _lathe(a, m, 0, 0.3, [(0, 0.2), (0.05, 0.03), (h / 2, 0.015), (h, 0.03)])
    if kind == 0:
        a.ellipsoid(s.pick("pane", "cloth"), (0, 0.3, h), (0.5, 0.5, 0.3), casts_shadow=False)
        a.lamps.append((0.0, 0.3, h - 0.25))
    else:
        for angle in np.arange(4) * np.pi / 2:
            a.ellipsoid(m, (0.15 * np.cos(angle), 0.3 + 0.15 * np.sin(angle), h), (0.1, 0.1, 0.1))


def _thing(a: Assembly, rng: np.random.Generator, s: Stock) -> None:
    """A vase, a ball, a cone, a ring, a soft box, or a pile of discs."""
    m, kind, r, h = s.pick("thing"), int(rng.integers(6)), rng.uniform(0.03, 0.09), rng.uniform(0.08, 0.3)
    if kind == 0:
        _lathe(a, m, 0, r, [(0, r * 0.6), (h * 0.4, r), (h * 0.8, r * 0.3), (h, r * 0.5)])
    elif kind == 1:
        a.ellipsoid(m, (0, r, r), (2 * r, 2 * r, 2 * r))
    elif kind == 2:
        _lathe(a, m, 0, r, [(0, r), (h, 0.1 * r)])
    elif kind == 3:
        a.torus(m, (0, r, 0.3 * r), (2 * r, 2 * r, 0.6 * r))
    elif kind == 4:
        a.pillow(m, (0, r, h / 2), (2.4 * r, 2 * r, h))
    else:
        for k in range(int(rng.integers(2, 5))):
            a.cylinder(s.pick("thing"), (0, r, 0.0125 + 0.025 * k), (2 * r, 2 * r, 0.025))


_PIECES: dict[str, tuple[str, Builder]] = {
    "chair": ("chair", _chair), "table": ("table", _table), "desk": ("desk", _desk), "sofa": ("sofa", _sofa),
    "bed": ("bed", _bed), "cabinet": ("cabinet", _cabinet), "bookshelf": ("bookshelf", _bookshelf),
    "counter": ("counter", _counter), "refrigerator": ("refrigerator", _refrigerator), "toilet": ("toilet", _toilet),
    "sink": ("sink", _sink), "bathtub": ("bathtub", _bathtub), "door": ("door", _round_door),
    "window": ("window", _window), "picture": ("picture", _picture), "furniture": ("otherfurniture", _furniture),
    "thing": ("otherprop", _thing),
}  # fmt: skip
_ALL = ("door", "window", "window", "picture", "picture", "furniture")
_TEMPLATES: dict[str, tuple[str, ...]] = {  # in the order in which places are found
    "sleep": ("bed", *_ALL, "cabinet", "cabinet", "bookshelf", "desk", "chair", "sofa"),
    "live": ("sofa", "sofa", *_ALL, "bookshelf", "cabinet", "table", "chair", "chair", "desk", "furniture"),
    "cook": ("counter", "refrigerator", *_ALL, "table", "chair", "chair", "chair", "cabinet", "counter"),
    "wash": ("bathtub", "toilet", "sink", *_ALL, "cabinet", "sink", "chair"),
    "work": ("desk", "desk", *_ALL, "bookshelf", "bookshelf", "chair", "chair", "table", "cabinet", "sofa"),
}
_FREE, _HUNG = ("chair", "table", "thing"), ("door", "window", "picture")


class _Rooms(Layout):
    """A room of this generator: where things stand is found as in ROOMS, what they are is not."""

    def __init__(self, size: tuple[float, float, float], rng: np.random.Generator, stock: Stock) -> None:
        self.stock = stock
        shell, solid = _shell(size, rng, stock)
        super().__init__(size, rng, Palette(rng), shell=shell)  # the palette is that of pieces that are not made here
        for part in solid:
            low, high = part_bounds(part)
            self._low, self._high = np.vstack((self._low, low)), np.vstack((self._high, high))

    def make(self, name: str, rng: np.random.Generator | None = None) -> Assembly:
        """A specimen of one of ``_PIECES``."""
        label, build = _PIECES[name]
        piece = Assembly(label, keep_free_m=0.4 if name not in (*_FREE, "window", "picture") else 0.0)
        build(piece, rng or self.rng, self.stock)
        return piece

    def furnish(self, template: str) -> None:
        """Each piece of the template with a chance of 0.85, chairs and tables turned by any angle."""
        for name in _TEMPLATES[template]:
            if self.rng.uniform() > 0.85:
                continue
            piece = self.make(name)
            if name in _FREE:
                for _ in range(30):
                    place = np.append(self.rng.uniform((0.4, 0.4), np.array(self.size_m[:2]) - 0.4), 0.0)
                    if self.put(piece, float(self.rng.uniform(0, 2 * np.pi)), place, in_keep_free=name == "chair"):
                        break
            else:
                self.at_wall(piece, corner=False, flush=name in _HUNG)
        for _ in range(int(self.rng.integers(2, 9))):
            self.in_centre(self.make("thing"), margin_m=0.02)
        self.clutter(1.0, ("thing",))


def _shell(size: tuple[float, float, float], rng: np.random.Generator, s: Stock) -> tuple[Shell, list[Part]]:
    """Floor, ceiling, four walls, and what takes a piece of the room: a slope, a block in a corner, or a cut corner."""
    w, d, h = size
    floor, ceiling = Assembly("floor"), Assembly("ceiling")
    floor.box(s.pick("floor"), (w / 2, d / 2, -0.05), (w + 0.2, d + 0.2, 0.1))
    top = s.pick("wall", "plain", "wood")
    ceiling.box(top, (w / 2, d / 2, h + 0.05), (w + 0.2, d + 0.2, 0.1))
    paint, groups, solid = s.pick("wall", "plain"), [floor.parts, ceiling.parts], list[Part]()
    for k in range(4):
        wall, long = Assembly("wall"), size[k % 2]
        wall.box(
            s.pick("wall", "stone") if rng.uniform() < 0.3 else paint, (long / 2, -0.05, h / 2), (long + 0.2, 0.1, h)
        )
        groups.append(place_parts(wall, *wall_pose(size, k, 0.0)))
    kind, k = int(rng.integers(3)), int(rng.integers(4))
    long, more = size[k % 2], Assembly("ceiling" if kind == 0 else "wall")
    if kind == 0:  # slats of a slope, from knee height or more up to the ceiling
        knee, run, n = rng.uniform(1.1, 1.7), rng.uniform(1.0, 1.6), 14
        rise = h - knee
        for i in range(n):
            center = (long / 2, (i + 0.5) * run / n, knee + (i + 0.5) * rise / n + 0.02)
            more.box(top, center, (long, float(np.hypot(run, rise)) / n, 0.04), tilt=float(np.arctan2(rise, run)))
    elif kind == 1:  # the room is an L
        a, b = rng.uniform(0.25, 0.42) * size[k % 2], rng.uniform(0.25, 0.42) * size[1 - k % 2]
        more.box(paint, (a / 2, b / 2, h / 2), (a, b, h))
    else:  # a corner cut off by columns of a wall
        cut, n = rng.uniform(0.7, 1.2), 10
        for i in range(n):
            x = (i + 0.5) * cut / n
            more.box(paint, (x, (cut - x) / 2, h / 2), (cut / n, cut - x, h))
        middle = (cut / 2, cut / 2, h / 2)
        more.box(paint, middle, (cut * np.sqrt(2), 0.08, h), yaw=-np.pi / 4)
    parts = place_parts(more, *wall_pose(size, k, 0.0))
    solid.extend(parts)
    return Shell([*groups, parts]), solid


def make_turned_room(seed: int, config: RoomConfig) -> Scene:
    """The room of ``seed`` by this generator; sizes are those of ``config``, which otherwise plays no part."""
    rng = np.random.default_rng((SUITE_VERSION, seed, _STREAM))
    w, d = rng.uniform(config.min_side_m, config.max_side_m, 2)
    size = (float(w), float(d), float(rng.uniform(config.min_height_m, config.max_height_m)))
    stock, template = Stock(rng), tuple(_TEMPLATES)[seed % len(_TEMPLATES)]
    room = _Rooms(size, rng, stock)
    room.furnish(template)
    primitives = pack(room.groups)
    lights = _window_wall(rng, size, room.lamps, config.shadow_resolution, primitives)
    return Scene(seed, template, size, primitives, material_table(stock.white()), lights, veneer=stock.veneer())


def _window_wall(
    rng: np.random.Generator, size: tuple[float, float, float], lamps: list[Float64], resolution: int, p: Primitives
) -> Lights:
    """Soft light from three places along one wall, cold or warm, one bright lamp, and little from everywhere."""
    wall = int(rng.integers(4))
    places = [wall_pose(size, wall, f * size[wall % 2], 0.25)[1] + (0, 0, size[2] - 0.25) for f in (0.2, 0.5, 0.8)]
    places += lamps[:1] or [np.array((size[0] / 2, size[1] / 2, size[2] - 0.4))]
    position = np.array(places)
    strength = np.append(rng.uniform(0.6, 2.2) * rng.uniform(0.5, 1.5, 3), rng.uniform(0.3, 2.5))
    tint = np.exp(rng.normal(0, 1, (4, 1)) * np.array((0.12, 0.0, -0.16)))
    tint[:3] = tint[0]
    cubes = shadow_cubes(p, position, resolution)
    softness = np.array((1.0, 1.0, 1.0, rng.uniform(0.2, 0.8)))
    ambient = rng.uniform(0.15, 0.5) * np.exp(rng.normal(0, 0.08, 3))
    return Lights(position, strength[:, None] * tint, cubes, *extremes(cubes), softness, ambient)
