"""Analytic primitives, assemblies of them, and the arrays that the ray casters read.

A primitive is a unit shape (see ``Shape``; all fit into [-1, 1]^3) scaled by its half extents, turned and moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.types import Float64, UInt8

Vector = tuple[float, float, float]

PERSON = "person"  # label of people and their arms: the class of that name, else ignored
ANIMAL = "animal"  # likewise


class Shape(IntEnum):
    """Unit shapes."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2
    FRUSTUM = 3  # a cone cut off: radius 1 at z = -1, 0.6 at z = 1
    PILLOW = 4  # a superellipsoid x^4 + y^4 + z^4 = 1: a box with soft edges
    TORUS = 5  # about z: the tube is 0.6 of the ring's radius thick; round where the height is 0.3 of the width
    PRISM = 6  # half a box: x + y <= 0. ``Assembly.prism`` makes any convex polygon of such halves


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One primitive in the frame of its assembly.

    Args:
        shape: Unit shape.
        center: (3,) metres.
        half: (3,) half extents along its own axes.
        rotation: (3, 3) own axes -> assembly axes.
        label: Class name of the scene's label set, ``PERSON`` or ``ANIMAL``.
        material: Number in the palette.
        item: Separate objects of one assembly (a cushion on a sofa) have numbers of their own.
        casts_shadow: False for what light comes from or through.
    """

    shape: Shape
    center: Float64
    half: Float64
    rotation: Float64
    label: str
    material: int
    item: int = 0
    casts_shadow: bool = True


@dataclass(frozen=True, slots=True)
class Top:
    """A horizontal surface of an assembly on which small things may stand: [x0, x1] x [y0, y1] at height z."""

    x0: float
    x1: float
    y0: float
    y1: float
    z: float


@dataclass(slots=True)
class Assembly:
    """A piece of furniture under construction.

    Axes: x along the wall it stands at, y away from the wall into the room, z up. The origin is on the floor, in the
    middle of the back.
    """

    label: str
    parts: list[Part] = field(default_factory=list[Part])
    tops: list[Top] = field(default_factory=list[Top])
    lamps: list[Vector] = field(default_factory=list[Vector])  # where light comes from
    keep_free_m: float = 0.0  # space to leave in front, in y

    def add(
        self,
        shape: Shape,
        material: int,
        center: Vector,
        size: Vector,
        *,
        label: str | None = None,
        yaw: float = 0.0,
        tilt: float = 0.0,
        item: int = 0,
        casts_shadow: bool = True,
    ) -> None:
        """Add a primitive of full extents ``size``, leaning back by ``tilt`` about x, then turned by ``yaw`` about z
        (radians)."""
        self.parts.append(
            Part(
                shape,
                np.array(center, np.float64),
                np.array(size, np.float64) / 2,
                rotation_z(yaw) @ rotation_x(tilt),
                label or self.label,
                material,
                item,
                casts_shadow,
            )
        )

    def box(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` a box."""
        self.add(Shape.BOX, material, center, size, **options)  # type: ignore[arg-type]

    def cylinder(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` an upright cylinder."""
        self.add(Shape.CYLINDER, material, center, size, **options)  # type: ignore[arg-type]

    def ellipsoid(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` an ellipsoid."""
        self.add(Shape.ELLIPSOID, material, center, size, **options)  # type: ignore[arg-type]

    def frustum(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` an upright frustum, wide below; ``tilt=np.pi`` turns it over."""
        self.add(Shape.FRUSTUM, material, center, size, **options)  # type: ignore[arg-type]

    def pillow(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` a box with soft edges."""
        self.add(Shape.PILLOW, material, center, size, **options)  # type: ignore[arg-type]

    def torus(self, material: int, center: Vector, size: Vector, **options: object) -> None:
        """``add`` a lying torus."""
        self.add(Shape.TORUS, material, center, size, **options)  # type: ignore[arg-type]

    def prism(self, material: int, corners: Sequence[tuple[float, float]], z: tuple[float, float]) -> None:
        """Add a convex polygon extruded from ``z[0]`` to ``z[1]``, as right-angled prisms that meet without a gap.

        Args:
            material: Number in the palette.
            corners: At least 3, (x, y) in metres, anticlockwise.
            z: Lower and upper end, metres.
        """
        points = np.array(corners, np.float64)
        for k in range(1, len(points) - 1):
            triangle = points[[0, k, k + 1]]
            sides = np.linalg.norm(np.roll(triangle, -1, axis=0) - triangle, axis=1)
            a, b, apex = np.roll(triangle, -int(sides.argmax()), axis=0)  # the longest side runs from a to b
            foot = a + (b - a) * ((apex - a) @ (b - a)) / ((b - a) @ (b - a))
            for x_end, y_end in ((b, apex), (apex, a)):  # the right angle is at the foot of the apex's height
                x_leg, y_leg = x_end - foot, y_end - foot
                middle = foot + (x_leg + y_leg) / 2
                size = (float(np.linalg.norm(x_leg)), float(np.linalg.norm(y_leg)), z[1] - z[0])
                if min(size) > 0.0:
                    yaw = float(np.arctan2(x_leg[1], x_leg[0]))
                    center = (float(middle[0]), float(middle[1]), (z[0] + z[1]) / 2)
                    self.add(Shape.PRISM, material, center, size, yaw=yaw)

    def wedge(self, material: int, size: Vector, z: float, turn: float, *, start: float = 0.0) -> None:
        """Add a turned wedge (long, reach, rise): full height at y = ``start``, down to ``z`` at ``reach`` from it."""
        long, reach, rise = size
        away = start + reach / 2
        middle = (-float(np.sin(turn)) * away, float(np.cos(turn)) * away, z + rise / 2)
        yaw = turn + np.pi / 2  # own x points outwards, own y up, own z along the ridge
        self.add(Shape.PRISM, material, middle, (reach, rise, long), yaw=yaw, tilt=np.pi / 2)

    def bounds(self) -> tuple[Float64, Float64]:
        """Lower and upper corner (3,) of all parts, in the assembly's frame."""
        lows, highs = zip(*(part_bounds(part) for part in self.parts), strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Primitives:
    """P primitives in world coordinates, as arrays.

    Args:
        shape: (P,) int64 of ``Shape``.
        center, half: (P, 3) float64 metres.
        rotation: (P, 3, 3) float64, own axes -> world.
        label: (P,) uint8 ids of the scene's label set, or its ignore id.
        instance: (P,) uint16, from 1.
        group: (P,) int64, which piece of furniture it belongs to; 0 to 5 are floor, ceiling and walls.
        material: (P,) int64.
        casts_shadow: (P,) bool.
    """

    shape: np.ndarray
    center: Float64
    half: Float64
    rotation: Float64
    label: UInt8
    instance: np.ndarray
    group: np.ndarray
    material: np.ndarray
    casts_shadow: np.ndarray

    def __len__(self) -> int:
        return len(self.shape)

    def bounds(self) -> tuple[Float64, Float64]:
        """Axis-aligned bounds (P, 3), (P, 3) in world coordinates."""
        reach = np.einsum("pij,pj->pi", np.abs(self.rotation), self.half)
        return self.center - reach, self.center + reach


def rotation_z(angle: float) -> Float64:
    """(3, 3) right-handed rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_x(angle: float) -> Float64:
    """(3, 3) right-handed rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def scaled(assembly: Assembly, factor: float) -> Assembly:
    """The same piece ``factor`` times as large; the space before it stays as it is."""
    parts = [replace(p, center=p.center * factor, half=p.half * factor) for p in assembly.parts]
    tops = [Top(*(factor * value for value in (t.x0, t.x1, t.y0, t.y1, t.z))) for t in assembly.tops]
    lamps = [(factor * x, factor * y, factor * z) for x, y, z in assembly.lamps]
    return replace(assembly, parts=parts, tops=tops, lamps=lamps)


def part_bounds(part: Part) -> tuple[Float64, Float64]:
    """Axis-aligned bounds of a part in its assembly's frame."""
    reach = np.abs(part.rotation) @ part.half
    return part.center - reach, part.center + reach


def place_parts(assembly: Assembly, yaw: float, position: Float64) -> list[Part]:
    """The parts of ``assembly``, turned by ``yaw`` about z and moved to ``position`` (3,)."""
    return turned_parts(assembly, rotation_z(yaw), position)


def turned_parts(assembly: Assembly, turn: Float64, position: Float64) -> list[Part]:
    """The parts of ``assembly``, turned by ``turn`` (3, 3) and moved to ``position`` (3,)."""
    return [
        Part(
            p.shape,
            turn @ p.center + position,
            p.half,
            turn @ p.rotation,
            p.label,
            p.material,
            p.item,
            p.casts_shadow,
        )
        for p in assembly.parts
    ]


def pack(groups: list[list[Part]], label_set: LabelSet = ROOMS) -> Primitives:
    """Parts in world coordinates -> arrays; each (group, item) becomes one instance, numbered from 1.

    Args:
        groups: Parts of each assembly. Labels: names of ``label_set``, ``PERSON`` or ``ANIMAL`` (ignored where it has
            no such class).
        label_set: Gives the ids.
    """
    ignored = dict.fromkeys((PERSON, ANIMAL), label_set.ignore_id)
    label_id = ignored | dict(zip(label_set.names, label_set.ids, strict=True))
    instances: dict[tuple[int, int], int] = {}
    flat: list[Part] = []
    numbers: list[int] = []
    owners: list[int] = []
    for index, group in enumerate(groups):
        for part in group:
            flat.append(part)
            owners.append(index)
            numbers.append(instances.setdefault((index, part.item), len(instances) + 1))
    return Primitives(
        shape=np.array([int(p.shape) for p in flat], np.int64),
        center=np.array([p.center for p in flat], np.float64),
        half=np.array([p.half for p in flat], np.float64),
        rotation=np.array([p.rotation for p in flat], np.float64),
        label=np.array([label_id[p.label] for p in flat], np.uint8),
        instance=np.array(numbers, np.uint16),
        group=np.array(owners, np.int64),
        material=np.array([p.material for p in flat], np.int64),
        casts_shadow=np.array([p.casts_shadow for p in flat], np.bool_),
    )
