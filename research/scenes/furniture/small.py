"""Lamps, plants, rugs, cartons, bins."""

from __future__ import annotations

import numpy as np

from research.scenes.furniture.registry import furniture
from research.scenes.materials import Palette
from research.scenes.primitives import Assembly


@furniture("otherprop", "ceiling")
def ceiling_lamp(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A flat shade, a tube, or a shade hung from a cord; z = 0 is the ceiling."""
    shade, w = palette.pick(rng, "lampshade"), rng.uniform(0.3, 0.5)
    kind = int(rng.integers(4))
    if kind == 0:
        a.cylinder(shade, (0, 0, -0.06), (w, w, 0.1), casts_shadow=False)
        a.lamps.append((0.0, 0.0, -0.25))
    elif kind == 1:
        length = rng.uniform(0.8, 1.3)
        a.box(palette.pick(rng, "metal", "paint"), (0, 0, -0.02), (length, 0.14, 0.03), casts_shadow=False)
        a.cylinder(shade, (0, 0, -0.06), (0.07, 0.07, length), yaw=np.pi / 2, tilt=np.pi / 2, casts_shadow=False)
        a.lamps.append((0.0, 0.0, -0.25))
    else:
        drop = rng.uniform(0.2, 0.45)
        a.cylinder(palette.pick(rng, "metal", "dark"), (0, 0, -drop / 2), (0.02, 0.02, drop), casts_shadow=False)
        if kind == 2:
            a.ellipsoid(shade, (0, 0, -drop - 0.08), (w, w, 0.22), casts_shadow=False)
        else:
            a.frustum(shade, (0, 0, -drop - 0.08), (w, w, 0.2), casts_shadow=False)
        a.lamps.append((0.0, 0.0, -drop - 0.3))


@furniture("otherfurniture", "corner")
def floor_lamp(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """Foot, pole, shade."""
    metal, shade, h = palette.pick(rng, "metal", "dark"), palette.pick(rng, "lampshade"), rng.uniform(1.4, 1.75)
    w = rng.uniform(0.3, 0.42)
    a.cylinder(metal, (0, 0.22, 0.015), (0.28, 0.28, 0.03))
    a.cylinder(metal, (0, 0.22, h / 2), (0.03, 0.03, h))
    add = a.frustum if rng.uniform() < 0.6 else a.cylinder
    add(shade, (0, 0.22, h), (w, w, rng.uniform(0.22, 0.3)), casts_shadow=False)
    a.lamps.append((0.0, 0.22, h + 0.25))


@furniture("otherprop", "small")
def table_lamp(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A small lamp."""
    foot, h = palette.pick(rng, "metal", "ceramic", "object"), rng.uniform(0.22, 0.35)
    a.ellipsoid(foot, (0, 0, h * 0.3), (0.13, 0.13, h * 0.6))
    a.frustum(palette.pick(rng, "lampshade"), (0, 0, h * 0.85), (0.2, 0.2, h * 0.5), casts_shadow=False)


@furniture("otherprop", "corner")
def plant(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A pot with a crown of ellipsoids."""
    pot, leaf, h = palette.pick(rng, "object", "ceramic", "wood"), palette.pick(rng, "plant"), rng.uniform(0.6, 1.3)
    a.frustum(pot, (0, 0.25, 0.15), (0.32, 0.32, 0.3), tilt=np.pi)
    a.cylinder(palette.pick(rng, "wood"), (0, 0.25, 0.3 + h * 0.2), (0.04, 0.04, h * 0.5))
    for _ in range(4):
        x, y, z = rng.uniform(-0.09, 0.09), 0.25 + rng.uniform(-0.06, 0.09), rng.uniform(0.45, 0.95) * h
        size = (rng.uniform(0.18, 0.3), rng.uniform(0.18, 0.3), rng.uniform(0.2, 0.4))
        a.ellipsoid(leaf, (x, y, z + 0.1), size, tilt=rng.uniform(-0.4, 0.4))


@furniture("floor", "centre")
def rug(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A thin carpet; floor, as far as the label goes."""
    w, d = rng.uniform(1.2, 2.2), rng.uniform(0.9, 1.5)
    a.box(palette.pick(rng, "fabric", "print"), (0, d / 2, 0.006), (w, d, 0.012))


@furniture("otherprop", "centre")
def carton(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A box on the floor, sometimes two."""
    w, d, h = rng.uniform(0.3, 0.55), rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.45)
    a.box(palette.pick(rng, "wood", "object", "fabric"), (0, d / 2, h / 2), (w, d, h))
    if rng.uniform() < 0.3:
        material = palette.pick(rng, "wood", "object")
        a.box(material, (0.02, d / 2, h + h * 0.3), (w * 0.8, d * 0.8, h * 0.6), yaw=rng.uniform(-0.4, 0.4), item=1)


@furniture("otherprop", "corner")
def waste_bin(a: Assembly, rng: np.random.Generator, palette: Palette) -> None:
    """A round bin."""
    w, h = rng.uniform(0.24, 0.34), rng.uniform(0.3, 0.55)
    a.frustum(palette.pick(rng, "metal", "object", "dark"), (0, 0.2, h / 2), (w, w, h), tilt=np.pi)
    a.cylinder(palette.pick(rng, "dark", "metal"), (0, 0.2, h + 0.008), (w * 0.94, w * 0.94, 0.02))
