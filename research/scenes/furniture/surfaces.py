"""Tables and desks."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Top


def _legs(a: Assembly, material: int, w: float, d: float, height: float, thick: float) -> None:
    for x in (-1, 1):
        for y in (thick, d - thick):
            a.box(material, (x * (w / 2 - thick), y, height / 2), (thick, thick, height))


def _tablecloth(a: Assembly, rng: np.random.Generator, palette: Palette, w: float, d: float, h: float) -> None:
    """A cloth that hangs over all four edges."""
    cloth, drop = palette.pick(rng, "fabric"), rng.uniform(0.12, 0.3)
    a.box(cloth, (0, d / 2, h + 0.0185), (w + 0.012, d + 0.012, 0.003))
    for side in (-1, 1):
        a.box(cloth, (side * (w / 2 + 0.006), d / 2, h + 0.02 - drop / 2), (0.008, d + 0.02, drop))
        a.box(cloth, (0, d / 2 + side * (d / 2 + 0.006), h + 0.02 - drop / 2), (w + 0.004, 0.008, drop))


def _trestles(a: Assembly, material: int, w: float, d: float, h: float) -> None:
    """Two pairs of slanting legs joined by a bar."""
    lean, thick = 0.22, 0.05
    length = (h - 0.02 - thick * float(np.sin(lean))) / float(np.cos(lean))
    for x in (-1, 1):
        for y in (-1, 1):
            a.box(
                material, (x * (w / 2 - 0.18), d / 2 + y * 0.16, (h - 0.02) / 2), (thick, thick, length), tilt=y * lean
            )
        a.box(material, (x * (w / 2 - 0.18), d / 2, 0.28), (0.03, 0.44, 0.04))


@furniture("table", "centre", keep_free_m=0.0)
def dining_table(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A rectangular table with four legs."""
    w, d, h = rng.uniform(1.1, 1.8), rng.uniform(0.75, 0.95), rng.uniform(0.72, 0.77)
    wood = palette.pick(rng, "wood", "wood", "wood", "paint", "lacquer", "stone", role="table")
    a.box(wood, (0, d / 2, h), (w, d, 0.04))
    if rng.uniform() < 0.12:
        _tablecloth(a, rng, palette, w, d, h)
    if rng.uniform() < 0.3:
        _trestles(a, palette.pick(rng, "wood", "metal"), w, d, h)
        a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.02))
        return
    _legs(a, palette.pick(rng, "wood", "metal") if rng.uniform() < 0.3 else wood, w, d, h - 0.02, 0.06)
    a.box(wood, (0, d / 2, h - 0.06), (w - 0.16, d - 0.16, 0.07))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.02))


@furniture("table", "centre")
def round_table(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A round or oval top on a column."""
    r, h = rng.uniform(0.8, 1.2), rng.uniform(0.72, 0.77)
    wood, foot = palette.pick(rng, "wood", "wood", "paint", "stone", role="table"), palette.pick(rng, "wood", "metal")
    wide = r * (1.0 if rng.uniform() < 0.6 else rng.uniform(1.2, 1.5))
    a.cylinder(wood, (0, r / 2, h), (wide, r, 0.04))
    if rng.uniform() < 0.5:
        a.cylinder(foot, (0, r / 2, h / 2), (0.1, 0.1, h - 0.04))
        a.cylinder(foot, (0, r / 2, 0.02), (r * 0.5, r * 0.5, 0.04))
    else:
        a.frustum(foot, (0, r / 2, h / 2 - 0.01), (r * 0.5, r * 0.5, h - 0.02))
    a.tops.append(Top(-r * 0.35, r * 0.35, r * 0.15, r * 0.85, h + 0.02))


@furniture("table", "centre")
def coffee_table(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A low table, sometimes with a shelf."""
    w, d, h = rng.uniform(0.8, 1.2), rng.uniform(0.5, 0.7), rng.uniform(0.36, 0.46)
    wood = palette.pick(rng, "wood", "dark", role="table")
    if rng.uniform() < 0.3:  # round
        a.cylinder(wood, (0, d / 2, h), (d * 1.2, d * 1.2 - 0.02, 0.04))
        for k in range(3):
            x, y = 0.36 * d * float(np.cos(2.1 * k)), 0.36 * d * float(np.sin(2.1 * k))
            a.cylinder(palette.pick(rng, "metal", "wood"), (x, d / 2 + y, (h - 0.02) / 2), (0.04, 0.04, h - 0.02))
        a.tops.append(Top(-d * 0.35, d * 0.35, d * 0.15, d * 0.85, h + 0.02))
        return
    a.box(wood, (0, d / 2, h), (w, d, 0.05))
    _legs(a, palette.pick(rng, "wood", "metal"), w, d, h - 0.02, 0.05)
    if rng.uniform() < 0.5:
        a.box(wood, (0, d / 2, 0.14), (w - 0.1, d - 0.1, 0.025))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.025))


