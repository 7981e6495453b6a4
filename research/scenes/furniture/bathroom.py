"""Toilets, wash basins, bath tubs."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly


@furniture("toilet", "wall", keep_free_m=0.4)
def toilet(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Bowl, seat, lid (down, or up against the tank), tank."""
    white, seat = palette.pick(rng, "ceramic"), palette.pick(rng, "ceramic", "ceramic", "wood")
    h, length = rng.uniform(0.38, 0.43), rng.uniform(0.46, 0.54)
    y = 0.2 + length / 2
    a.cylinder(white, (0, y - 0.03, 0.09), (0.24, 0.36, 0.18))
    a.ellipsoid(white, (0, y, h - 0.1), (0.36, length - 0.02, 0.36))
    a.cylinder(white, (0, y, h - 0.02), (0.37, length, 0.05))
    a.box(white, (0, 0.15, h - 0.14), (0.26, 0.28, 0.28))
    if rng.uniform() < 0.5:
        a.cylinder(seat, (0, y, h + 0.022), (0.38, length + 0.01, 0.034))
    else:
        a.cylinder(palette.pick(rng, "dark", "ceramic"), (0, y + 0.02, h + 0.008), (0.24, length - 0.16, 0.006))
        a.box(seat, (0, 0.235, h + 0.21), (0.35, 0.025, 0.38), tilt=0.1)
    a.box(white, (0, 0.1, h + 0.17), (rng.uniform(0.36, 0.46), 0.18, 0.36))
    a.box(white, (0, 0.1, h + 0.365), (0.44, 0.2, 0.03))
    a.cylinder(palette.pick(rng, "metal"), (0, 0.1, h + 0.385), (0.06, 0.06, 0.015))


