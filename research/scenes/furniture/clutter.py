"""Small things that lie about: on tables, counters, sills and the floor."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly


@furniture("otherprop", "small")
def cup(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A mug with a handle, or a glass that widens upwards."""
    w, h = rng.uniform(0.07, 0.1), rng.uniform(0.08, 0.13)
    material = palette.pick(rng, "object", "ceramic")
    if rng.uniform() < 0.5:
        a.cylinder(material, (0, 0, h / 2), (w, w, h))
        a.box(material, (w / 2 + 0.012, 0, h / 2), (0.024, 0.012, h * 0.6))
    else:
        a.frustum(material, (0, 0, h / 2), (w, w, h), tilt=np.pi)


@furniture("otherprop", "small")
def bottle(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Body, shoulder and neck."""
    w, h = rng.uniform(0.07, 0.1), rng.uniform(0.18, 0.3)
    material = palette.pick(rng, "object", "dark", "plant")
    a.cylinder(material, (0, 0, h * 0.3), (w, w, h * 0.6))
    a.frustum(material, (0, 0, h * 0.68), (w, w, h * 0.16))
    a.cylinder(material, (0, 0, h * 0.86), (w * 0.4, w * 0.4, h * 0.28))


@furniture("otherprop", "small")
def bowl(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A bowl of fruit."""
    w = rng.uniform(0.2, 0.28)
    a.frustum(palette.pick(rng, "ceramic", "wood", "object"), (0, 0, 0.035), (w, w, 0.07), tilt=np.pi)
    for k in range(3):
        angle = 2.1 * k
        center = (0.06 * float(np.cos(angle)), 0.06 * float(np.sin(angle)), 0.085)
        a.ellipsoid(palette.pick(rng, "object"), center, (0.085, 0.085, 0.08))


@furniture("otherprop", "small")
def book_pile(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Two to four books lying on each other."""
    z = 0.0
    for _ in range(int(rng.integers(2, 5))):
        h = rng.uniform(0.02, 0.045)
        size = (rng.uniform(0.18, 0.24), rng.uniform(0.14, 0.18), h)
        a.box(palette.pick(rng, "object", "print", "fabric"), (0, 0, z + h / 2), size, yaw=rng.uniform(-0.4, 0.4))
        z += h


@furniture("otherprop", "small")
def vase(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A vase with a bunch."""
    h = rng.uniform(0.16, 0.26)
    a.ellipsoid(palette.pick(rng, "object", "ceramic"), (0, 0, h * 0.5), (0.12, 0.12, h))
    a.ellipsoid(palette.pick(rng, "plant", "print"), (0, 0, h * 1.3), (0.2, 0.2, h * 0.8))


@furniture("otherprop", "small")
def potted_plant(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A small plant in a pot."""
    w, leaf = rng.uniform(0.1, 0.15), palette.pick(rng, "plant")
    a.frustum(palette.pick(rng, "object", "ceramic", "wood"), (0, 0, 0.055), (w, w, 0.11), tilt=np.pi)
    for k in range(3):
        angle = 2.1 * k + rng.uniform()
        center = (0.035 * float(np.cos(angle)), 0.035 * float(np.sin(angle)), 0.17 + 0.03 * k)
        a.ellipsoid(leaf, center, (0.1, 0.1, 0.15))


@furniture("otherprop", "small")
def small_box(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A packet, a radio, a tin."""
    size = (rng.uniform(0.1, 0.28), rng.uniform(0.08, 0.18), rng.uniform(0.06, 0.22))
    a.box(palette.pick(rng, "object", "dark", "print"), (0, 0, size[2] / 2), size, yaw=rng.uniform(-0.3, 0.3))


@furniture("otherprop", "small")
def laptop(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Keyboard and a screen that leans back."""
    w, d = rng.uniform(0.3, 0.37), rng.uniform(0.21, 0.25)
    body, screen = palette.pick(rng, "dark", "metal"), palette.pick(rng, "screen", "dark", "print")
    lean = rng.uniform(0.15, 0.4)
    a.box(body, (0, 0.05, 0.009), (w, d, 0.018))
    rise = d / 2 * float(np.cos(lean))
    back = 0.05 - d / 2 - d / 2 * float(np.sin(lean))
    a.box(body, (0, back, 0.018 + rise), (w, 0.012, d), tilt=lean)
    a.box(screen, (0, back + 0.008, 0.018 + rise), (w - 0.03, 0.006, d - 0.04), tilt=lean)


@furniture("otherprop", "small")
def magazines(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """One to four magazines and sheets, fanned out flat."""
    for k in range(int(rng.integers(1, 5))):
        size = (rng.uniform(0.15, 0.22), rng.uniform(0.2, 0.3), 0.006)
        center = (rng.uniform(-0.07, 0.07), rng.uniform(-0.05, 0.05), 0.003 + 0.006 * k)
        a.box(palette.pick(rng, "paper", "paper", "print"), center, size, yaw=rng.uniform(-0.8, 0.8))


@furniture("otherprop", "small")
def open_book(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Two pages that rise towards the outside."""
    w, d, paper = rng.uniform(0.13, 0.2), rng.uniform(0.19, 0.28), palette.pick(rng, "paper")
    a.box(palette.pick(rng, "object", "dark"), (0, 0, 0.004), (2 * w + 0.02, d + 0.01, 0.008))
    for x in (-1, 1):
        a.box(paper, (x * w / 2, 0, 0.013), (w - 0.004, d, 0.018))


@furniture("otherprop", "small")
def standing_books(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A row of upright books, each of its own size, the last one leaning."""
    x = 0.0
    for _ in range(int(rng.integers(2, 8))):
        w, d, h = rng.uniform(0.012, 0.05), rng.uniform(0.12, 0.2), rng.uniform(0.17, 0.29)
        a.box(palette.pick(rng, "object", "paper", "print", "fabric"), (x + w / 2, 0, h / 2), (w, d, h))
        x += w + 0.001


@furniture("otherprop", "small")
def leaflet(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A sheet, brochure or open book that stands and leans back."""
    w, h, lean = rng.uniform(0.12, 0.24), rng.uniform(0.16, 0.3), rng.uniform(0.1, 0.4)
    thick = rng.uniform(0.006, 0.025)
    z = (h * float(np.cos(lean)) + thick * float(np.sin(lean))) / 2
    a.box(palette.pick(rng, "paper", "paper", "print"), (0, 0, z), (w, thick, h), tilt=lean)
    if rng.uniform() < 0.3:  # the shelf of a stand
        a.box(palette.pick(rng, "metal", "wood", "dark"), (0, 0.02, 0.01), (w, 0.1, 0.02))


@furniture("otherprop", "small")
def cutting_board(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A board with something on it, or a tray with things."""
    w, d = rng.uniform(0.26, 0.46), rng.uniform(0.2, 0.32)
    a.box(palette.pick(rng, "wood", "wood", "object", "metal"), (0, 0, 0.01), (w, d, 0.02))
    for _ in range(int(rng.integers(0, 4))):
        x, y, side = rng.uniform(-0.3, 0.3) * w, rng.uniform(-0.25, 0.25) * d, rng.uniform(0.05, 0.11)
        tall = rng.uniform(0.03, 0.12)
        add = (a.box, a.cylinder, a.ellipsoid, a.frustum)[int(rng.integers(4))]
        add(palette.pick(rng, "object", "ceramic", "plant"), (x, y, 0.02 + tall / 2), (side, side, tall))


@furniture("otherprop", "small")
def packets(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Cereal boxes, cartons, tins and jars in a row."""
    x = 0.0
    for _ in range(int(rng.integers(2, 6))):
        w, d, h = rng.uniform(0.05, 0.16), rng.uniform(0.05, 0.1), rng.uniform(0.08, 0.3)
        material = palette.pick(rng, "object", "object", "print", "paper", "metal")
        if rng.uniform() < 0.55:
            a.box(material, (x + w / 2, 0, h / 2), (w, d, h), yaw=rng.uniform(-0.15, 0.15))
        else:
            a.cylinder(material, (x + w / 2, 0, h * 0.4), (w, w, h * 0.8))
            a.cylinder(palette.pick(rng, "metal", "object"), (x + w / 2, 0, h * 0.82), (w * 0.9, w * 0.9, h * 0.06))
        x += w + 0.02


@furniture("otherprop", "small")
def coffee_machine(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Foot, column, head over a pot."""
    w, d, h = rng.uniform(0.16, 0.26), rng.uniform(0.22, 0.32), rng.uniform(0.26, 0.38)
    body, pot = palette.pick(rng, "dark", "metal", "lacquer", "paint"), palette.pick(rng, "dark", "ceramic", "metal")
    a.box(body, (0, 0, 0.02), (w, d, 0.04))
    a.box(body, (0, -d * 0.3, h / 2), (w, d * 0.4, h))
    a.box(body, (0, 0, h - 0.045), (w - 0.004, d, 0.09))
    a.cylinder(pot, (0, d * 0.18, 0.04 + h * 0.22), (w * 0.6, w * 0.6, h * 0.42))


@furniture("otherprop", "small")
def toaster(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A rounded body with two slots."""
    w, d, h = rng.uniform(0.26, 0.34), rng.uniform(0.16, 0.2), rng.uniform(0.17, 0.21)
    body, dark = palette.pick(rng, "metal", "steel", "lacquer", "paint"), palette.pick(rng, "dark")
    a.box(body, (0, 0, h * 0.45), (w, d, h * 0.9))
    a.cylinder(body, (0, 0, h * 0.86), (d, h * 0.28, w), yaw=np.pi / 2, tilt=np.pi / 2)
    for y in (-0.03, 0.03):
        a.box(dark, (0, y, h), (w * 0.75, 0.024, 0.006))
    a.box(dark, (w / 2 + 0.012, 0, h * 0.6), (0.024, 0.04, 0.02))


@furniture("otherprop", "small")
def cable(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A cable that lies in bends, with a plug or a phone at its end."""
    material, x, y, angle = palette.pick(rng, "dark", "paint"), 0.0, 0.0, rng.uniform(0, 6.3)
    for _ in range(int(rng.integers(3, 7))):
        long = rng.uniform(0.05, 0.12)
        dx, dy = long * float(np.cos(angle)), long * float(np.sin(angle))
        a.box(material, (x + dx / 2, y + dy / 2, 0.004), (long + 0.006, 0.008, 0.008), yaw=angle)
        x, y, angle = x + dx, y + dy, angle + rng.uniform(-1.1, 1.1)
    a.box(palette.pick(rng, "dark", "screen", "object"), (x, y, 0.006), (0.075, 0.15, 0.012), yaw=angle)


@furniture("otherprop", "small")
def utensils(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A jar with spoons, pens or brushes."""
    w, h = rng.uniform(0.08, 0.13), rng.uniform(0.1, 0.16)
    a.cylinder(palette.pick(rng, "object", "ceramic", "metal"), (0, 0, h / 2), (w, w, h))
    for _ in range(int(rng.integers(2, 6))):
        x, y, long = rng.uniform(-0.3, 0.3) * w, rng.uniform(-0.3, 0.3) * w, rng.uniform(0.1, 0.2)
        lean = rng.uniform(-0.25, 0.25)
        a.box(palette.pick(rng, "wood", "metal", "object"), (x, y, h + long * 0.3), (0.014, 0.01, long), tilt=lean)


@furniture("otherprop", "small")
def tableware(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A plate with food or cutlery, sometimes a glass beside it."""
    w, plate = rng.uniform(0.18, 0.27), palette.pick(rng, "ceramic", "ceramic", "object")
    a.frustum(plate, (0, 0, 0.01), (w, w, 0.02), tilt=np.pi)
    for _ in range(int(rng.integers(0, 3))):
        x, y, side = rng.uniform(-0.2, 0.2) * w, rng.uniform(-0.2, 0.2) * w, rng.uniform(0.04, 0.09)
        a.ellipsoid(palette.pick(rng, "object", "plant", "wood"), (x, y, 0.03), (side, side, 0.05))
    for x in (-1, 1):
        a.box(palette.pick(rng, "metal"), (x * (w / 2 + 0.025), 0, 0.003), (0.016, 0.18, 0.006))
    if rng.uniform() < 0.5:
        glass = palette.pick(rng, "ceramic", "object", "daylight")
        a.frustum(glass, (w / 2 + 0.02, w / 2 + 0.02, 0.06), (0.07, 0.07, 0.12), tilt=np.pi)


@furniture("otherprop", "small")
def paper_pile(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Sheets, a little askew."""
    for k in range(int(rng.integers(2, 4))):
        paper = palette.pick(rng, "paint", "wallpaint", "print")
        a.box(paper, (0, 0, 0.004 + 0.008 * k), (0.21, 0.297, 0.008), yaw=rng.uniform(-0.3, 0.3))


@furniture("otherprop", "small")
def kettle(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Body, lid, handle, spout."""
    body, dark = palette.pick(rng, "metal", "object", "paint"), palette.pick(rng, "dark")
    h = rng.uniform(0.17, 0.22)
    a.frustum(body, (0, 0, h / 2), (0.17, 0.17, h))
    a.ellipsoid(dark, (0, 0, h), (0.11, 0.11, 0.05))
    a.box(dark, (0.1, 0, h * 0.6), (0.025, 0.025, h * 0.7))
    a.box(dark, (0.08, 0, h * 0.94), (0.06, 0.025, 0.025))
    a.ellipsoid(body, (-0.08, 0, h * 0.75), (0.09, 0.05, 0.05))


@furniture("otherprop", "small")
def pan(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A pot or pan with a handle and sometimes a lid."""
    w, h = rng.uniform(0.18, 0.28), rng.uniform(0.05, 0.16)
    body, dark = palette.pick(rng, "metal", "dark", "object"), palette.pick(rng, "dark")
    a.cylinder(body, (0, 0, h / 2), (w, w, h))
    a.box(dark, (w / 2 + 0.06, 0, h - 0.02), (0.12, 0.025, 0.018))
    if rng.uniform() < 0.5:
        a.ellipsoid(body, (0, 0, h), (w, w, 0.04))
        a.ellipsoid(dark, (0, 0, h + 0.025), (0.04, 0.04, 0.03))


@furniture("otherprop", "small")
def microwave(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A box with a dark door and a panel."""
    w, d, h = rng.uniform(0.42, 0.5), rng.uniform(0.3, 0.36), rng.uniform(0.24, 0.29)
    body, dark = palette.pick(rng, "paint", "metal", "dark"), palette.pick(rng, "dark")
    a.box(body, (0, 0, h / 2), (w, d, h))
    a.box(dark, (-0.06, d / 2 + 0.006, h / 2), (w - 0.16, 0.012, h - 0.04))
    a.box(palette.pick(rng, "metal", "screen"), (w / 2 - 0.06, d / 2 + 0.005, h * 0.7), (0.08, 0.01, 0.05))


@furniture("otherprop", "small")
def dish_rack(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Plates standing in a rack."""
    wire, plate = palette.pick(rng, "metal", "object"), palette.pick(rng, "ceramic", "object")
    a.box(wire, (0, 0, 0.015), (0.36, 0.28, 0.03))
    for k in range(int(rng.integers(2, 5))):
        a.cylinder(plate, (-0.12 + 0.07 * k, 0, 0.14), (0.22, 0.22, 0.016), yaw=np.pi / 2, tilt=np.pi / 2)


@furniture("otherprop", "small")
def soap_set(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A dispenser and a tumbler with brushes."""
    a.cylinder(palette.pick(rng, "object", "ceramic"), (-0.06, 0, 0.065), (0.06, 0.06, 0.13))
    a.box(palette.pick(rng, "metal"), (-0.06, 0.015, 0.15), (0.015, 0.05, 0.03))
    a.frustum(palette.pick(rng, "object", "ceramic"), (0.05, 0, 0.05), (0.075, 0.075, 0.1), tilt=np.pi)
    for k in (-1, 1):
        a.box(palette.pick(rng, "object"), (0.05 + 0.015 * k, 0, 0.11), (0.01, 0.012, 0.16))


@furniture("otherprop", "small")
def folded_towels(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A pile of folded towels."""
    for k in range(int(rng.integers(2, 5))):
        a.pillow(palette.pick(rng, "fabric"), (0, 0, 0.03 + 0.05 * k), (0.31, 0.23, 0.06))


@furniture("picture", "small")
def photo_frame(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A framed photograph that leans back on its stand."""
    w, h = rng.uniform(0.12, 0.26), rng.uniform(0.15, 0.28)
    frame, sight = palette.pick(rng, "wood", "dark", "metal"), palette.pick(rng, "print", role="picture")
    lean = 0.2
    z = h / 2 * float(np.cos(lean)) + 0.01 * float(np.sin(lean))
    a.box(frame, (0, 0, z), (w, 0.02, h), tilt=lean)
    a.box(sight, (0, 0.007, z), (w - 0.04, 0.016, h - 0.04), tilt=lean)


@furniture("otherprop", "centre")
def shoes(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A pair."""
    leather = palette.pick(rng, "object", "dark")
    for x in (-0.07, 0.07):
        turn = rng.uniform(-0.3, 0.3)
        a.box(leather, (x, 0.15, 0.02), (0.09, 0.27, 0.04), yaw=turn)
        a.ellipsoid(leather, (x, 0.11, 0.06), (0.085, 0.15, 0.09), yaw=turn)


@furniture("otherprop", "corner")
def basket(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A laundry basket, sometimes overflowing."""
    w, h = rng.uniform(0.34, 0.46), rng.uniform(0.35, 0.6)
    a.frustum(palette.pick(rng, "fabric", "wood", "object"), (0, 0.24, h / 2), (w, w, h), tilt=np.pi)
    if rng.uniform() < 0.6:
        a.ellipsoid(palette.pick(rng, "fabric"), (0, 0.24, h), (w * 0.9, w * 0.85, 0.2))


@furniture("otherprop", "centre")
def bag(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A rucksack or handbag on the floor."""
    w, d, h = rng.uniform(0.25, 0.38), rng.uniform(0.14, 0.22), rng.uniform(0.26, 0.42)
    cloth = palette.pick(rng, "fabric", "object", "dark")
    a.pillow(cloth, (0, 0.15, h * 0.42), (w, d, h * 0.84))
    a.ellipsoid(cloth, (0, 0.15, h * 0.8), (w, d, h * 0.4))
    a.box(palette.pick(rng, "fabric", "object"), (0, 0.15 + d / 2 + 0.02, h * 0.32), (w * 0.7, 0.05, h * 0.4))


@furniture("otherprop", "centre")
def ball(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A toy ball."""
    w = rng.uniform(0.16, 0.3)
    a.ellipsoid(palette.pick(rng, "print", "object"), (0, 0.2, w / 2), (w, w, w))
