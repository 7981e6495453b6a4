"""Boxes of a street's objects as somebody annotates them: coarse, a little off, and overlapping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from research.scenes.primitives import rotation_z
from research.scenes.sequence import FRAME_NS
from research.scenes.streets.layout import STREETS_CODE, STREETS_VERSION, Street
from research.scenes.streets.outlines import Outline
from semantic_mapper.types import Bool, Float64

THINGS = ("building", "car", "trailer", "caravan", "box")

_BOX_STREAM = 5
_GROWTH = (0.05, 0.15)  # of each side
_GROWTH_M, _GROUND_GROWTH_M = (0.5, 1.6), (1.3, 1.9)  # but between these
_SHIFT_M, _YAW_DEG = (0.03, 0.10), 3.0
_END_M = 0.05  # by which yaw may move an end, at least; else by what the growth leaves beside the shift


@dataclass(frozen=True, slots=True, eq=False)
class StreetBox:
    """One annotated solid.

    Args:
        id: From 1, of this box alone; of a thing, that of its object in instance images.
        name: Of its class.
        shape: "box", "ellipsoid", or "prism" = convex polygon extruded along z.
        T_world_box: (4, 4) pose of its centre; of one that moves, in frame 0.
        size: (3,) full extents, metres.
        polygon: (N, 2) corners of a prism in its own xy, anticlockwise.
        thing: Whether it is a countable thing.
        stamps: (ns, (4, 4) pose) of each frame, of one that moves.
    """

    id: int
    name: str
    shape: str
    T_world_box: Float64
    size: Float64
    polygon: Float64 | None
    thing: bool
    stamps: tuple[tuple[int, Float64], ...] | None = None

    def contains(self, points: Float64) -> Bool:
        """Which of points (N, 3) in the world are inside, (N,)."""
        own = (points - self.T_world_box[:3, 3]) @ self.T_world_box[:3, :3]
        if self.shape == "ellipsoid":
            return np.asarray(np.square(own / (self.size / 2)).sum(axis=1) <= 1)
        inside = (np.abs(own) <= self.size / 2).all(axis=1)
        if self.polygon is not None:
            edge = np.roll(self.polygon, -1, axis=0) - self.polygon
            to = own[:, None, :2] - self.polygon[None]
            inside &= (edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] >= 0).all(axis=1)
        return np.asarray(inside)


def street_boxes(street: Street, frames: int) -> list[StreetBox]:
    """The boxes of a street: each side 5 to 15 % too long, turned by up to 3 degrees, and 3 to 10 cm off.

    Sides grow by 50 cm at least, so that what is thin stays inside, and by 1.6 m at most; long things turn less. Slabs
    of the ground reach 15 cm above and below it, and grow by 1.3 to 1.9 m.

    Args:
        street: From ``make_streets_street``.
        frames: How many poses boxes that move have.
    """
    rng = np.random.default_rng((STREETS_CODE, STREETS_VERSION, street.scene.seed, _BOX_STREAM))
    primitives = street.scene.primitives
    walks = {walk.group: walk for walk in street.scene.walks}
    free = int(primitives.instance.max())
    found: list[StreetBox] = []
    for group, placed in enumerate(street.placed):
        for outline in placed.outlines:
            thing = outline.name in THINGS
            free += not thing
            number = int(primitives.instance[primitives.group == group][0]) if thing else free
            T, size, polygon = _drawn(outline, placed.T_world_group, rng)
            stamps = None
            if group in walks:
                poses = [T.copy() for _ in range(frames)]
                for k, pose in enumerate(poses):
                    pose[:3, 3] += walks[group].offset(k)
                stamps = tuple(((k + 1) * FRAME_NS, pose) for k, pose in enumerate(poses))
            found.append(StreetBox(number, outline.name, outline.shape, T, size, polygon, thing, stamps))
    return found


def _drawn(
    outline: Outline, T_world_group: Float64, rng: np.random.Generator
) -> tuple[Float64, Float64, Float64 | None]:
    """Pose, size and polygon of an outline as it is drawn."""
    flat = outline.shape == "prism" and outline.size[2] < 0.5  # the ground, which is as thick as it is
    growth = np.clip(outline.size * rng.uniform(*_GROWTH, 3), *(_GROUND_GROWTH_M if flat else _GROWTH_M))
    growth[2] *= not flat
    size = outline.size + growth
    polygon = None if outline.polygon is None else outline.polygon * (size / outline.size)[:2]
    T = T_world_group @ outline.T_group_outline
    reach = float(np.linalg.norm(T[:2, :3] * (size / 2), axis=0).max())  # of its longest level half axis
    end = max(_END_M, float(growth[:2].min()) / 2 - _SHIFT_M[1])
    limit = min(np.radians(_YAW_DEG), end / reach)
    T[:3, :3] = rotation_z(rng.uniform(-limit, limit)) @ T[:3, :3]
    angle, way = rng.uniform(0, 2 * np.pi), rng.uniform(*_SHIFT_M)
    T[:3, 3] += way * np.array([np.cos(angle), np.sin(angle), 0.0])
    return T, size, polygon
