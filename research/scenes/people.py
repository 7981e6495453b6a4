"""People and animals: whom a camera meets, but no map should hold. Animals carry the ignore id."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.layout import Layout
from research.scenes.materials import Material, Palette, Pattern
from research.scenes.primitives import ANIMAL, PERSON, Assembly, Shape
from semantic_mapper.types import Float64

_MOVING = 0.5  # fraction of them
_ANIMAL = 0.25
_TRIES = 40  # places tried for each


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """How one being moves to and fro.

    Args:
        group: Of ``Primitives.group``.
        reach: (3,) metres from the middle of the way to its end.
        period: Frames of one way there and back.
        phase: Radians.
    """

    group: int
    reach: Float64
    period: float
    phase: float

    def offset(self, frame: int) -> Float64:
        """(3,) metres from where the group stands in the scene."""
        return self.reach * float(np.sin(2 * np.pi * frame / self.period + self.phase))


def add_beings(layout: Layout, rng: np.random.Generator) -> tuple[Walk, ...]:
    """Stand one or two people or animals where there is space; the walks of those that move."""
    walks: list[Walk] = []
    for _ in range(int(rng.integers(1, 3))):
        make = _animal if rng.uniform() < _ANIMAL else make_person
        moves = rng.uniform() < _MOVING
        being = make(rng, layout.palette, casts_shadow=not moves)  # shadows are those of what stands still
        if not _stand(layout, rng, being) or not moves:
            continue
        angle, way = rng.uniform(0, 2 * np.pi), rng.uniform(0.15, 0.5)
        reach = way * np.array([np.cos(angle), np.sin(angle), 0.0])
        walks.append(Walk(len(layout.groups) - 1, reach, float(rng.uniform(5, 25)), float(rng.uniform(0, 2 * np.pi))))
    return tuple(walks)


def _stand(layout: Layout, rng: np.random.Generator, being: Assembly) -> bool:
    room = np.array(layout.size_m[:2])
    for _ in range(_TRIES):
        position = np.append(rng.uniform(0.35, room - 0.35), 0.0)
        if layout.put(being, float(rng.uniform(0, 2 * np.pi)), position, in_keep_free=True):
            return True
    return False


def make_person(rng: np.random.Generator, palette: Palette, *, casts_shadow: bool) -> Assembly:
    """Upright, facing y; the arms hang, or are bent as at work."""
    a, h = Assembly(PERSON), rng.uniform(1.5, 1.9) / 1.75
    wide, bend = rng.uniform(0.36, 0.5), rng.uniform(0.0, 1.5)
    skin, hair = palette.add(skin_material(rng)), palette.add(_hair(rng))
    shirt, trousers, shoe = (
        palette.add(cloth_material(rng)),
        palette.add(cloth_material(rng)),
        palette.pick(rng, "dark", "object"),
    )
    legs = trousers if rng.uniform() < 0.85 else skin

    def add(shape: Shape, material: int, center: tuple[float, float, float], size: tuple[float, float, float]) -> None:
        a.add(shape, material, center, size, casts_shadow=casts_shadow)

    for x in (-1, 1):
        step = rng.uniform(-0.08, 0.08)
        add(Shape.PILLOW, shoe, (0.1 * x, 0.04 + step, 0.045 * h), (0.1, 0.27, 0.09 * h))
        add(Shape.CYLINDER, legs, (0.1 * x, step, 0.45 * h), (0.14, 0.15, 0.8 * h))
    add(Shape.PILLOW, trousers, (0, 0, 0.9 * h), (wide * 0.86, 0.25, 0.3 * h))
    add(Shape.PILLOW, shirt, (0, 0, 1.19 * h), (wide, 0.25, 0.6 * h))
    sleeve = shirt if rng.uniform() < 0.7 else skin
    for x in (-1, 1):
        elbow, side = 1.1 * h, x * (wide / 2 + 0.035)
        add(Shape.ELLIPSOID, shirt, (side, 0, 1.25 * h), (0.12, 0.14, 0.4 * h))
        reach, drop = 0.13 * float(np.sin(bend)), 0.13 * float(np.cos(bend))
        a.ellipsoid(sleeve, (side, reach, elbow - drop), (0.09, 0.1, 0.32), tilt=bend, casts_shadow=casts_shadow)
        add(Shape.ELLIPSOID, skin, (side, 2.2 * reach, elbow - 2.2 * drop), (0.09, 0.11, 0.12))
    add(Shape.CYLINDER, skin, (0, 0, 1.5 * h), (0.12, 0.12, 0.12 * h))
    add(Shape.ELLIPSOID, skin, (0, 0.01, 1.63 * h), (0.16, 0.2, 0.24 * h))
    long = rng.uniform(0.14, 0.36)
    add(Shape.ELLIPSOID, hair, (0, -0.025, 1.75 * h - long / 2), (0.185, 0.19, long))
    return a


def _animal(rng: np.random.Generator, palette: Palette, *, casts_shadow: bool) -> Assembly:
    """A cat or a dog, facing y."""
    a, size, fur = Assembly(ANIMAL), rng.uniform(0.25, 0.65), palette.add(_hair(rng))
    for shape, center, extents in (
        (Shape.PILLOW, (0.0, 0.0, 0.62), (0.34, 1.0, 0.4)),
        (Shape.ELLIPSOID, (0.0, 0.58, 0.86), (0.26, 0.36, 0.3)),
        (Shape.ELLIPSOID, (0.0, 0.74, 0.8), (0.14, 0.22, 0.15)),
        (Shape.ELLIPSOID, (0.0, -0.6, 0.75), (0.1, 0.5, 0.1)),
        *((Shape.CYLINDER, (x, y, 0.25), (0.11, 0.11, 0.5)) for x in (-0.1, 0.1) for y in (-0.38, 0.38)),
        *((Shape.ELLIPSOID, (x, 0.52, 1.02), (0.09, 0.06, 0.18)) for x in (-0.08, 0.08)),
    ):
        (x, y, z), (w, d, tall) = center, extents
        a.add(shape, fur, (x * size, y * size, z * size), (w * size, d * size, tall * size), casts_shadow=casts_shadow)
    return a


def skin_material(rng: np.random.Generator) -> Material:
    """Skin of any tone."""
    color = np.array([0.75, 0.5, 0.38]) * rng.uniform(0.1, 1.0) * rng.uniform(0.85, 1.15, 3)
    return _plain(rng, color, Pattern.PLAIN, 0.1)


def _hair(rng: np.random.Generator) -> Material:
    color = np.array([0.6, 0.45, 0.3]) * rng.uniform(0.02, 1.0) * rng.uniform(0.8, 1.2, 3)
    return _plain(rng, color, Pattern.BRUSHED, 0.02)


def cloth_material(rng: np.random.Generator) -> Material:
    """Cloth of any colour: plain, woven, striped or checked."""
    pattern = (Pattern.PLAIN, Pattern.WEAVE, Pattern.STRIPES, Pattern.CHECKER)[int(rng.integers(4))]
    grey = rng.uniform(0.01, 0.7) * np.ones(3)
    color = grey if rng.uniform() < 0.5 else rng.uniform(0.01, 0.8, 3)
    return _plain(rng, color, pattern, float(rng.uniform(0.01, 0.06)))


def _plain(rng: np.random.Generator, color: Float64, pattern: Pattern, scale_m: float) -> Material:
    r, g, b = (float(np.clip(c, 0.0, 1.0)) for c in color)
    second = rng.uniform(0.4, 0.8)
    return Material(pattern, (r, g, b), (r * second, g * second, b * second), scale_m, int(rng.integers(1 << 30)))
