"""Arms of the person who wears the camera: before it in every frame of a sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from research.scenes.config import SUITE_VERSION
from research.scenes.materials import Material, material_table
from research.scenes.people import cloth_material, skin_material
from research.scenes.primitives import PERSON, Part, Primitives, Shape, pack
from research.scenes.scene import Scene, add_primitives
from semantic_mapper.types import Float64

_ARMS_STREAM = 5
_SHARE = 0.3  # of the varied rooms


@dataclass(frozen=True, slots=True, eq=False)
class Arms:
    """One or two arms.

    Args:
        primitives: In camera axes; their materials count from 0.
        materials: Theirs.
    """

    primitives: Primitives
    materials: tuple[Material, ...]


def draw_arms(seed: int, variety: float) -> Arms | None:
    """The arms before the camera in the room of ``seed``, of which ``variety`` are varied; None in most rooms."""
    rng = np.random.default_rng((SUITE_VERSION, seed, _ARMS_STREAM))
    if rng.uniform() >= variety * _SHARE:
        return None
    sleeve, skin = cloth_material(rng), skin_material(rng)
    if rng.uniform() < 0.3:  # bare arms
        sleeve = skin
    hand = cloth_material(rng) if rng.uniform() < 0.3 else skin  # a glove
    sides = (-1, 1) if rng.uniform() < 0.7 else ((-1,) if rng.uniform() < 0.5 else (1,))
    parts = [part for side in sides for part in _arm(rng, side)]
    return Arms(pack([parts]), (sleeve, hand))


def hold_arms(scene: Scene, arms: Arms, T_world_camera: Float64) -> Scene:
    """The scene with ``arms`` before the camera of pose ``T_world_camera`` (4, 4); they cast no shadow."""
    a, R = arms.primitives, T_world_camera[:3, :3]
    held = replace(a, center=a.center @ R.T + T_world_camera[:3, 3], rotation=R @ a.rotation)
    return add_primitives(scene, held, material_table(arms.materials))


def _arm(rng: np.random.Generator, side: int) -> list[Part]:
    """Forearm, palm, thumb and fingers from below the picture towards its middle; materials 0 (arm) and 1 (hand)."""
    elbow = np.array([side * rng.uniform(0.18, 0.4), rng.uniform(0.28, 0.5), rng.uniform(0.1, 0.3)])
    wrist = np.array([side * rng.uniform(-0.02, 0.25), rng.uniform(0.12, 0.35), rng.uniform(0.3, 0.6)])
    along = (wrist - elbow) / np.linalg.norm(wrist - elbow)
    across = np.cross(along, rng.standard_normal(3))
    across /= np.linalg.norm(across)
    R = np.stack((across, np.cross(along, across), along), -1)
    thick = rng.uniform(0.07, 0.11)
    length = float(np.linalg.norm(wrist - elbow))

    def part(shape: Shape, material: int, own: tuple[float, float, float], size: tuple[float, float, float]) -> Part:
        half = np.array(size) / 2
        return Part(shape, wrist + R @ np.array(own), half, R, PERSON, material, item=side + 1, casts_shadow=False)

    fist = rng.uniform(0.4, 1.0)
    return [
        part(Shape.CYLINDER, 0, (0, 0, -length / 2), (thick, thick * 0.85, length)),
        part(Shape.PILLOW, 1, (0, 0, 0.05), (0.09, 0.035, 0.12)),
        part(Shape.ELLIPSOID, 1, (0.05, 0.015, 0.05), (0.03, 0.03, 0.09)),
        *(part(Shape.ELLIPSOID, 1, (x, 0.01, 0.1 + 0.03 * fist), (0.02, 0.022, 0.09 * fist)) for x in
          (-0.033, -0.011, 0.011, 0.033)),
    ]  # fmt: skip
