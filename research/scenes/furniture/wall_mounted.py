"""Doors, windows, curtains, pictures, radiators, what hangs on walls."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Top


@furniture("door", "hang", keep_free_m=0.9)
def door(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Leaf with panels, frame, handle."""
    w, h = rng.uniform(0.8, 0.95), rng.uniform(1.95, 2.1)
    leaf, frame = palette.pick(rng, "wood", "paint", "lacquer", role="door"), palette.pick(rng, "wood", "paint")
    metal = palette.pick(rng, "metal", "dark")
    a.box(leaf, (0, 0.025, h / 2), (w, 0.05, h))
    for x in (-1, 1):
        a.box(frame, (x * (w / 2 + 0.04), 0.035, h / 2 + 0.02), (0.08, 0.07, h + 0.04))
    a.box(frame, (0, 0.035, h + 0.04), (w, 0.068, 0.08))
    hand = 1 if rng.uniform() < 0.5 else -1
    a.box(metal, (hand * (w / 2 - 0.08), 0.06, 1.02), (0.04, 0.03, 0.16))
    a.box(metal, (hand * (w / 2 - 0.13), 0.1, 1.05), (0.13, 0.025, 0.025))
    style = int(rng.integers(4))
    panels = ((0.28, 0.36), (0.74, 0.36)) if style == 1 else ((0.2, 0.26), (0.5, 0.22), (0.8, 0.26))
    for z, tall in panels if style in (1, 2) else ():
        a.box(leaf, (0, 0.055, z * h), (w * 0.66, 0.014, tall * h))
    if style == 3:  # a pane in the upper half
        a.box(palette.pick(rng, "daylight", "dark", "screen"), (0, 0.05, 0.7 * h), (w * 0.5, 0.012, 0.42 * h))


