"""Small things that lie about: on tables, counters, sills and the floor."""

from __future__ import annotations

import numpy as np

from semantic_mapper.scenes.furniture.registry import furniture
from semantic_mapper.scenes.materials import Palette
from semantic_mapper.scenes.primitives import Assembly


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
        a.box(palette.pick(rng, "fabric"), (0, 0, 0.025 + 0.05 * k), (0.3, 0.22, 0.048 if k else 0.05))


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
    a.box(cloth, (0, 0.15, h * 0.4), (w, d, h * 0.8))
    a.ellipsoid(cloth, (0, 0.15, h * 0.8), (w, d, h * 0.4))
    a.box(palette.pick(rng, "fabric", "object"), (0, 0.15 + d / 2 + 0.02, h * 0.32), (w * 0.7, 0.05, h * 0.4))


@furniture("otherprop", "centre")
def ball(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A toy ball."""
    w = rng.uniform(0.16, 0.3)
    a.ellipsoid(palette.pick(rng, "print", "object"), (0, 0.2, w / 2), (w, w, w))
