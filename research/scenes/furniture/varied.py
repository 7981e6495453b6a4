"""Pieces that only varied rooms hold (``RoomConfig.variety``): what benchmark rooms lack and homes have."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.kitchen import counter
from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly, Top

# In half of the cases varied rooms hold the second in place of the first.
VARIANTS = {
    "window": "any_window", "door": "any_door", "picture": "any_picture", "counter": "any_counter",
    "bathtub": "any_bathtub", "toilet": "any_toilet", "wash_basin": "any_basin",
}  # fmt: skip

_RETURN_D_M = 0.62  # depth of the short run of an L


@furniture("counter", "corner", keep_free_m=0.3)
def corner_counter(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A counter with a second run at a right angle, in the corner at the origin's left; an L."""
    counter(a, rng, palette)
    fronts, worktops = (
        [p for p in a.parts if p.label == "cabinet"],
        [p for p in a.parts if p.label == "counter"],
    )
    front, top, h = fronts[0].material, worktops[0].material, float(worktops[0].center[2])
    metal = palette.pick(rng, "metal", "dark")
    (low, high), d = a.bounds(), float(max(p.center[1] + p.half[1] for p in worktops))
    x, doors, each = float(low[0]) + _RETURN_D_M / 2, int(rng.integers(1, 5)), rng.uniform(0.42, 0.6)
    run, d = doors * each, max(d, float(high[1])) + 0.002
    a.box(front, (x, d + run / 2, h / 2 + 0.03), (_RETURN_D_M - 0.06, run - 0.004, h - 0.1), label="cabinet", item=30)
    a.box(metal, (x - 0.02, d + run / 2, 0.045), (_RETURN_D_M - 0.1, run - 0.01, 0.09), label="cabinet", item=30)
    a.box(top, (x, d + run / 2, h), (_RETURN_D_M, run, 0.04))
    # The corner between the two runs: the doors and handles of the first end a little before its bounds.
    a.box(top, (x, d - 0.03, h), (_RETURN_D_M, 0.06, 0.038))
    for k in range(doors):
        y = d + (k + 0.5) * each
        face = x + _RETURN_D_M / 2 - 0.02
        a.box(front, (face, y, h / 2 + 0.02), (0.02, each - 0.015, h - 0.16), label="cabinet", item=30)
        a.box(metal, (face + 0.02, y, h - 0.14), (0.022, each * 0.4, 0.018), label="cabinet", item=30)
    a.tops.append(Top(x - _RETURN_D_M / 2, x + _RETURN_D_M / 2, d, d + run, h + 0.02))


