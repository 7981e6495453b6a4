"""Beds, sofas, chairs."""

from __future__ import annotations

import numpy as np

from semantic_mapper.scenes.furniture.registry import furniture
from semantic_mapper.scenes.materials import Palette
from semantic_mapper.scenes.primitives import Assembly


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
    a.box(sheet, (0, d / 2 + 0.01, low + 0.07), (w - 0.06, d - 0.08, 0.2))
    cover = d * rng.uniform(0.55, 0.72)
    a.box(duvet, (0, d - cover / 2, low + 0.12), (w + 0.01, cover, 0.16))
    a.ellipsoid(duvet, (0, d - cover / 2, low + 0.19), (w * 0.95, cover * 0.95, 0.12))
    head = rng.uniform(0.8, 1.2)
    a.box(frame, (0, 0.03, head / 2), (w + 0.05, 0.06, head))
    pillow = palette.pick(rng, "fabric", "print")
    for k in range(1 if w < 1.3 else 2):
        x = 0.0 if w < 1.3 else (k - 0.5) * w * 0.5
        a.ellipsoid(pillow, (x, 0.3, low + 0.24), (0.6, 0.4, 0.18), label="otherprop", item=1 + k)


@furniture("sofa", "wall", keep_free_m=0.35)
def sofa(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Base, seat cushions, back, arms, loose cushions."""
    seats = int(rng.integers(1, 4))
    arm, depth = rng.uniform(0.12, 0.24), rng.uniform(0.8, 0.95)
    inner = seats * rng.uniform(0.58, 0.72)
    w, seat, back = inner + 2 * arm, rng.uniform(0.4, 0.46), rng.uniform(0.75, 0.92)
    cloth = palette.pick(rng, "fabric")
    a.box(cloth, (0, depth / 2, (seat - 0.12 + 0.06) / 2), (w, depth, seat - 0.18))
    a.box(cloth, (0, 0.12, 0.06 + (back - 0.06) / 2), (w - 0.02, 0.22, back - 0.06), tilt=0.0)
    for x in (-1, 1):
        a.box(cloth, (x * (w - arm) / 2, depth / 2, 0.31), (arm, depth + 0.02, 0.56))
        if rng.uniform() < 0.5:
            a.ellipsoid(cloth, (x * (w - arm) / 2, depth / 2, 0.6), (arm * 1.1, depth, 0.14))
        a.box(palette.pick(rng, "wood", "metal"), (x * (w / 2 - 0.08), depth - 0.08, 0.035), (0.06, 0.06, 0.07))
    each = inner / seats
    for k in range(seats):
        x = (k - (seats - 1) / 2) * each
        a.box(cloth, (x, depth / 2 + 0.11, seat - 0.05), (each - 0.015, depth - 0.2, 0.14))
        a.box(cloth, (x, 0.27, seat + 0.2), (each - 0.03, 0.14, 0.38), tilt=0.18)
    cushion = palette.pick(rng, "print", "fabric")
    for k in range(int(rng.integers(0, seats + 2))):
        x = rng.uniform(-0.4, 0.4) * inner
        a.ellipsoid(
            cushion, (x, 0.42, seat + 0.2), (0.42, 0.18, 0.4), label="otherprop", item=1 + k, tilt=rng.uniform(0.2, 0.5)
        )


@furniture("sofa", "corner", keep_free_m=0.3)
def armchair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A wide upholstered seat for one."""
    w, d, seat = rng.uniform(0.7, 0.85), rng.uniform(0.7, 0.85), rng.uniform(0.38, 0.45)
    cloth, leg = palette.pick(rng, "fabric"), palette.pick(rng, "wood", "metal")
    a.box(cloth, (0, d / 2 + 0.02, seat - 0.1), (w - 0.2, d - 0.08, 0.2))
    a.box(cloth, (0, 0.12, 0.55), (w, 0.2, rng.uniform(0.7, 0.95)), tilt=0.1)
    for x in (-1, 1):
        a.box(cloth, (x * (w / 2 - 0.06), d / 2 + 0.03, 0.38), (0.12, d - 0.1, 0.44))
        for y in (0.12, d - 0.1):
            a.cylinder(leg, (x * (w / 2 - 0.08), y, 0.09), (0.05, 0.05, 0.18))


@furniture("chair", "centre")
def chair(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Four legs, seat, slatted or plain back."""
    w, d, seat = rng.uniform(0.4, 0.48), rng.uniform(0.4, 0.48), rng.uniform(0.43, 0.47)
    wood, pad = palette.pick(rng, "wood", "paint", "metal"), palette.pick(rng, "fabric", "wood")
    height, thick = rng.uniform(0.8, 1.0), rng.uniform(0.03, 0.045)
    for x in (-1, 1):
        px = x * (w / 2 - thick / 2)
        a.box(wood, (px, d - 0.03, seat / 2 - 0.02), (thick, thick, seat - 0.04))
        a.box(wood, (px, 0.03, height / 2), (thick, thick, height))
    a.box(pad, (0, d / 2 + 0.01, seat), (w, d - 0.02, 0.045))
    if rng.uniform() < 0.5:
        a.box(pad, (0, 0.035, (height + seat) / 2 + 0.08), (w - 2 * thick, 0.025, (height - seat) * 0.6))
    else:
        for z in np.linspace(seat + 0.14, height - 0.04, 3):
            a.box(wood, (0, 0.03, float(z)), (w - 2 * thick, 0.02, 0.06))


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
    a.box(cloth, (0, 0.3, seat), (0.48, 0.46, 0.08))
    a.box(cloth, (0, 0.06, seat + 0.36), (0.44, 0.07, 0.5), tilt=0.1)
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
