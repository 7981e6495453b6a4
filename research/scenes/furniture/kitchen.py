"""Counters, wall units, refrigerators."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Top

_LACQUER = ("lacquer",) * 3  # as often as any paint
_WORKTOPS = ("stone", "stone", "stone", "tile", "wood", "dark", "paint")


@furniture("counter", "wall", keep_free_m=0.6)
def counter(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Base cabinets under a worktop, with a sink, sometimes with wall units above."""
    doors = int(rng.integers(3, 7))
    each, d, h = rng.uniform(0.45, 0.6), rng.uniform(0.58, 0.64), rng.uniform(0.86, 0.92)
    w = doors * each
    front = palette.pick(rng, "wood", "paint", *_LACQUER, role="cabinet")
    top = palette.pick(rng, *_WORKTOPS, role="counter")
    metal, panelled = palette.pick(rng, "metal", "dark"), rng.uniform() < 0.35
    # The carcass ends under the bowl of the sink; end panels and doors hide the gap.
    a.box(front, (0, d / 2 - 0.02, (h - 0.12) / 2), (w - 0.05, d - 0.08, h - 0.28), label="cabinet", item=1)
    for x in (-1, 1):
        a.box(
            front,
            (x * (w / 2 - 0.0125), d / 2 - 0.02, h / 2 + 0.03),
            (0.025, d - 0.06, h - 0.1),
            label="cabinet",
            item=1,
        )
    a.box(metal, (0, d / 2 - 0.05, 0.045), (w - 0.02, d - 0.1, 0.09), label="cabinet", item=1)
    for k in range(doors):
        x = (k - (doors - 1) / 2) * each
        a.box(front, (x, d - 0.045, h / 2 + 0.02), (each - 0.015, 0.02, h - 0.16), label="cabinet", item=1)
        a.box(metal, (x, d - 0.025, h - 0.14), (each * 0.4, 0.022, 0.018), label="cabinet", item=1)
        if panelled:
            a.box(front, (x, d - 0.033, h / 2 - 0.03), (each - 0.14, 0.006, h - 0.4), label="cabinet", item=1)
    # The worktop is four boxes round the bowl, so that the sink is a real hole.
    sink_w, sink_d, slot = 0.52, 0.36, int(rng.integers(doors))
    sx = float(np.clip((slot - (doors - 1) / 2) * each, -w / 2 + 0.32, w / 2 - 0.32))
    left, right = sx - sink_w / 2 + w / 2, w / 2 - sx - sink_w / 2
    a.box(top, (-w / 2 + left / 2, d / 2, h), (left, d, 0.04))
    a.box(top, (w / 2 - right / 2, d / 2, h), (right, d, 0.04))
    front_d = d - 0.12 - sink_d
    a.box(top, (sx, 0.06, h), (sink_w, 0.12, 0.04))
    a.box(top, (sx, d - front_d / 2, h), (sink_w, front_d, 0.04))
    _bowl(a, palette.pick(rng, "metal", "ceramic"), sx, 0.12 + sink_d / 2, h, sink_w, sink_d)
    a.cylinder(metal, (sx, 0.07, h + 0.14), (0.03, 0.03, 0.26), label="sink", item=2)
    a.box(metal, (sx, 0.15, h + 0.26), (0.025, 0.18, 0.025), label="sink", item=2)
    a.box(palette.pick(rng, "tile", "wallpaint"), (0, 0.01, h + 0.27), (w, 0.012, 0.5), label="wall", item=3)
    units = rng.uniform() < 0.6
    if units:
        _wall_units(a, rng, palette, front, metal, doors, each)
    _pinned(a, rng, palette, w, h + 0.1, 1.38 if units else 1.9)
    for x0, x1 in ((-w / 2, sx - 0.3), (sx + 0.3, w / 2)):
        a.tops.append(Top(x0, x1, 0.03, d, h + 0.02))


def _pinned(a: Assembly, rng: np.random.Generator, palette: Palette, w: float, low: float, high: float) -> None:
    """Notices and leaflets on the wall above a counter, in half of the kitchens."""
    count = int(rng.integers(1, 8)) if rng.uniform() < 0.5 else 0
    for k in range(count):
        x = (k + 0.5 + rng.uniform(-0.3, 0.3)) / count * w - w / 2
        wide, tall = rng.uniform(0.1, 0.21), rng.uniform(0.14, 0.3)
        z = rng.uniform(low + tall / 2, max(high - tall / 2, low + tall / 2 + 0.01))
        a.box(palette.pick(rng, "paper", "print"), (x, 0.018, z), (wide, 0.004, tall), label="otherprop", item=20 + k)


def _bowl(a: Assembly, material: int, x: float, y: float, h: float, w: float, d: float) -> None:
    a.box(material, (x, y, h - 0.15), (w - 0.004, d - 0.004, 0.02), label="sink", item=2)
    for side in (-1, 1):
        a.box(material, (x + side * (w / 2 - 0.012), y, h - 0.06), (0.024, d - 0.004, 0.17), label="sink", item=2)
        a.box(material, (x, y + side * (d / 2 - 0.012), h - 0.06), (w - 0.05, 0.024, 0.168), label="sink", item=2)


