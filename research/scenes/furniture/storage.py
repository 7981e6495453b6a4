"""Cabinets, wardrobes, bookshelves."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Top


@furniture("cabinet", "wall", keep_free_m=0.5)
def wardrobe(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Tall, with two to four doors."""
    doors = int(rng.integers(2, 5))
    each, d, h = rng.uniform(0.38, 0.5), rng.uniform(0.52, 0.62), rng.uniform(1.8, 2.2)
    w = doors * each
    body, front = (palette.pick(rng, "wood", "paint", "lacquer", role="cabinet") for _ in range(2))
    knob = palette.pick(rng, "metal", "dark")
    sliding = rng.uniform() < 0.25
    if sliding:  # one leaf may be a mirror
        front = palette.pick(rng, "mirror") if rng.uniform() < 0.4 else front
    a.box(body, (0, d / 2, h / 2), (w, d, h))
    a.box(body, (0, d / 2, h + 0.015), (w + 0.03, d + 0.03, 0.03))
    for k in range(doors):
        x = (k - (doors - 1) / 2) * each
        leaf = front if not sliding or k == doors // 2 else body
        a.box(leaf, (x, d + 0.01, h / 2 + 0.03), (each - 0.012, 0.02, h - 0.12))
        hand = 1 if k % 2 == 0 else -1
        a.box(knob, (x + hand * (each / 2 - 0.05), d + 0.035, h * 0.5), (0.02, 0.03, 0.16))


