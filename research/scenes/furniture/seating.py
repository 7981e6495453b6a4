"""Beds, sofas, chairs."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly


@furniture("bed", "wall", keep_free_m=0.3)
def bed(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Frame, mattress, duvet, headboard, pillows."""
    w, d = rng.uniform(0.9, 1.8), rng.uniform(1.9, 2.1)
    frame, sheet, duvet = (palette.pick(rng, "wood", "paint"), palette.pick(rng, "fabric"), palette.pick(rng, "fabric"))
    low = rng.uniform(0.22, 0.35)
    a.box(frame, (0, d / 2, low - 0.1), (w, d, 0.14))
    for x in (-1, 1):
        for y in (0.08, d - 0.08):
            a.box(frame, (x * (w / 2 - 0.06), y, (low - 0.17) / 2), (0.07, 0.07, low - 0.17))
    a.pillow(sheet, (0, d / 2 + 0.01, low + 0.07), (w - 0.05, d - 0.07, 0.22))
    cover = d * rng.uniform(0.55, 0.72)
    a.box(duvet, (0, d - cover / 2, low + 0.11), (w - 0.04, cover, 0.16))
    for x in (-1, 1):  # rounded edges
        a.cylinder(duvet, (x * (w / 2 - 0.04), d - cover / 2, low + 0.11), (0.1, 0.16, cover - 0.002), tilt=np.pi / 2)
    a.pillow(duvet, (0, d - cover / 2, low + 0.18), (w * 0.98, cover * 0.98, rng.uniform(0.08, 0.2)))
    if rng.uniform() < 0.4:  # crumpled
        for _ in range(3):
            x, y = rng.uniform(-0.3, 0.3) * w, d - cover * rng.uniform(0.2, 0.9)
            size = (rng.uniform(0.3, 0.5) * w, rng.uniform(0.15, 0.4), rng.uniform(0.06, 0.14))
            a.ellipsoid(duvet, (x, y, low + 0.24), size, yaw=rng.uniform(-0.6, 0.6))
    if rng.uniform() < 0.35:
        a.box(palette.pick(rng, "fabric"), (0, d - cover * 0.22, low + 0.135), (w + 0.03, cover * 0.4, 0.22))
    _headboard(a, rng, frame, palette.pick(rng, "fabric"), w)
    pillow = palette.pick(rng, "fabric", "print", role="cushion")
    for k in range(1 if w < 1.3 else 2):
        x = 0.0 if w < 1.3 else (k - 0.5) * w * 0.5
        size = (rng.uniform(0.5, 0.7), rng.uniform(0.36, 0.46), rng.uniform(0.13, 0.22))
        a.pillow(pillow, (x, 0.3, low + 0.24), size, label="otherprop", item=1 + k, yaw=rng.uniform(-0.08, 0.08))


def _headboard(a: Assembly, rng: np.random.Generator, frame: int, cloth: int, w: float) -> None:
    """Plain, padded and leaning back, of bars, or none."""
    head, kind = rng.uniform(0.8, 1.2), int(rng.integers(5))
    if kind < 2:
        a.box(frame, (0, 0.03, head / 2), (w + 0.05, 0.06, head))
    elif kind == 2:
        a.box(cloth, (0, 0.08, 0.2 + head * 0.4), (w + 0.05, 0.08, head * 0.8), tilt=0.08)
    elif kind == 3:
        for x in np.linspace(-w / 2, w / 2, 7):
            a.cylinder(frame, (float(x), 0.03, head / 2), (0.035, 0.035, head))
        a.cylinder(frame, (0, 0.03, head), (0.045, 0.045, w + 0.03), yaw=np.pi / 2, tilt=np.pi / 2)