@furniture("desk", "wall", keep_free_m=0.75)
def desk(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A writing desk with a drawer pedestal, screen and keyboard."""
    w, d, h = rng.uniform(1.1, 1.6), rng.uniform(0.6, 0.75), rng.uniform(0.7, 0.76)
    wood, dark = palette.pick(rng, "wood", "wood", "paint", role="desk"), palette.pick(rng, "dark", "metal")
    if rng.uniform() < 0.35:
        _plain_desk(a, rng, palette, wood, w, d, h)
        return
    side = 1 if rng.uniform() < 0.5 else -1
    a.box(wood, (0, d / 2, h), (w, d, 0.035))
    a.box(wood, (-side * (w / 2 - 0.03), d / 2, (h - 0.02) / 2), (0.035, d - 0.04, h - 0.02))
    a.box(wood, (0, 0.05, h * 0.65), (w - 0.1, 0.02, h * 0.5))
    a.box(wood, (side * (w / 2 - 0.22), d / 2, (h - 0.02) / 2), (0.4, d - 0.06, h - 0.02))
    for z in (0.18, 0.4, 0.6):
        a.box(wood, (side * (w / 2 - 0.22), d - 0.02, z * h / 0.74), (0.37, 0.02, 0.17))
        a.box(dark, (side * (w / 2 - 0.22), d, z * h / 0.74), (0.12, 0.025, 0.015))
    _computer(a, rng, palette, dark, -side * w * 0.12, h)
    edge = side * w / 2
    a.tops.append(Top(min(edge, edge - side * 0.42), max(edge, edge - side * 0.42), 0, d, h + 0.018))


def _computer(a: Assembly, rng: np.random.Generator, palette: Palette, dark: int, x: float, h: float) -> None:
    """Screen, keyboard and mouse on a desk of height ``h``."""
    screen = palette.pick(rng, "dark", "print", "screen")
    a.box(dark, (x, 0.2, h + 0.0275), (0.2, 0.16, 0.02), label="otherprop", item=1)
    a.box(dark, (x, 0.17, h + 0.14), (0.05, 0.03, 0.22), label="otherprop", item=1)
    a.box(dark, (x, 0.19, h + 0.33), (0.56, 0.03, 0.34), label="otherprop", item=1)
    a.box(screen, (x, 0.206, h + 0.33), (0.53, 0.006, 0.31), label="otherprop", item=1)
    a.box(dark, (x, 0.45, h + 0.025), (0.42, 0.14, 0.015), label="otherprop", item=2)
    a.ellipsoid(dark, (x + 0.3, 0.45, h + 0.0325), (0.065, 0.1, 0.03), label="otherprop", item=3)


def _plain_desk(
    a: Assembly, rng: np.random.Generator, palette: Palette, wood: int, w: float, d: float, h: float
) -> None:
    """A top on four legs, often with drawers under it and a screen or nothing on it."""
    a.box(wood, (0, d / 2, h), (w, d, 0.03))
    _legs(a, palette.pick(rng, "metal", "wood", "paint"), w, d, h - 0.015, 0.045)
    if rng.uniform() < 0.6:
        a.box(wood, (0, d / 2 - 0.02, h - 0.07), (w - 0.12, d - 0.14, 0.11))
        for x in (-1, 1):
            a.box(palette.pick(rng, "metal", "dark"), (x * w / 4, d - 0.085, h - 0.07), (0.1, 0.02, 0.015))
    if rng.uniform() < 0.5:
        _computer(a, rng, palette, palette.pick(rng, "dark", "metal"), -w * 0.15, h - 0.0025)
        a.tops.append(Top(w * 0.16 + 0.06, w / 2, 0, d, h + 0.015))
    else:
        a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.015))


@furniture("otherfurniture", "wall")
def nightstand(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A small chest beside a bed."""
    w, d, h = rng.uniform(0.38, 0.5), rng.uniform(0.35, 0.42), rng.uniform(0.42, 0.6)
    wood, knob = palette.pick(rng, "wood", "paint"), palette.pick(rng, "metal")
    a.box(wood, (0, d / 2, h / 2 + 0.03), (w, d, h - 0.06))
    a.box(wood, (0, d / 2 - 0.01, 0.03), (w - 0.06, d - 0.06, 0.06))
    a.box(wood, (0, d / 2, h + 0.01), (w + 0.03, d + 0.02, 0.025))
    for z in (0.3, 0.7):
        a.box(wood, (0, d + 0.008, h * z + 0.02), (w - 0.05, 0.016, h * 0.36))
        a.ellipsoid(knob, (0, d + 0.025, h * z + 0.02), (0.03, 0.03, 0.03))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.0225))


@furniture("table", "corner")
def side_table(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A small table, round on a column or square on legs."""
    w, h = rng.uniform(0.36, 0.52), rng.uniform(0.45, 0.62)
    top, foot = palette.pick(rng, "wood", "metal", "paint", role="table"), palette.pick(rng, "wood", "metal", "dark")
    if rng.uniform() < 0.5:
        a.cylinder(top, (0, 0.3, h), (w, w, 0.03))
        a.cylinder(foot, (0, 0.3, h / 2), (0.05, 0.05, h - 0.03))
        a.frustum(foot, (0, 0.3, 0.015), (w * 0.7, w * 0.7, 0.03))
    else:
        a.box(top, (0, w / 2, h), (w, w, 0.03))
        _legs(a, foot, w, w, h - 0.015, 0.035)
        a.box(top, (0, w / 2, h * 0.35), (w - 0.08, w - 0.08, 0.02))
    middle = 0.3 if len(a.parts) == 3 else w / 2
    a.tops.append(Top(-w * 0.35, w * 0.35, middle - w * 0.35, middle + w * 0.35, h + 0.015))