@furniture("cabinet", "wall", keep_free_m=0.4)
def dresser(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A chest of drawers."""
    w, d, h = rng.uniform(0.8, 1.4), rng.uniform(0.4, 0.5), rng.uniform(0.7, 1.0)
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    body, knob = palette.pick(rng, "wood", "paint", role="cabinet"), palette.pick(rng, "metal", "dark", "wood")
    front = body if rng.uniform() < 0.6 else palette.pick(rng, "wood", "paint", "lacquer")
    a.box(body, (0, d / 2, h / 2 + 0.03), (w, d, h - 0.06))
    a.box(knob, (0, d / 2 - 0.01, 0.03), (w - 0.06, d - 0.06, 0.06))
    a.box(body, (0, d / 2 + 0.01, h + 0.012), (w + 0.04, d + 0.03, 0.03))
    for r in range(rows):
        for c in range(columns):
            x, z = (c - (columns - 1) / 2) * w / columns, 0.07 + (r + 0.5) * (h - 0.1) / rows
            a.box(front, (x, d + 0.01, z), (w / columns - 0.03, 0.02, (h - 0.1) / rows - 0.025))
            a.box(knob, (x, d + 0.03, z), (0.1, 0.025, 0.02))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h + 0.027))


@furniture("cabinet", "wall", keep_free_m=0.3)
def sideboard(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Low and long, often under a television."""
    w, d, h = rng.uniform(1.2, 1.9), rng.uniform(0.38, 0.46), rng.uniform(0.42, 0.62)
    body, front = palette.pick(rng, "wood", "paint", "dark", role="cabinet"), palette.pick(rng, "wood", "paint")
    doors = int(rng.integers(2, 5))
    a.box(body, (0, d / 2, h / 2 + 0.05), (w, d, h - 0.1))
    for x in (-1, 1):
        a.box(palette.pick(rng, "metal", "wood"), (x * (w / 2 - 0.08), d / 2, 0.035), (0.06, d - 0.1, 0.07))
    for k in range(doors):
        a.box(front, ((k - (doors - 1) / 2) * w / doors, d + 0.008, h / 2 + 0.05), (w / doors - 0.03, 0.016, h - 0.15))
    if rng.uniform() < 0.5:
        dark, lit = palette.pick(rng, "dark"), palette.pick(rng, "dark", "print", "screen")
        tv = min(w * 0.8, 1.2)
        a.box(dark, (0, 0.2, h + 0.03), (tv * 0.4, 0.18, 0.05), label="otherprop", item=1)
        a.box(dark, (0, 0.19, h + 0.06 + tv * 0.28), (tv, 0.05, tv * 0.56), label="otherprop", item=1)
        a.box(lit, (0, 0.217, h + 0.06 + tv * 0.28), (tv - 0.04, 0.008, tv * 0.56 - 0.04), label="otherprop", item=1)
    else:
        a.tops.append(Top(-w / 2, w / 2, 0, d, h))


@furniture("bookshelf", "wall", keep_free_m=0.4)
def bookshelf(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Open shelves with rows of books (otherprop)."""
    w, d, h = rng.uniform(0.7, 1.3), rng.uniform(0.26, 0.34), rng.uniform(1.5, 2.1)
    wood, shelves = palette.pick(rng, "wood", "paint"), int(rng.integers(4, 6))
    for x in (-1, 1):
        a.box(wood, (x * (w / 2 - 0.0125), d / 2, h / 2), (0.025, d, h))
    a.box(wood, (0, 0.01, h / 2), (w - 0.05, 0.015, h))
    pitch = (h - 0.1) / shelves
    for k in range(shelves + 1):
        a.box(wood, (0, d / 2, 0.08 + k * pitch), (w - 0.05, d - 0.006, 0.022))
    item = 0
    for k in range(shelves):
        floor, x = 0.091 + k * pitch, -w / 2 + 0.03
        while x < w / 2 - 0.15:
            run = min(rng.uniform(0.15, 0.5), w / 2 - 0.03 - x)
            if rng.uniform() < 0.72:
                tall, deep = pitch * rng.uniform(0.55, 0.85), d * rng.uniform(0.6, 0.85)
                item += 1
                books = palette.pick(rng, "books", "books", "books", "object")
                center = (x + run / 2, 0.02 + deep / 2, floor + tall / 2)
                a.box(books, center, (run, deep, tall), label="otherprop", item=item)
            elif rng.uniform() < 0.7:  # a thing instead of books
                item += 1
                tall, wide = pitch * rng.uniform(0.3, 0.75), min(run, rng.uniform(0.08, 0.22))
                thing, center = (
                    palette.pick(rng, "object", "ceramic", "plant", "metal"),
                    (x + run / 2, d / 2, floor + tall / 2),
                )
                add = (a.box, a.cylinder, a.ellipsoid, a.frustum)[int(rng.integers(4))]
                add(thing, center, (wide, min(wide, d * 0.8), tall), label="otherprop", item=item)
            x += run + 0.01
    a.tops.append(Top(-w / 2, w / 2, 0, d, 0.091 + shelves * pitch))


@furniture("otherfurniture", "wall")
def open_rack(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A metal or wooden rack with boxes."""
    w, d, h = rng.uniform(0.6, 1.0), rng.uniform(0.35, 0.45), rng.uniform(0.8, 1.6)
    frame = palette.pick(rng, "metal", "wood")
    for x in (-1, 1):
        for y in (0.02, d - 0.02):
            a.box(frame, (x * (w / 2 - 0.015), y, h / 2), (0.03, 0.03, h))
    levels = int(rng.integers(2, 4))
    for k in range(levels):
        z = 0.12 + k * (h - 0.16) / (levels - 1)
        a.box(frame, (0, d / 2, z), (w - 0.01, d - 0.01, 0.025))
        if k < levels - 1 and rng.uniform() < 0.8:
            bw, bh = rng.uniform(0.25, 0.45), rng.uniform(0.15, 0.26)
            material = palette.pick(rng, "object", "wood", "fabric")
            center = (rng.uniform(-0.4, 0.4) * (w - bw - 0.08), d / 2, z + 0.0125 + bh / 2)
            a.box(material, center, (bw, d * 0.75, bh), label="otherprop", item=1 + k)


@furniture("bookshelf", "wall", keep_free_m=0.4)
def cube_shelf(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A grid of cells; some hold books, boxes or vases."""
    columns, rows, cell = int(rng.integers(2, 5)), int(rng.integers(2, 5)), rng.uniform(0.34, 0.4)
    w, d, h = columns * cell + 0.03, rng.uniform(0.3, 0.39), rows * cell + 0.03
    wood = palette.pick(rng, "wood", "paint", "dark")
    a.box(wood, (0, 0.008, h / 2), (w, 0.014, h))
    for k in range(columns + 1):
        a.box(wood, (k * cell - (w - 0.03) / 2, d / 2, h / 2), (0.03, d, h))
    for k in range(rows + 1):
        a.box(wood, (0, d / 2, 0.015 + k * cell), (w - 0.002, d - 0.004, 0.03))
    for k in range(columns * rows):
        kind, material = rng.uniform(), palette.pick(rng, "books", "books", "object", "fabric", "wood")
        x = (k % columns + 0.5) * cell - (w - 0.03) / 2
        z = 0.03 + (k // columns) * cell
        if kind < 0.35:
            tall = rng.uniform(0.55, 0.85) * cell
            a.box(
                material,
                (x - 0.02, d * 0.45, z + tall / 2),
                (cell * 0.75, d * 0.65, tall),
                label="otherprop",
                item=k + 1,
            )
        elif kind < 0.55:
            side = cell - 0.05
            a.box(material, (x, d * 0.5, z + side * 0.46), (side, d * 0.8, side * 0.92), label="otherprop", item=k + 1)
        elif kind < 0.7:
            size = (0.14, 0.14, cell * 0.6)
            a.ellipsoid(material, (x, d * 0.5, z + cell * 0.3), size, label="otherprop", item=k + 1)
    a.tops.append(Top(-w / 2, w / 2, 0, d, h))


@furniture("bookshelf", "wall", keep_free_m=0.3)
def ladder_shelf(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Boards that get deeper towards the floor, on two rails that lean against the wall."""
    w, h, lean = rng.uniform(0.5, 0.8), rng.uniform(1.5, 1.9), rng.uniform(0.14, 0.2)
    wood, rail = palette.pick(rng, "wood", "paint"), palette.pick(rng, "wood", "metal", "dark")
    foot = h * float(np.tan(lean))
    rise, thick = h / 2, 0.04
    length = (h - thick * float(np.sin(lean))) / float(np.cos(lean))
    for x in (-1, 1):
        a.box(rail, (x * (w / 2 - 0.02), 0.05 + foot / 2, rise), (0.035, thick, length), tilt=lean)
    for k in range(4):
        z = 0.3 + k * (h - 0.4) / 4
        deep = 0.06 + foot * (1 - z / h)
        a.box(wood, (0, deep / 2 + 0.01, z), (w - 0.08, deep, 0.022))
        if rng.uniform() < 0.8 and deep > 0.12:
            run, tall = rng.uniform(0.3, 0.8) * (w - 0.12), rng.uniform(0.16, 0.25)
            x = rng.uniform(-0.5, 0.5) * (w - 0.12 - run)
            books, center = palette.pick(rng, "books", "object"), (x, deep * 0.5, z + 0.011 + tall / 2)
            a.box(books, center, (run, deep * 0.7, tall), label="otherprop", item=k + 1)


@furniture("cabinet", "wall", keep_free_m=0.4)
def filing_cabinet(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Steel drawers one above the other, with name plates."""
    drawers, w, d = int(rng.integers(2, 5)), rng.uniform(0.4, 0.5), rng.uniform(0.5, 0.62)
    h = drawers * rng.uniform(0.31, 0.35) + 0.05
    body, metal = palette.pick(rng, "metal", "paint", role="cabinet"), palette.pick(rng, "metal", "dark")
    a.box(body, (0, d / 2, h / 2), (w, d, h))
    for k in range(drawers):
        z, tall = 0.03 + (k + 0.5) * (h - 0.04) / drawers, (h - 0.04) / drawers - 0.02
        a.box(body, (0, d + 0.01, z), (w - 0.03, 0.02, tall))
        a.box(metal, (0, d + 0.03, z + tall * 0.2), (0.14, 0.025, 0.02))
        a.box(palette.pick(rng, "paint"), (0, d + 0.021, z + tall * 0.36), (0.08, 0.008, 0.035))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h))