@furniture("sofa", "wall", keep_free_m=0.35)
def sofa(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Base, seat cushions, back, arms, loose cushions."""
    seats = int(rng.integers(1, 4))
    arm, depth = rng.uniform(0.12, 0.24), rng.uniform(0.8, 0.95)
    inner = seats * rng.uniform(0.58, 0.72)
    w, seat, back = inner + 2 * arm, rng.uniform(0.4, 0.46), rng.uniform(0.75, 0.92)
    cloth, rolled, slim = palette.pick(rng, "fabric", role="sofa"), rng.uniform() < 0.35, rng.uniform() < 0.25
    a.box(cloth, (0, depth / 2, (seat - 0.12 + 0.06) / 2), (w, depth, seat - 0.18))
    a.box(cloth, (0, 0.12, 0.06 + (back - 0.06) / 2), (w - 0.02, 0.22, back - 0.06), tilt=0.0)
    soft = rng.uniform() < 0.5
    for x in (-1, 1):
        tall = 0.4 if slim else 0.56
        a.box(cloth, (x * (w - arm) / 2, depth / 2, 0.03 + tall / 2), (arm, depth + 0.02, tall))
        if rolled:
            size = (arm * 1.25, arm * 1.25, depth + 0.03)
            a.cylinder(cloth, (x * (w - arm) / 2, depth / 2, 0.03 + tall), size, tilt=np.pi / 2)
        elif soft:
            a.ellipsoid(cloth, (x * (w - arm) / 2, depth / 2, 0.04 + tall), (arm * 1.1, depth, 0.14))
        a.box(palette.pick(rng, "wood", "metal"), (x * (w / 2 - 0.08), depth - 0.08, 0.035), (0.06, 0.06, 0.07))
    each, plump = inner / seats, rng.uniform() < 0.7
    for k in range(seats):
        x = (k - (seats - 1) / 2) * each
        cushion = a.pillow if plump else a.box
        cushion(cloth, (x, depth / 2 + 0.11, seat - 0.05), (each - 0.01, depth - 0.19, 0.2 if plump else 0.14))
        cushion(cloth, (x, 0.27, seat + 0.2), (each - 0.02, 0.22 if plump else 0.14, 0.42), tilt=0.18)
    if rng.uniform() < 0.2 and seats > 1:  # a chaise
        side = 1 if rng.uniform() < 0.5 else -1
        x = side * (seats - 1) / 2 * each
        a.box(cloth, (x, depth + 0.3, (seat - 0.06) / 2 + 0.02), (each - 0.01, 0.62, seat - 0.1))
        a.box(cloth, (x, depth + 0.3, seat - 0.05), (each - 0.015, 0.6, 0.14))
    if rng.uniform() < 0.25:
        throw = palette.pick(rng, "fabric", "print")
        a.box(throw, (rng.uniform(-0.3, 0.3) * inner, 0.12, back + 0.005), (0.5, 0.26, 0.02), label="otherprop", item=9)
    cushion = palette.pick(rng, "print", "fabric", role="cushion")
    for k in range(int(rng.integers(0, seats + 2))):
        x, lean = rng.uniform(-0.4, 0.4) * inner, rng.uniform(0.2, 0.5)
        side = rng.uniform(0.36, 0.48)
        a.pillow(cushion, (x, 0.42, seat + 0.19), (side, 0.16, side * 0.9), label="otherprop", item=1 + k, tilt=lean)


@furniture("sofa", "corner", keep_free_m=0.3)
def armchair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A wide upholstered seat for one."""
    w, d, seat = rng.uniform(0.7, 0.85), rng.uniform(0.7, 0.85), rng.uniform(0.38, 0.45)
    cloth, leg = palette.pick(rng, "fabric", role="sofa"), palette.pick(rng, "wood", "metal")
    if rng.uniform() < 0.4:
        _tub_chair(a, cloth, leg, w, d, seat)
        return
    add = a.pillow if rng.uniform() < 0.6 else a.box
    add(cloth, (0, d / 2 + 0.02, seat - 0.1), (w - 0.2, d - 0.08, 0.24))
    add(cloth, (0, 0.12, 0.55), (w, 0.22, rng.uniform(0.7, 0.95)), tilt=0.1)
    for x in (-1, 1):
        add(cloth, (x * (w / 2 - 0.07), d / 2 + 0.03, 0.38), (0.15, d - 0.1, 0.46))
        for y in (0.12, d - 0.1):
            a.cylinder(leg, (x * (w / 2 - 0.08), y, 0.09), (0.05, 0.05, 0.18))


def _tub_chair(a: Assembly, cloth: int, leg: int, w: float, d: float, seat: float) -> None:
    """Rounded: a drum of a seat, arms and back of lying cylinders."""
    a.cylinder(cloth, (0, d / 2, (seat + 0.12) / 2), (w * 0.86, d * 0.86, seat - 0.12))
    a.ellipsoid(cloth, (0, d / 2, seat), (w * 0.8, d * 0.8, 0.14))
    a.cylinder(cloth, (0, 0.14, seat + 0.16), (w * 0.9, 0.22, 0.5))
    for x in (-1, 1):
        a.cylinder(cloth, (x * (w / 2 - 0.08), d / 2, seat + 0.12), (0.15, 0.18, d * 0.8), tilt=np.pi / 2)
        a.box(cloth, (x * (w / 2 - 0.08), d / 2, seat / 2 + 0.12), (0.13, d * 0.7, seat))
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        a.cylinder(leg, (x * w * 0.25, d / 2 + y * d * 0.25, 0.07), (0.04, 0.04, 0.14))


@furniture("otherfurniture", "centre")
def pouf(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A round or square footstool."""
    w, h = rng.uniform(0.4, 0.6), rng.uniform(0.3, 0.42)
    cloth = palette.pick(rng, "fabric")
    if rng.uniform() < 0.6:
        a.cylinder(cloth, (0, 0.3, h * 0.45), (w, w, h * 0.9))
        a.ellipsoid(cloth, (0, 0.3, h * 0.9), (w, w, h * 0.2))
    else:
        a.pillow(cloth, (0, 0.3, h / 2), (w, w, h))


@furniture("chair", "centre")
def shell_chair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A moulded seat and a back that leans, on four splayed legs."""
    seat, lean = rng.uniform(0.43, 0.46), rng.uniform(0.1, 0.25)
    plastic, leg = palette.pick(rng, "paint", "object", "fabric"), palette.pick(rng, "wood", "metal")
    a.ellipsoid(plastic, (0, 0.26, seat), (0.46, 0.46, 0.1))
    a.ellipsoid(plastic, (0, 0.07, seat + 0.22), (0.44, 0.08, 0.5), tilt=lean)
    splay, thick = 0.2, 0.03
    length = (seat - thick * float(np.sin(splay))) / float(np.cos(splay))
    for x in (-1, 1):
        for y in (-1, 1):
            a.box(leg, (x * 0.16, 0.26 + y * 0.14, seat / 2), (thick, thick, length), tilt=y * splay)


@furniture("chair", "centre")
def chair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Four legs, seat, slatted or plain back."""
    w, d, seat = rng.uniform(0.4, 0.48), rng.uniform(0.4, 0.48), rng.uniform(0.43, 0.47)
    wood, pad = palette.pick(rng, "wood", "paint", "metal"), palette.pick(rng, "fabric", "wood")
    height, thick = rng.uniform(0.8, 1.0), rng.uniform(0.03, 0.06)
    for x in (-1, 1):
        px = x * (w / 2 - thick / 2)
        a.box(wood, (px, d - 0.03, seat / 2 - 0.02), (thick, thick, seat - 0.04))
        a.box(wood, (px, 0.03, height / 2), (thick, thick, height))
    a.box(pad, (0, d / 2 + 0.01, seat), (w, d - 0.02, 0.045))
    if rng.uniform() < 0.4:
        a.ellipsoid(pad, (0, d / 2 + 0.01, seat + 0.02), (w * 0.95, d * 0.92, 0.06))
    style = int(rng.integers(5))
    if style == 0:
        a.cylinder(pad, (0, 0.03, height - 0.06), (0.07, 0.1, w), yaw=np.pi / 2, tilt=np.pi / 2)
    elif style == 1:
        a.box(pad, (0, 0.035, (height + seat) / 2 + 0.08), (w - 2 * thick, 0.025, (height - seat) * 0.6))
    else:
        slats, tall = int(rng.integers(2, 6)), rng.uniform(0.03, 0.06)
        for z in np.linspace(seat + rng.uniform(0.1, 0.2), height - tall / 2, slats):
            a.box(wood, (0, 0.03, float(z)), (w - 2 * thick, 0.02, tall))
        a.box(wood, (0, d / 2, seat - 0.05), (w - 2 * thick, d - 0.04, 0.05))


@furniture("chair", "centre")
def office_chair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Star base, column, padded seat and back."""
    cloth, metal = palette.pick(rng, "fabric", "dark"), palette.pick(rng, "metal", "dark")
    seat = rng.uniform(0.44, 0.52)
    for k in range(5):
        angle = 2 * np.pi * k / 5 + 0.3
        center = (0.14 * float(np.cos(angle)), 0.3 + 0.14 * float(np.sin(angle)), 0.07)
        a.box(metal, center, (0.28, 0.05, 0.04), yaw=angle)
        tip = (0.27 * float(np.cos(angle)), 0.3 + 0.27 * float(np.sin(angle)), 0.03)
        a.ellipsoid(metal, tip, (0.06, 0.06, 0.06))
    a.cylinder(metal, (0, 0.3, seat / 2), (0.06, 0.06, seat - 0.08))
    a.pillow(cloth, (0, 0.3, seat), (0.5, 0.48, 0.1))
    a.pillow(cloth, (0, 0.06, seat + 0.36), (0.46, 0.09, 0.52), tilt=0.1)
    a.box(metal, (0, 0.04, seat + 0.08), (0.06, 0.04, 0.2))
    if rng.uniform() < 0.6:
        for x in (-0.27, 0.27):
            a.box(metal, (x, 0.3, seat + 0.2), (0.05, 0.28, 0.03))
            a.box(metal, (x, 0.3, seat + 0.09), (0.03, 0.05, 0.2))


@furniture("chair", "centre")
def stool(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A round seat on three legs."""
    r, seat = rng.uniform(0.3, 0.38), rng.uniform(0.42, 0.66)
    wood = palette.pick(rng, "wood", "metal", "paint")
    a.cylinder(palette.pick(rng, "wood", "fabric"), (0, 0.2, seat), (r, r, 0.05))
    for k in range(3):
        angle = 2 * np.pi * k / 3
        a.cylinder(
            wood,
            (0.36 * r * float(np.cos(angle)), 0.2 + 0.36 * r * float(np.sin(angle)), (seat - 0.02) / 2),
            (0.035, 0.035, seat - 0.02),
        )
