"""The simple solids that somebody would draw round the objects of a street to annotate it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from research.scenes.primitives import Assembly
from research.scenes.streets.parts import House
from semantic_mapper.types import Float64


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The simple solid round an object, or a part of one: what somebody would draw who annotates a street.

    Args:
        name: Of the class.
        item: Of the assembly; see ``primitives.Part``.
        shape: "box", "ellipsoid", or "prism" = polygon extruded along z.
        T_group_outline: (4, 4) axes of the outline in those of the assembly; the origin is its centre.
        size: (3,) full extents along its own axes.
        polygon: (N, 2) corners of a prism in its own xy, convex, anticlockwise, relative to the centre.
    """

    name: str
    item: int
    shape: str
    T_group_outline: Float64
    size: Float64
    polygon: Float64 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """An object of a street: what is drawn round it, and where it stands."""

    outlines: tuple[Outline, ...]
    T_world_group: Float64


def boxes_round(assembly: Assembly) -> tuple[Outline, ...]:
    """A box round the parts of each class and item of an assembly."""
    found: list[Outline] = []
    for name, item in dict.fromkeys((part.label, part.item) for part in assembly.parts):
        own = replace(assembly, parts=[p for p in assembly.parts if (p.label, p.item) == (name, item)])
        low, high = own.bounds()
        T = np.eye(4)
        T[:3, 3] = (low + high) / 2
        found.append(Outline(name, item, "box", T, high - low))
    return tuple(found)


def prism_outline(name: str, corners: Float64, z: tuple[float, float], axes: Float64 | None = None) -> Outline:
    """A polygon (N, 2) extruded from ``z[0]`` to ``z[1]``, in ``axes`` (3, 3) of the group."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre = np.append((low + high) / 2, (z[0] + z[1]) / 2)
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if axes is None else axes
    T[:3, 3] = T[:3, :3] @ centre
    return Outline(name, 0, "prism", T, np.append(high - low, z[1] - z[0]), corners - centre[:2])


def house_outlines(home: House) -> tuple[Outline, ...]:
    """The house's profile, extruded along its ridge."""
    over, half = 0.5, home.deep / 2
    profile = np.array(
        [(-over, 0.0), (home.deep + over, 0.0), (home.deep + over, home.eaves), (half, home.ridge), (-over, home.eaves)]
    )
    axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # own x, y, z = y, z, x of the house
    return (prism_outline("building", profile, (-home.width / 2 - 0.2, home.width / 2 + 0.2), axes),)


def tree_outlines(growth: Assembly) -> tuple[Outline, ...]:
    """An ellipsoid round the crown, and a box round the trunk, which is the first part."""
    trunk = replace(growth, parts=growth.parts[:1])
    low, high = replace(growth, parts=growth.parts[1:]).bounds()
    T = np.eye(4)
    T[:3, 3] = (low + high) / 2
    return Outline("vegetation", 0, "ellipsoid", T, (high - low) * 1.2), *boxes_round(trunk)