@furniture("refrigerator", "corner", keep_free_m=0.6)
def any_refrigerator(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Low to tall, narrow to double, any finish, with grips, bars or nothing to hold; a door may stand open."""
    double = rng.uniform() < 0.25
    w, d = rng.uniform(0.8, 0.95) if double else rng.uniform(0.5, 0.75), rng.uniform(0.55, 0.72)
    h = rng.uniform(0.82, 1.3) if rng.uniform() < 0.2 and not double else rng.uniform(1.45, 2.05)
    body = palette.pick(rng, "steel", "steel", "dark", "dark", "metal", "ceramic", "lacquer", role="refrigerator")
    sides = body if rng.uniform() < 0.5 else palette.pick(rng, "dark", "metal", "ceramic")
    handle, grip = palette.pick(rng, "metal", "dark"), int(rng.integers(3))
    split = float(rng.choice((0.3, 0.4, 0.6, 0.7))) * h if h > 1.3 else h
    rows = [(0.06, split - 0.006), (split + 0.006, h - 0.006)] if h > 1.3 else [(0.06, h - 0.006)]
    opened = int(rng.integers(len(rows))) if rng.uniform() < 0.25 else -1
    _hollow(a, sides, palette.pick(rng, "ceramic", "paint"), (w, d, h), shelves=3 if opened >= 0 else 0)
    if opened >= 0:
        _goods(a, rng, palette, (w, d, h), 3)
    columns = 2 if double else 1
    each, first = w / columns, 1 if rng.uniform() < 0.5 else -1
    for row, (z0, z1) in enumerate(rows):
        for column in range(columns):
            hinge = first if not double else 2 * column - 1
            x = (column - (columns - 1) / 2) * each
            swing = rng.uniform(0.4, 1.7) if row == opened else 0.0
            _leaf(a, body, x, d + 0.004, z0, z1, each - 0.006, 0.055, hinge, swing)
            if grip and not swing:
                long = min(0.5, (z1 - z0) * 0.6) if grip == 1 else 0.12
                z = z1 - long / 2 - 0.06 if row == 0 else z0 + long / 2 + 0.06
                a.box(handle, (x - hinge * (each / 2 - 0.05), d + 0.08, z), (0.03, 0.03, long))
    for k in range(int(rng.integers(0, 6)) if opened < 0 and rng.uniform() < 0.4 else 0):
        wide, tall = rng.uniform(0.05, 0.2, 2)
        x, z = rng.uniform(-0.32, 0.32) * w, rng.uniform(0.55, 0.85) * h
        a.box(
            palette.pick(rng, "print", "paper"), (x, d + 0.063 + 0.002 * k, z), (wide, 0.004, tall),
            label="otherprop", item=10 + k,
        )  # fmt: skip


@furniture("cabinet", "wall", keep_free_m=0.3)
def open_cupboard(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A cupboard, low or tall, with shelves and things behind doors of which some stand open or have panes."""
    columns, each = int(rng.integers(1, 4)), rng.uniform(0.36, 0.55)
    w, d = columns * each, rng.uniform(0.35, 0.6)
    h = rng.uniform(0.75, 1.2) if rng.uniform() < 0.5 else rng.uniform(1.6, 2.1)
    body = palette.pick(rng, "wood", "paint", "lacquer", "dark", role="cabinet")
    front = body if rng.uniform() < 0.6 else palette.pick(rng, "wood", "paint", "lacquer", "metal")
    metal, shelves = palette.pick(rng, "metal", "dark"), max(1, round(h / rng.uniform(0.3, 0.5)) - 1)
    _hollow(a, body, body, (w, d, h), shelves)
    _goods(a, rng, palette, (w, d, h), shelves)
    panelled = rng.uniform() < 0.4
    for k in range(columns):
        hinge, x = (1 if k % 2 else -1), (k - (columns - 1) / 2) * each
        swing = rng.uniform(0.3, 1.9) if rng.uniform() < 0.4 else 0.0  # without any door it would be a bookshelf
        _leaf(a, front, x, d + 0.002, 0.05, h - 0.01, each - 0.01, 0.02, hinge, swing)
        if swing:
            continue
        if panelled:
            a.box(front, (x, d + 0.026, h / 2 + 0.02), (each - 0.16, 0.008, h - 0.26))
        a.box(metal, (x - hinge * (each / 2 - 0.05), d + 0.035, h * 0.55), (0.02, 0.025, 0.14))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h))


