"""A finished scene: primitives, materials, lights; plain data that both ray casters read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from research.scenes.daylight import Daylight
from research.scenes.fast_cast import cast_pixels
from research.scenes.fast_shade import LightArrays, MaterialArrays, PrimitiveArrays
from research.scenes.materials import MaterialTable, joined_tables
from research.scenes.people import Walk
from research.scenes.primitives import Primitives
from research.scenes.veneer import Veneer
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.types import Float32, Float64


@dataclass(frozen=True, slots=True, eq=False)
class Lights:
    """N point lights and what they cannot see.

    Args:
        position: (N, 3) float64 metres.
        color: (N, 3) float64 linear RGB times strength.
        shadow: (N, 6, S, S) float32: per face of a cube round the light, the depth of the first surface. Face
            ``2 * axis + (direction is negative)``; its columns run along axis + 1, its rows along axis + 2 (mod 3).
        shadow_low, shadow_high: (N, 6, S, S) float32 extremes of ``shadow`` within two pixels, from ``extremes``.
        softness: (N,) float64 half width of the shadows' edges in pixels of the cube, at most 1.
        ambient: (3,) float64 linear RGB that reaches every surface.
    """

    position: Float64
    color: Float64
    shadow: Float32
    shadow_low: Float32
    shadow_high: Float32
    softness: Float64
    ambient: Float64


_NO_CUBES = np.zeros((0, 6, 1, 1), np.float32)
NO_LAMPS = Lights(  # ambient light of strength 1 alone
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    _NO_CUBES,
    _NO_CUBES,
    _NO_CUBES,
    np.zeros(0),
    np.ones(3),
)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One room, or a place under the sky.

    Args:
        seed: That it was made from.
        template: Kind of room ("kitchen", ...).
        size_m: (width, depth, height); the room fills [0, width] x [0, depth] x [0, height], z up. inf = no walls.
        primitives: Everything that can be seen, walls included.
        materials: Rows are what ``primitives.material`` counts.
        lights: Point lights and ambient light.
        walks: What moves from frame to frame.
        label_set: Of the label images.
        daylight: Sun and sky; None indoors. ``lights`` are then ``NO_LAMPS``.
        veneer: What the materials, which are white then, reflect; None: their own patterns.
    """

    seed: int
    template: str
    size_m: tuple[float, float, float]
    primitives: Primitives
    materials: MaterialTable
    lights: Lights
    walks: tuple[Walk, ...] = ()
    label_set: LabelSet = ROOMS
    daylight: Daylight | None = None
    veneer: Veneer | None = None


def scene_at(scene: Scene, frame: int) -> Scene:
    """The scene as it is in one frame of a sequence: people and animals that walk are elsewhere."""
    if not scene.walks:
        return scene
    center = scene.primitives.center.copy()
    for walk in scene.walks:
        center[scene.primitives.group == walk.group] += walk.offset(frame)
    return replace(scene, primitives=replace(scene.primitives, center=center))


def add_primitives(scene: Scene, added: Primitives, materials: MaterialTable) -> Scene:
    """The scene and more primitives, which cast no shadow on it.

    Args:
        scene: Keeps the numbers of its primitives, instances, groups and materials.
        added: Come after them; their labels are ids of the scene's label set.
        materials: Theirs.
    """
    p = scene.primitives
    both = Primitives(
        shape=np.concatenate((p.shape, added.shape)),
        center=np.concatenate((p.center, added.center)),
        half=np.concatenate((p.half, added.half)),
        rotation=np.concatenate((p.rotation, added.rotation)),
        label=np.concatenate((p.label, added.label)),
        instance=np.concatenate((p.instance, (added.instance + p.instance.max()).astype(p.instance.dtype))),
        group=np.concatenate((p.group, added.group + p.group.max() + 1)),
        material=np.concatenate((p.material, added.material + len(scene.materials.pattern))),
        casts_shadow=np.concatenate((p.casts_shadow, added.casts_shadow)),
    )
    return replace(scene, primitives=both, materials=joined_tables(scene.materials, materials))


def kernel_arrays(scene: Scene) -> tuple[PrimitiveArrays, MaterialArrays, LightArrays]:
    """The scene as named tuples of arrays, which kernels take as arguments."""
    p, m, light = scene.primitives, scene.materials, scene.lights
    return (
        PrimitiveArrays(p.shape, p.center, p.half, p.rotation, p.material),
        MaterialArrays(m.pattern, m.color_a, m.color_b, m.scale_m, m.seed, m.emission, m.gloss, m.mirror),
        LightArrays(
            light.position,
            light.color,
            light.shadow,
            light.softness,
            light.ambient,
            np.array(scene.size_m),
            light.shadow_low,
            light.shadow_high,
        ),
    )


def shadow_cubes(primitives: Primitives, position: Float64, resolution: int) -> Float32:
    """Depth (N, 6, S, S) round each light; see ``Lights.shadow``. Misses are inf."""
    keep = primitives.casts_shadow
    shape, center, half, rotation = (
        primitives.shape[keep],
        primitives.center[keep],
        primitives.half[keep],
        primitives.rotation[keep],
    )
    cubes = np.empty((len(position), 6, resolution, resolution), np.float32)
    focal, middle = resolution / 2.0, resolution / 2.0 - 0.5
    for light, origin in enumerate(position):
        for face in range(6):
            axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
            axes = np.zeros((3, 3))
            axes[(axis + 1) % 3, 0] = axes[(axis + 2) % 3, 1] = 1.0
            axes[axis, 2] = sign
            depth, _ = cast_pixels(
                shape, center, half, rotation, origin, axes, focal, focal, middle, middle, resolution, resolution
            )
            cubes[light, face] = depth
    return cubes


def extremes(cubes: Float32) -> tuple[Float32, Float32]:
    """Least and greatest depth within two pixels (5x5) of each pixel of shadow cubes (N, 6, S, S)."""
    window = np.ones((5, 5), np.uint8)
    low, high = np.empty_like(cubes), np.empty_like(cubes)
    for index in np.ndindex(cubes.shape[:2]):
        low[index] = cv2.erode(cubes[index], window, borderType=cv2.BORDER_REPLICATE)
        high[index] = cv2.dilate(cubes[index], window, borderType=cv2.BORDER_REPLICATE)
    return low, high