def _wall_units(
    a: Assembly, rng: np.random.Generator, palette: Palette, front: int, metal: int, doors: int, each: float
) -> None:
    w, low, tall, d = doors * each, rng.uniform(1.42, 1.5), rng.uniform(0.55, 0.7), 0.33
    a.box(front, (0, 0.02 + d / 2, low + tall / 2), (w, d, tall), label="cabinet", item=4)
    panel = palette.pick(rng, "dark", "ceramic", "steel") if rng.uniform() < 0.3 else front  # glass, or as the frame
    panelled = panel != front or rng.uniform() < 0.3
    for k in range(doors):
        x = (k - (doors - 1) / 2) * each
        a.box(front, (x, d + 0.03, low + tall / 2), (each - 0.015, 0.02, tall - 0.02), label="cabinet", item=4)
        if panelled:
            a.box(panel, (x, d + 0.032, low + tall / 2), (each - 0.14, 0.02, tall - 0.16), label="cabinet", item=4)
        a.box(metal, (x, d + 0.05, low + 0.06), (each * 0.3, 0.02, 0.016), label="cabinet", item=4)


@furniture("refrigerator", "corner", keep_free_m=0.6)
def refrigerator(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Body, one or two doors one above the other, bar handles."""
    w, d, h = rng.uniform(0.58, 0.8), rng.uniform(0.6, 0.7), rng.uniform(1.5, 1.95)
    body = palette.pick(rng, "paint", "ceramic", "steel", "steel", "steel", "dark", role="refrigerator")
    metal = palette.pick(rng, "metal", "dark")
    split = rng.choice([0.33, 0.68]) * h
    hand = 1 if rng.uniform() < 0.5 else -1
    a.box(body, (0, d / 2, h / 2), (w, d, h))
    for z0, z1 in ((0.08, split - 0.008), (split + 0.008, h - 0.01)):
        a.box(body, (0, d + 0.03, (z0 + z1) / 2), (w - 0.004, 0.055, z1 - z0))
        length = min(0.45, (z1 - z0) * 0.6)
        toward = z1 - length / 2 - 0.05 if z0 < 0.1 else z0 + length / 2 + 0.05
        a.cylinder(metal, (hand * (w / 2 - 0.06), d + 0.08, toward), (0.03, 0.03, length))
    if rng.uniform() < 0.4:
        a.box(
            palette.pick(rng, "print"), (-hand * 0.1, d + 0.06, h * 0.8), (0.15, 0.008, 0.2), label="otherprop", item=1
        )


@furniture("otherfurniture", "wall", keep_free_m=0.5)
def stove(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A cooker with four plates and an oven window."""
    body, dark = palette.pick(rng, "paint", "metal", "steel"), palette.pick(rng, "dark")
    h, d = rng.uniform(0.86, 0.92), 0.6
    a.box(body, (0, d / 2, h / 2), (0.6, d, h))
    a.box(dark, (0, d + 0.008, 0.45), (0.46, 0.016, 0.3))
    a.box(palette.pick(rng, "metal"), (0, d + 0.03, 0.66), (0.46, 0.025, 0.025))
    for x in (-0.14, 0.14):
        for y in (0.17, 0.44):
            a.cylinder(dark, (x, y, h + 0.006), (0.2, 0.2, 0.014))
            a.cylinder(dark, (x, d + 0.01, h - 0.07), (0.04, 0.04, 0.04))
    a.box(body, (0, 0.03, h + 0.06), (0.6, 0.05, 0.12))
    if rng.uniform() < 0.6:  # a hood above it
        metal = palette.pick(rng, "metal", "paint", "dark")
        a.frustum(metal, (0, 0.25, 1.72), (0.62, 0.48, 0.24), item=1)
        a.box(metal, (0, 0.14, 1.98), (0.26, 0.24, 0.3), item=1)


@furniture("counter", "centre", keep_free_m=0.4)
def kitchen_island(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A block with doors under an overhanging top."""
    w, d, h = rng.uniform(1.0, 1.6), rng.uniform(0.65, 0.9), rng.uniform(0.88, 0.94)
    body = palette.pick(rng, "wood", "paint", *_LACQUER, role="cabinet")
    top, metal = palette.pick(rng, *_WORKTOPS, role="counter"), palette.pick(rng, "metal", "dark")
    a.box(body, (0, d / 2, (h - 0.02) / 2), (w - 0.12, d - 0.16, h - 0.02), label="cabinet", item=1)
    for k in (-1, 0, 1):
        x, each = k * (w - 0.12) / 3, (w - 0.12) / 3 - 0.015
        a.box(body, (x, d - 0.072, h / 2), (each, 0.018, h - 0.16), label="cabinet", item=1)
        a.box(metal, (x, d - 0.055, h - 0.13), (each * 0.5, 0.02, 0.016), label="cabinet", item=1)
    a.box(top, (0, d / 2, h), (w, d, 0.04))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.02))


@furniture("cabinet", "wall", keep_free_m=0.5)
def larder(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A tall kitchen cupboard, sometimes with an oven in it."""
    w, d, h = rng.uniform(0.55, 0.65), rng.uniform(0.56, 0.62), rng.uniform(1.9, 2.15)
    body, metal = palette.pick(rng, "wood", "paint", *_LACQUER, role="cabinet"), palette.pick(rng, "metal", "dark")
    a.box(body, (0, d / 2, h / 2), (w, d, h))
    oven = rng.uniform() < 0.5
    for z0, z1 in ((0.1, 0.78), (1.4, h - 0.02)) if oven else ((0.1, 1.1), (1.12, h - 0.02)):
        a.box(body, (0, d + 0.01, (z0 + z1) / 2), (w - 0.012, 0.02, z1 - z0))
        a.box(metal, (w / 2 - 0.06, d + 0.03, (z0 + z1) / 2), (0.02, 0.025, 0.18))
    if oven:
        a.box(palette.pick(rng, "dark"), (0, d + 0.012, 1.09), (w - 0.02, 0.024, 0.58), label="otherfurniture", item=1)
        a.box(metal, (0, d + 0.04, 1.3), (w - 0.14, 0.03, 0.025), label="otherfurniture", item=1)