@furniture("sink", "wall", keep_free_m=0.5)
def wash_basin(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A basin on a column or a cabinet, a tap, a mirror above."""
    white, metal = palette.pick(rng, "ceramic"), palette.pick(rng, "metal")
    w, d, h = rng.uniform(0.5, 0.7), rng.uniform(0.42, 0.52), rng.uniform(0.8, 0.88)
    if rng.uniform() < 0.5:
        a.cylinder(white, (0, d / 2 - 0.05, h / 2 - 0.08), (0.18, 0.18, h - 0.16))
    else:
        front = palette.pick(rng, "wood", "paint")
        a.box(front, (0, d / 2 - 0.01, (h - 0.13) / 2), (w - 0.08, d - 0.08, h - 0.13), label="cabinet", item=1)
        for x in (-1, 1):
            center = (x * (w - 0.08) / 4, d - 0.04, h / 2 - 0.02)
            a.box(front, center, ((w - 0.1) / 2 - 0.01, 0.016, h - 0.27), label="cabinet", item=1)
    a.box(white, (0, d / 2, h - 0.12), (w - 0.04, d - 0.04, 0.03))
    for x in (-1, 1):
        a.box(white, (x * (w / 2 - 0.03), d / 2, h - 0.06), (0.06, d, 0.15))
    a.box(white, (0, 0.06, h - 0.06), (w - 0.12, 0.12, 0.148))
    a.box(white, (0, d - 0.025, h - 0.06), (w - 0.12, 0.05, 0.148))
    a.cylinder(metal, (0, 0.07, h + 0.08), (0.03, 0.03, 0.16))
    a.box(metal, (0, 0.13, h + 0.15), (0.025, 0.14, 0.022))
    _mirror(a, palette.pick(rng, "mirror"), palette.pick(rng, "wood", "paint", "metal"), rng, w * rng.uniform(0.7, 1.1))


def _mirror(a: Assembly, glass: int, frame: int, rng: np.random.Generator, w: float) -> None:
    """Over a basin: flat with a thin frame, or the doors of a flat cabinet."""
    tall = rng.uniform(0.5, 0.8)
    deep = 0.02 if rng.uniform() < 0.65 else 0.14
    a.box(frame, (0, deep / 2, 1.5), (w, deep, tall), label="otherfurniture", item=2)
    a.box(glass, (0, deep + 0.003, 1.5), (w - 0.04, 0.006, tall - 0.04), label="otherfurniture", item=2)


@furniture("bathtub", "corner", keep_free_m=0.4)
def bathtub(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A hollow tub; the apron may be tiled."""
    w, d, h = rng.uniform(1.5, 1.8), rng.uniform(0.7, 0.82), rng.uniform(0.5, 0.6)
    white, metal = palette.pick(rng, "ceramic"), palette.pick(rng, "metal")
    apron = palette.pick(rng, "ceramic", "tile")
    a.box(white, (0, d / 2, 0.1), (w - 0.1, d - 0.1, 0.12))
    for x in (-1, 1):
        a.box(white, (x * (w / 2 - 0.05), d / 2, h / 2), (0.1, d, h))
        a.box(white, (x * (w / 2 - 0.18), d / 2, 0.28), (0.1, d - 0.14, 0.5), item=0)
    a.box(white, (0, 0.05, h / 2), (w - 0.2, 0.1, h - 0.002))
    a.box(white, (0, d - 0.05, h / 2), (w - 0.2, 0.1, h - 0.002))
    a.box(apron, (0, d + 0.006, h / 2 - 0.03), (w - 0.01, 0.014, h - 0.06))
    end = 1 if rng.uniform() < 0.5 else -1
    a.cylinder(metal, (end * (w / 2 - 0.05), d / 2, h + 0.08), (0.035, 0.035, 0.16))
    a.box(metal, (end * (w / 2 - 0.12), d / 2, h + 0.15), (0.16, 0.03, 0.025))
    if rng.uniform() < 0.6:
        _shower_curtain(a, rng, palette, -end * (w / 2 - 0.06), end, w, d - 0.02, h + 0.02)


def _shower_curtain(
    a: Assembly, rng: np.random.Generator, palette: Palette, start: float, way: int, w: float, y: float, low: float
) -> None:
    """Folds on a rod, drawn from x = ``start`` towards ``way``; class curtain."""
    cloth, folds = palette.pick(rng, "fabric", role="curtain"), int(rng.integers(4, 11))
    bottom = low if rng.uniform() < 0.5 else max(low - 0.3, 0.15)
    y = y if bottom >= low else y + 0.075  # it hangs outside where it reaches below the rim
    for k in range(folds):
        center = (start + way * 0.075 * k, y + 0.012 * (k % 2), (2.0 + bottom) / 2)
        a.cylinder(cloth, center, (0.09, rng.uniform(0.05, 0.08), 2.0 - bottom), label="curtain", item=1)
    a.box(palette.pick(rng, "metal"), (0, y, 2.02), (w, 0.025, 0.025), label="otherprop", item=2)


@furniture("bathtub", "corner", keep_free_m=0.45)
def shower(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A tray with a rim, a tiled back, riser and head, often a curtain; the tray counts as a bath."""
    w, d = rng.uniform(0.8, 1.1), rng.uniform(0.8, 0.95)
    white, metal = palette.pick(rng, "ceramic"), palette.pick(rng, "metal")
    a.box(white, (0, d / 2, 0.03), (w, d, 0.06))
    for x in (-1, 1):
        a.box(white, (x * (w / 2 - 0.03), d / 2, 0.08), (0.06, d, 0.1))
    for y in (0.03, d - 0.03):
        a.box(white, (0, y, 0.08), (w - 0.12, 0.06, 0.1))
    a.cylinder(metal, (0, d / 2, 0.065), (0.1, 0.1, 0.012))
    a.box(palette.pick(rng, "tile"), (0, 0.006, 1.09), (w, 0.012, 1.9), label="wall", item=3)
    a.cylinder(metal, (0, 0.05, 1.55), (0.025, 0.025, 0.9), label="otherprop", item=4)
    a.box(metal, (0, 0.12, 2.0), (0.025, 0.16, 0.025), label="otherprop", item=4)
    a.frustum(metal, (0, 0.2, 1.97), (0.18, 0.18, 0.06), label="otherprop", item=4)
    a.box(metal, (0, 0.04, 1.1), (0.2, 0.05, 0.05), label="otherprop", item=4)
    if rng.uniform() < 0.75:
        _shower_curtain(a, rng, palette, -w / 2 + 0.05, 1, w, d - 0.05, 0.16)


@furniture("otherfurniture", "hang")
def wall_mirror(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A framed mirror."""
    w, tall = rng.uniform(0.4, 0.8), rng.uniform(0.6, 1.2)
    a.box(palette.pick(rng, "wood", "dark", "metal", "paint"), (0, 0.015, 1.45), (w, 0.03, tall))
    a.box(palette.pick(rng, "mirror"), (0, 0.018, 1.45), (w - 0.08, 0.032, tall - 0.08))


@furniture("otherprop", "hang")
def toilet_roll(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A roll on a holder."""
    z = rng.uniform(0.65, 0.8)
    a.box(palette.pick(rng, "metal", "ceramic"), (0, 0.03, z + 0.02), (0.14, 0.06, 0.02))
    a.cylinder(palette.pick(rng, "paint", "ceramic"), (0, 0.07, z), (0.11, 0.11, 0.1), yaw=np.pi / 2, tilt=np.pi / 2)


@furniture("cabinet", "hang")
def wall_cabinet(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A small cabinet on the wall."""
    w, d, h, z = rng.uniform(0.4, 0.8), rng.uniform(0.16, 0.3), rng.uniform(0.5, 0.75), rng.uniform(1.5, 1.65)
    body, knob = palette.pick(rng, "wood", "paint", role="cabinet"), palette.pick(rng, "metal", "dark")
    a.box(body, (0, d / 2, z), (w, d, h))
    for x in (-1, 1):
        a.box(body, (x * w / 4, d + 0.008, z), (w / 2 - 0.01, 0.016, h - 0.01))
        a.box(knob, (x * 0.03, d + 0.025, z - h * 0.3), (0.015, 0.02, 0.08))


@furniture("otherprop", "hang")
def towel_rail(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A bar with a towel."""
    w, z = rng.uniform(0.45, 0.65), rng.uniform(1.1, 1.4)
    metal, cloth = palette.pick(rng, "metal"), palette.pick(rng, "fabric")
    a.box(metal, (0, 0.07, z), (w, 0.02, 0.02))
    for x in (-1, 1):
        a.box(metal, (x * w / 2, 0.035, z), (0.02, 0.07, 0.02))
    a.box(cloth, (0, 0.07, z - 0.24), (w * rng.uniform(0.5, 0.85), 0.035, 0.55))