@furniture("table", "centre")
def any_table(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A table of any height from low to bar: thin or butcher's block, on legs, a column, panels or drawers."""
    low, high = ((0.45, 0.7), (0.7, 0.8), (0.8, 0.95), (0.8, 0.95), (0.95, 1.08))[int(rng.integers(5))]
    h = rng.uniform(low, high)
    w, d = rng.uniform(0.6, 2.0), rng.uniform(0.55, 1.05)
    thick = rng.uniform(0.018, 0.035) if rng.uniform() < 0.5 else rng.uniform(0.035, 0.09)
    top = palette.pick(rng, "wood", "wood", "wood", "paint", "lacquer", "stone", "metal", "dark", role="table")
    frame = top if rng.uniform() < 0.4 else palette.pick(rng, "wood", "metal", "dark", "paint")
    under, kind = h - thick, rng.uniform()
    a.box(top, (0, d / 2, h - thick / 2), (w, d, thick))
    if kind < 0.55:  # legs, sometimes with an apron, a board or drawers below
        leg = rng.uniform(0.025, 0.09)
        inset = rng.uniform(0.0, 0.12) * min(w, d)
        for x in (-1, 1):
            for y in (-1, 1):
                at = (x * (w / 2 - leg / 2 - inset), d / 2 + y * (d / 2 - leg / 2 - inset), under / 2)
                a.box(frame, at, (leg, leg, under))
        if rng.uniform() < 0.5:
            a.box(frame, (0, d / 2, under - 0.05), (w - 2 * (leg + inset), d - 2 * (leg + inset), 0.1))
        if rng.uniform() < 0.35:
            a.box(frame, (0, d / 2, 0.2), (w - 2 * (leg + inset), d - 2 * (leg + inset), 0.025))
        if rng.uniform() < 0.3:
            a.box(frame, (0, d - inset - 0.006, under - 0.09), (w * 0.4, 0.012, 0.13))
    elif kind < 0.7:  # a column
        a.cylinder(frame, (0, d / 2, under / 2 + 0.015), (0.1, 0.1, under - 0.03))
        a.cylinder(frame, (0, d / 2, 0.015), (min(w, d) * 0.7, min(w, d) * 0.7, 0.03))
    else:  # two panels, with a board between them
        for x in (-1, 1):
            a.box(frame, (x * (w / 2 - 0.04 - 0.06 * w), d / 2, under / 2), (0.04, d * 0.85, under))
        a.box(frame, (0, d / 2, under * 0.6), (w * 0.88 - 0.08, 0.025, under * 0.4))
    a.tops.append(Top(-w / 2, w / 2, 0, d, h))


@furniture("otherprop", "small")
def tray(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A flat tray or drawer insert with a rim and partitions, some with cutlery."""
    w, d, h = rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.36), rng.uniform(0.025, 0.07)
    material = palette.pick(rng, "ceramic", "object", "dark", "metal", "wood")
    a.box(material, (0, 0, 0.005), (w, d, 0.01))
    for side in (-1, 1):
        a.box(material, (side * (w / 2 - 0.005), 0, 0.01 + h / 2), (0.01, d, h))
        a.box(material, (0, side * (d / 2 - 0.005), 0.01 + h / 2), (w - 0.02, 0.01, h))
    cells = int(rng.integers(1, 4))
    for k in range(1, cells):
        a.box(material, (k * w / cells - w / 2, 0, 0.01 + h / 2), (0.008, d - 0.02, h * 0.95))
    for k in range(cells):
        if rng.uniform() < 0.6:
            x = (k + 0.5) * w / cells - w / 2
            a.box(palette.pick(rng, "metal", "dark", "object"), (x, 0, 0.02), (w / cells * 0.3, d * 0.7, 0.02))


@furniture("otherprop", "small")
def mixing_bowl(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A large bowl, sometimes with a spoon leaning in it."""
    w, h = rng.uniform(0.24, 0.42), rng.uniform(0.08, 0.17)
    inside = palette.pick(rng, "wood", "ceramic", "object", "metal")
    a.frustum(inside, (0, 0, h / 2), (w, w, h), tilt=np.pi)
    a.cylinder(palette.pick(rng, "dark", "wood", "object"), (0, 0, h + 0.001), (w * 0.9, w * 0.9, 0.002))
    if rng.uniform() < 0.5:
        a.box(palette.pick(rng, "wood", "metal"), (0.02, 0, h + 0.07), (0.03, 0.015, 0.24), tilt=rng.uniform(-0.9, 0.9))


@furniture("otherprop", "small")
def board(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A large chopping board, often of the table's own wood, with a knife or food on it."""
    w, d, h = rng.uniform(0.28, 0.5), rng.uniform(0.2, 0.34), rng.uniform(0.012, 0.04)
    a.box(palette.pick(rng, "wood", "wood", "object", "stone"), (0, 0, h / 2), (w, d, h))
    if rng.uniform() < 0.5:
        a.box(palette.pick(rng, "metal"), (0, d * 0.2, h + 0.003), (0.2, 0.035, 0.006))
        a.box(palette.pick(rng, "dark", "wood"), (0.15, d * 0.2, h + 0.008), (0.1, 0.025, 0.016))


@furniture("otherprop", "small")
def jug(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A jug with a handle and a wide rim."""
    w, h = rng.uniform(0.09, 0.14), rng.uniform(0.16, 0.28)
    material = palette.pick(rng, "ceramic", "metal", "object")
    a.ellipsoid(material, (0, 0, h * 0.35), (w, w, h * 0.7))
    a.frustum(material, (0, 0, h * 0.8), (w * 0.8, w * 0.8, h * 0.4), tilt=np.pi)
    a.box(material, (w * 0.5, 0, h * 0.6), (w * 0.3, 0.015, h * 0.45))


@furniture("otherprop", "small")
def odd_thing(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Nothing that has a name: one to five bodies of any shape, size and material, stacked or leaning."""
    z = 0.0
    for _ in range(int(rng.integers(1, 6))):
        w, d = 0.06 * 5 ** rng.uniform(0, 1, 2)
        h = 0.01 * 25 ** rng.uniform()
        add = (a.box, a.box, a.cylinder, a.ellipsoid, a.frustum, a.pillow)[int(rng.integers(6))]
        material = palette.pick(rng, "object", "print", "paper", "fabric", "dark", "metal", "ceramic", "books", "plant")
        shift = rng.uniform(-0.25, 0.25, 2) * (w, d)
        add(material, (float(shift[0]), float(shift[1]), z + h / 2), (w, d, h), yaw=rng.uniform(-1.6, 1.6))
        if rng.uniform() < 0.7:
            z += h


@furniture("window", "hang")
def any_window(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A ribbon, down to the floor, arched or round; by day, at night or frosted; many bars or none; often a blind."""
    form = ("square", "ribbon", "tall", "arched", "round")[int(rng.integers(5))]
    w = {"ribbon": rng.uniform(1.4, 2.4), "round": rng.uniform(0.5, 0.9)}.get(form, rng.uniform(0.45, 1.6))
    tall = {"ribbon": rng.uniform(0.4, 0.7), "tall": rng.uniform(1.7, 2.1), "round": w}.get(form, rng.uniform(0.7, 1.4))
    low = {"ribbon": rng.uniform(1.1, 1.6), "tall": 0.1}.get(form, rng.uniform(0.7, 1.1))
    lit = rng.uniform() < 0.4
    pane = palette.pick(rng, "daylight") if lit else palette.pick(rng, "dark", "screen", "wallpaint", "ceramic")
    frame, mid = palette.pick(rng, "paint", "wood", "metal", "dark"), low + tall / 2
    edge, deep = rng.uniform(0.03, 0.12), rng.uniform(0.02, 0.1)
    if form == "round":
        a.cylinder(frame, (0, deep / 2, mid), (w + 2 * edge, w + 2 * edge, deep), tilt=np.pi / 2)
        a.cylinder(pane, (0, deep / 2 + 0.004, mid), (w, w, deep), tilt=np.pi / 2, casts_shadow=False)
    else:
        if form == "arched":
            a.cylinder(frame, (0, deep / 2, low + tall), (w + 2 * edge, w + 2 * edge, deep - 0.004), tilt=np.pi / 2)
            a.cylinder(pane, (0, deep / 2 + 0.002, low + tall), (w, w, deep - 0.004), tilt=np.pi / 2)
        a.box(frame, (0, deep / 2, mid), (w + 2 * edge, deep, tall + 2 * edge))
        a.box(pane, (0, deep / 2 + 0.004, mid), (w, deep, tall), casts_shadow=False)
    bar = rng.uniform(0.015, 0.06)
    for k in range(int(rng.integers(0, 5))):
        a.box(
            frame, ((rng.uniform(-0.4, 0.4) if k > 3 else (k - 1) / 4) * w, deep + 0.01, mid), (bar, 0.02, tall * 0.98)
        )
    for k in range(int(rng.integers(0, 4))):
        a.box(frame, (0, deep + 0.009, low + tall * (k + 1) / 4), (w * 0.98, 0.018, bar))
    if lit:
        a.lamps.append((0, 0.35, mid))
    if rng.uniform() < 0.5 and form != "round":
        shut, cloth = tall * rng.uniform(0.2, 1.0), palette.pick(rng, "fabric", "paper", "wood", "metal", "paint")
        top, front = low + tall + edge, deep + 0.05
        if rng.uniform() < 0.5:  # one piece of cloth
            a.box(cloth, (0, front, top - shut / 2), (w + edge, 0.01, shut), label="curtain", item=1)
            return
        for k in range(slats := max(2, round(shut / 0.06))):
            at = (0.0, front, top - (k + 0.5) * shut / slats)
            a.box(cloth, at, (w + edge, 0.045, 0.006), label="curtain", item=1, tilt=rng.uniform(0.6, 0.7))


@furniture("door", "hang", keep_free_m=0.7)
def any_door(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """One leaf or two, of wood, metal or glass in a frame, panelled, slatted or sliding; knob, bar or plate."""
    leaves, h = 1 + int(rng.uniform() < 0.25), rng.uniform(1.9, 2.25)
    each = rng.uniform(0.65, 1.05) if leaves == 1 else rng.uniform(0.5, 0.75)
    leaf = palette.pick(rng, "wood", "paint", "metal", "dark", "lacquer", "steel", "ceramic", role="door")
    frame = leaf if rng.uniform() < 0.3 else palette.pick(rng, "wood", "paint", "metal", "dark")
    metal, style, w = palette.pick(rng, "metal", "dark"), int(rng.integers(5)), leaves * each
    edge = rng.uniform(0.03, 0.14)
    if style != 4:  # a sliding one has no frame but a rail
        a.box(frame, (0, 0.01, h / 2 + edge / 2), (w + 2 * edge, 0.02, h + edge))
    else:
        a.box(metal, (0, 0.06, h + 0.03), (w * 1.6, 0.03, 0.05))
    for k in range(leaves):
        x = (k - (leaves - 1) / 2) * each
        a.box(leaf, (x, 0.03, h / 2), (each - 0.01, 0.045, h - 0.01))
        if style == 0:
            glass = palette.pick(rng, "daylight", "dark", "screen", "ceramic")
            a.box(glass, (x, 0.033, h / 2 + 0.08), (each * 0.7, 0.046, h * 0.76))
        for z in np.arange(0.15, h - 0.15, 0.09) if style == 1 else ():
            a.box(leaf, (x, 0.055, float(z)), (each * 0.75, 0.02, 0.05), tilt=0.5)
        for z in np.linspace(0.1, 0.9, int(rng.integers(2, 6))) if style in (2, 4) else ():
            a.box(frame, (x, 0.056, float(z) * h), (each * 0.85, 0.012, 0.08))
        side = 1 if k == 0 else -1
        size = ((0.05, 0.06, 0.05), (0.03, 0.05, 0.35), (0.12, 0.03, 0.2))[int(rng.integers(3))]
        a.box(metal, (x + side * (each / 2 - 0.09), 0.07, 1.0), size)


@furniture("picture", "hang")
def any_picture(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A canvas without a frame, a poster, two or three of a kind, or a round one."""
    count, z = int(rng.choice((1, 1, 1, 2, 3))), rng.uniform(1.3, 1.8)
    w, tall = rng.uniform(0.15, 1.2) / count**0.5, rng.uniform(0.15, 1.1)
    deep = rng.choice((0.004, 0.015, 0.04))
    for k in range(count):
        sight = palette.pick(rng, "print", "paper", "fabric", "object", "screen", "plant", role="picture")
        x = (k - (count - 1) / 2) * (w + 0.05)
        if rng.uniform() < 0.15:
            a.cylinder(sight, (x, deep / 2, z), (w, w, deep), tilt=np.pi / 2)
            continue
        a.box(sight, (x, deep / 2, z), (w, deep, tall))
        for _ in range(int(rng.integers(0, 5))):  # what it shows
            part = (rng.uniform(0.1, 0.6) * w, deep + 0.002, rng.uniform(0.1, 0.6) * tall)
            at = (
                x + rng.uniform(-0.5, 0.5) * (w - part[0]),
                part[1] / 2,
                z + rng.uniform(-0.5, 0.5) * (tall - part[2]),
            )
            a.box(palette.pick(rng, "print", "object", "paper", "plant", "dark", "daylight"), at, part)


@furniture("counter", "wall", keep_free_m=0.6)
def any_counter(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A worktop on legs, drawers, panels, curtains or shelves, with a sink or none."""
    w, d, h = rng.uniform(0.9, 3.0), rng.uniform(0.45, 0.8), rng.uniform(0.82, 1.12)
    thick, kind = rng.uniform(0.02, 0.1), int(rng.integers(5))
    top = palette.pick(rng, "stone", "tile", "wood", "dark", "paint", "steel", "metal", "ceramic", role="counter")
    body = palette.pick(rng, "wood", "paint", "lacquer", "metal", "steel", "dark", "tile", role="cabinet")
    metal, under = palette.pick(rng, "metal", "dark"), h - thick
    a.box(top, (0, d / 2, h - thick / 2), (w, d, thick))
    if rng.uniform() < 0.4:
        a.box(top, (0, 0.01, h + 0.08), (w, 0.02, 0.16))
    if kind in (0, 1):  # open: legs and one or two boards
        for x in (-1, 1):
            for y in (0.05, d - 0.05):
                a.box(metal, (x * (w / 2 - 0.05), y, under / 2), (0.05, 0.05, under))
        for z in (0.15, 0.5)[: kind + 1]:
            a.box(body, (0, d / 2, z), (w - 0.02, d - 0.06, 0.03))
            for x in np.arange(-w / 2 + 0.25, w / 2 - 0.2, 0.45):
                if rng.uniform() < 0.6:
                    add = (a.box, a.cylinder, a.pillow)[int(rng.integers(3))]
                    size = (rng.uniform(0.12, 0.35), rng.uniform(0.12, 0.35), rng.uniform(0.06, 0.28))
                    thing = palette.pick(rng, "object", "metal", "ceramic", "fabric", "paper")
                    add(
                        thing,
                        (float(x), d / 2, z + 0.015 + size[2] / 2),
                        size,
                        label="otherprop",
                        item=40 + round(9 * x),
                    )
    else:
        inset = rng.uniform(0.0, 0.15) if kind == 4 else 0.03
        a.box(body, (0, (d - inset) / 2, under / 2), (w - 0.01, d - inset, under), label="cabinet", item=1)
        columns = max(1, round(w / rng.uniform(0.35, 0.9)))
        rows = 1 if kind == 4 else int(rng.integers(1, 5))
        for column in range(columns if kind != 4 or rng.uniform() < 0.5 else 0):
            for row in range(rows):
                each, high = w / columns, (under - 0.1) / rows
                at = ((column + 0.5) * each - w / 2, d - inset + 0.006, 0.1 + (row + 0.5) * high)
                front = palette.pick(rng, "fabric", role="curtain") if kind == 3 and rows == 1 else body
                a.box(front, at, (each - 0.02, 0.016, high - 0.02), label="cabinet", item=1)
                a.box(metal, (at[0], at[1] + 0.02, at[2] + high * 0.3), (0.1, 0.02, 0.015), label="cabinet", item=1)
    if rng.uniform() < 0.5:  # a sink that stands on it or lies in it
        x, bowl = rng.uniform(-0.3, 0.3) * (w - 0.5), palette.pick(rng, "metal", "ceramic", "steel", "stone")
        size = (rng.uniform(0.35, 0.6), min(d - 0.14, 0.45), rng.uniform(0.01, 0.16))
        (a.box, a.pillow, a.cylinder)[int(rng.integers(3))](
            bowl, (x, d / 2 + 0.04, h + size[2] / 2), size, label="sink"
        )
        a.box(metal, (x, 0.06, h + 0.14), (0.03, 0.03, 0.28), label="sink")
        a.box(metal, (x, 0.14, h + 0.27), (0.025, 0.16, 0.025), label="sink")
    else:
        a.tops.append(Top(-w / 2, w / 2, 0.03, d, h))


@furniture("bathtub", "corner", keep_free_m=0.4)
def any_bathtub(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A full tub: oval and free on feet, square in a tiled step, or short and deep, of any colour."""
    w, d, h = rng.uniform(1.0, 1.9), rng.uniform(0.65, 1.1), rng.uniform(0.4, 0.8)
    shell = palette.pick(rng, "ceramic", "ceramic", "lacquer", "dark", "metal", "stone")
    inside, metal = palette.pick(rng, "ceramic", "ceramic", "tile", "metal"), palette.pick(rng, "metal", "dark")
    if rng.uniform() < 0.5:
        a.frustum(shell, (0, d / 2, h / 2 + 0.04), (w, d, h - 0.08), tilt=np.pi)
        a.torus(shell, (0, d / 2, h - 0.02), (w, d, 0.08))
        a.cylinder(inside, (0, d / 2, h - 0.06), (w * 0.86, d * 0.82, 0.03))
        for x in (-1, 1):
            a.ellipsoid(metal, (x * w * 0.3, d / 2, 0.05), (0.1, d * 0.5, 0.1))
    else:
        step = palette.pick(rng, "tile", "wood", "stone", "paint")
        rim = rng.uniform(0.05, 0.2)
        a.box(step, (0, d / 2, h / 2 - 0.02), (w, d, h - 0.04))
        for x in (-1, 1):
            a.box(shell, (x * (w - rim) / 2, d / 2, h - 0.01), (rim, d, 0.06))
        for y in (rim / 2, d - rim / 2):
            a.box(shell, (0, y, h - 0.01), (w - 2 * rim, rim, 0.058))
        a.pillow(inside, (0, d / 2, h - 0.05), (w - 2 * rim, d - 2 * rim, 0.05))
    x = rng.uniform(-0.4, 0.4) * w
    a.cylinder(metal, (x, 0.04, h + 0.12), (0.04, 0.04, 0.3))
    a.box(metal, (x, 0.12, h + 0.25), (0.03, 0.18, 0.03))


@furniture("toilet", "wall", keep_free_m=0.4)
def any_toilet(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """On the wall, on the floor or under a tank high up; round or square, of any colour."""
    body = palette.pick(rng, "ceramic", "ceramic", "ceramic", "lacquer", "dark")
    seat, metal = palette.pick(rng, "ceramic", "wood", "dark", "lacquer"), palette.pick(rng, "metal", "dark", "ceramic")
    w, long, h = rng.uniform(0.32, 0.42), rng.uniform(0.44, 0.6), rng.uniform(0.36, 0.48)
    add = a.pillow if rng.uniform() < 0.4 else a.cylinder
    bottom, y = (rng.uniform(0.08, 0.2), long / 2) if rng.uniform() < 0.4 else (0.0, long / 2 + 0.05)
    a.frustum(body, (0, y, (h + bottom) / 2), (w, long, h - bottom), tilt=np.pi)
    add(seat, (0, y, h + 0.02), (w + 0.02, long + 0.02, 0.045))
    if rng.uniform() < 0.4:
        add(seat, (0, 0.05, h + long / 2), (w, long, 0.03), tilt=np.pi / 2 + 0.1)
    tank = int(rng.integers(3))
    if tank == 0:  # in the wall: a plate to press
        a.box(metal, (0, 0.008, rng.uniform(0.85, 1.1)), (0.24, 0.016, 0.16))
    elif tank == 1:
        a.pillow(body, (0, 0.1, h + 0.24), (rng.uniform(0.32, 0.5), 0.19, rng.uniform(0.3, 0.44)))
    else:
        a.box(body, (0, 0.09, 1.75), (0.45, 0.17, 0.28))
        a.cylinder(metal, (0, 0.06, 1.0), (0.04, 0.04, 1.25))


@furniture("sink", "wall", keep_free_m=0.5)
def any_basin(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A bowl on a board, a trough, or a round basin on the wall or on legs; mirrors are for others."""
    w, d, h = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.5), rng.uniform(0.72, 0.95)
    bowl, metal = (
        palette.pick(rng, "ceramic", "ceramic", "metal", "stone", "lacquer"),
        palette.pick(rng, "metal", "dark"),
    )
    deep, kind = rng.uniform(0.08, 0.2), int(rng.integers(4))
    if kind == 0:
        wide = w + rng.uniform(0.1, 0.5)
        board = palette.pick(rng, "wood", "stone", "paint")
        a.box(board, (0, d / 2 + 0.03, h - deep - 0.025), (wide, d + 0.06, 0.05), label="counter", item=1)
        a.frustum(bowl, (0, d / 2 + 0.03, h - deep / 2), (min(w, 0.5), d, deep), tilt=np.pi)
    elif kind == 1:
        a.box(bowl, (0, d / 2, h - deep / 2), (w, d, deep))
        a.box(palette.pick(rng, "dark", "metal", "ceramic"), (0, d / 2 + 0.03, h), (w - 0.08, d - 0.14, 0.006))
    elif kind == 2:
        a.ellipsoid(bowl, (0, d / 2, h - deep / 2), (min(w, 0.6), d, deep * 1.6))
        a.cylinder(metal, (0, d / 2 - 0.05, (h - deep) / 2), (0.06, 0.06, h - deep))
    else:
        a.pillow(bowl, (0, d / 2, h - deep / 2), (w, d, deep))
        for x in (-1, 1):
            a.cylinder(metal, (x * (w / 2 - 0.04), d - 0.06, (h - deep) / 2), (0.035, 0.035, h - deep))
    reach = rng.uniform(0.08, 0.2)
    a.cylinder(metal, (0, 0.05, h + 0.08), (0.03, 0.03, rng.uniform(0.12, 0.3)))
    a.box(metal, (0, 0.05 + reach / 2, h + 0.15), (0.025, reach, 0.025))


def _hollow(a: Assembly, outside: int, inside: int, size: tuple[float, float, float], shelves: int) -> None:
    """A carcass open towards y, with shelves; a solid one without any."""
    w, d, h = size
    if not shelves:
        a.box(outside, (0, d / 2, h / 2), (w, d, h))
        return
    for x in (-1, 1):
        a.box(outside, (x * (w / 2 - 0.012), d / 2, h / 2), (0.024, d, h))
    for z in (0.025, h - 0.012):
        a.box(outside, (0, d / 2, z), (w - 0.048, d, 0.05 if z < 0.1 else 0.024))
    a.box(inside, (0, 0.01, h / 2), (w - 0.048, 0.02, h - 0.05))
    for k in range(shelves):
        a.box(inside, (0, d / 2, (k + 1) * h / (shelves + 1)), (w - 0.05, d - 0.04, 0.018))


def _goods(
    a: Assembly, rng: np.random.Generator, palette: Palette, size: tuple[float, float, float], shelves: int
) -> None:
    """Things on the shelves of ``_hollow``."""
    w, d, h = size
    pitch = h / (shelves + 1)
    for k in range(shelves + 1):
        floor = 0.05 if k == 0 else k * pitch + 0.009
        for side in (-0.25, 0.25):
            if rng.uniform() < 0.55:
                wide, tall = rng.uniform(0.15, 0.42) * w, rng.uniform(0.3, 0.75) * (pitch - 0.07)
                add = (a.box, a.cylinder, a.pillow)[int(rng.integers(3))]
                thing = palette.pick(rng, "object", "ceramic", "fabric", "paper", "metal")
                center = (side * (w - 0.06), d * rng.uniform(0.4, 0.55), floor + tall / 2)
                add(thing, center, (wide, d * 0.6, tall), label="otherprop", item=60 + 2 * k + int(side > 0))


def _leaf(
    a: Assembly, material: int, x: float, y: float, z0: float, z1: float, w: float, thick: float, hinge: int,
    swing: float,
) -> None:  # fmt: skip
    """A door leaf before an opening of width ``w`` about ``x``; hinged at its ``hinge`` side, open by ``swing``."""
    arm = np.array([-hinge * w / 2, thick / 2])  # from the hinge to the middle of the leaf
    yaw = -hinge * swing
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    at_x, at_y = x + hinge * w / 2 + c * arm[0] - s * arm[1], y + s * arm[0] + c * arm[1]
    a.box(material, (at_x, at_y, (z0 + z1) / 2), (w, thick, z1 - z0), yaw=yaw)