@furniture("window", "hang")
def window(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Panes in a frame with bars, a sill, often curtains at its sides."""
    w, tall, low = rng.uniform(0.8, 1.7), rng.uniform(0.9, 1.35), rng.uniform(0.8, 1.0)
    pane, frame = palette.pick(rng, "daylight", "daylight", "daylight", "dark"), palette.pick(rng, "paint", "wood")
    mid = low + tall / 2
    a.box(pane, (0, 0.01, mid), (w, 0.02, tall), casts_shadow=False)
    for x in (-1, 1):
        a.box(frame, (x * (w / 2 + 0.02), 0.03, mid), (0.07, 0.06, tall + 0.11))
    for z in (low - 0.02, low + tall + 0.02):
        a.box(frame, (0, 0.03, z), (w - 0.03, 0.058, 0.07))
    bars = int(rng.integers(1, 3))
    for k in range(bars):
        a.box(frame, ((k + 1) * w / (bars + 1) - w / 2, 0.025, mid), (0.05, 0.046, tall))
    if rng.uniform() < 0.4:
        a.box(frame, (0, 0.025, low + tall * 0.65), (w, 0.044, 0.04))
    a.box(palette.pick(rng, "paint", "wood", "tile", "stone"), (0, 0.09, low - 0.07), (w + 0.2, 0.18, 0.035))
    a.lamps.extend(((-w / 4, 0.35, mid + 0.1), (w / 4, 0.35, mid + 0.1)))
    a.tops.append(Top(-w / 2 + 0.05, w / 2 - 0.05, 0.06, 0.18, low - 0.0525))
    if rng.uniform() < 0.7:
        _curtains(a, rng, palette, w, low + tall + 0.15)


def _curtains(a: Assembly, rng: np.random.Generator, palette: Palette, w: float, top: float) -> None:
    cloth, rod = palette.pick(rng, "fabric", role="curtain"), palette.pick(rng, "metal", "wood")
    bottom = 0.05 if rng.uniform() < 0.6 else rng.uniform(0.6, 0.75)
    folds, width = int(rng.integers(3, 7)), rng.uniform(0.09, 0.12)
    # Hung clear of the sill, which sticks out 18 cm.
    for x in (-1, 1):
        for k in range(folds):
            center = (x * (w / 2 + 0.16 - (k - 1) * width * 0.85), 0.24, (top + bottom) / 2)
            size = (width, rng.uniform(0.05, 0.09), top - bottom)
            a.cylinder(cloth, center, size, label="curtain", item=1 if x < 0 else 2)
    a.box(rod, (0, 0.24, top + 0.015), (w + 0.7, 0.03, 0.03), label="otherprop", item=3)


@furniture("picture", "hang")
def picture(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A framed print; some are lit, some have a mount."""
    w, tall = rng.uniform(0.35, 1.1), rng.uniform(0.35, 0.9)
    z = rng.uniform(1.45, 1.65)
    sight = palette.pick(rng, "print", "print", "paper", "fabric", "screen", role="picture")
    sight = palette.pick(rng, "screen") if rng.uniform() < 0.2 else sight
    edge = rng.uniform(0.02, 0.06)
    a.box(palette.pick(rng, "wood", "paint", "dark", "metal"), (0, 0.015, z), (w, 0.03, tall))
    if rng.uniform() < 0.35:
        a.box(palette.pick(rng, "paint", "wallpaint"), (0, 0.018, z), (w - 2 * edge, 0.03, tall - 2 * edge))
        edge += 0.05
    a.box(sight, (0, 0.02, z), (w - 2 * edge, 0.034, tall - 2 * edge))


@furniture("otherprop", "hang")
def notices(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Sheets pinned to the wall, side by side or one above the other, sometimes on a board."""
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    z, pitch = rng.uniform(1.25, 1.6), rng.uniform(0.24, 0.32)
    if rng.uniform() < 0.3:
        size = (columns * pitch + 0.05, 0.012, rows * 0.34 + 0.05)
        a.box(palette.pick(rng, "wood", "fabric", "paint"), (0, 0.006, z), size)
    for k in range(columns * rows):
        x, up = (k % columns - (columns - 1) / 2) * pitch, (k // columns - (rows - 1) / 2) * 0.33
        wide, tall = rng.uniform(0.12, 0.21), rng.uniform(0.15, 0.3)
        center = (x + rng.uniform(-0.02, 0.02), 0.0145, z + up + rng.uniform(-0.01, 0.01))
        a.box(palette.pick(rng, "paper", "paper", "print"), center, (wide, 0.005, tall), item=1 + k)


@furniture("otherprop", "hang")
def wall_clock(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Rim, face, hands."""
    w, z = rng.uniform(0.24, 0.36), rng.uniform(1.75, 2.0)
    rim, face, dark = palette.pick(rng, "wood", "metal", "dark"), palette.pick(rng, "paint"), palette.pick(rng, "dark")
    a.cylinder(rim, (0, 0.02, z), (w, w, 0.04), tilt=np.pi / 2)
    a.cylinder(face, (0, 0.024, z), (w - 0.03, w - 0.03, 0.04), tilt=np.pi / 2)
    a.box(dark, (0, 0.046, z + w * 0.16), (0.012, 0.006, w * 0.34))
    a.box(dark, (w * 0.1, 0.046, z), (w * 0.22, 0.006, 0.014))


@furniture("otherprop", "hang")
def television(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A flat screen on the wall."""
    w, z = rng.uniform(0.9, 1.4), rng.uniform(1.2, 1.45)
    a.box(palette.pick(rng, "dark"), (0, 0.03, z), (w, 0.06, w * 0.58))
    a.box(palette.pick(rng, "dark", "screen", "print"), (0, 0.035, z), (w - 0.03, 0.06, w * 0.58 - 0.03))


@furniture("otherprop", "hang")
def coat_hooks(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A board with hooks and clothes on some of them."""
    w, z = rng.uniform(0.5, 0.9), rng.uniform(1.6, 1.8)
    a.box(palette.pick(rng, "wood", "paint"), (0, 0.01, z), (w, 0.02, 0.1))
    for k in range(4):
        x = (k - 1.5) * w / 4
        a.box(palette.pick(rng, "metal"), (x, 0.045, z - 0.02), (0.02, 0.06, 0.02))
        if rng.uniform() < 0.5:
            long = rng.uniform(0.5, 0.95)
            size = (rng.uniform(0.16, 0.24), 0.1, long)
            a.ellipsoid(palette.pick(rng, "fabric"), (x, 0.075, z - 0.03 - long / 2), size, item=1 + k)


@furniture("otherfurniture", "hang")
def radiator(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A row of ribs near the floor."""
    ribs, paint = int(rng.integers(6, 11)), palette.pick(rng, "paint", "ceramic")
    for k in range(ribs):
        a.box(paint, ((k - (ribs - 1) / 2) * 0.09, 0.07, 0.4), (0.065, 0.09, 0.5))
    for z in (0.2, 0.6):
        a.box(paint, (0, 0.06, z), (ribs * 0.09 - 0.03, 0.04, 0.04))


@furniture("otherfurniture", "hang")
def wall_shelf(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A board with books and a pot."""
    w, z = rng.uniform(0.6, 1.1), rng.uniform(1.35, 1.7)
    a.box(palette.pick(rng, "wood", "paint"), (0, 0.11, z), (w, 0.22, 0.03))
    run, tall = w * rng.uniform(0.3, 0.6), rng.uniform(0.16, 0.25)
    books, center = palette.pick(rng, "books", "books", "object"), (-w / 2 + 0.03 + run / 2, 0.1, z + 0.015 + tall / 2)
    a.box(books, center, (run, 0.15, tall), label="otherprop", item=1)
    pot = palette.pick(rng, "object", "ceramic")
    a.cylinder(pot, (w / 2 - 0.12, 0.11, z + 0.075), (0.12, 0.12, 0.12), label="otherprop", item=2)
