"""KLEVR: simple solids on a grey floor, whose class is their shape alone (Vora et al., NeSF, 2021, section 4).

Everything is a pure function of (version, seed, frame). What NeSF renders with Kubric is rendered here by the caster of
the rooms: sun, ambient light and hard shadows instead of path tracing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np

from research.scenes.daylight import Daylight, pose_of, shadow_map, sun_camera
from research.scenes.materials import Material, Pattern, display_hsv, material_table
from research.scenes.primitives import Assembly, Part, pack, rotation_z, turned_parts
from research.scenes.render import render_view
from research.scenes.scene import NO_LAMPS, Scene
from research.scenes.sequence import FRAME_NS, RoomView
from semantic_mapper.labels import KLEVR
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

KLEVR_VERSION = 1  # part of every seed: a change that alters a scene raises it
BOX_LOW_M, BOX_HIGH_M = (-4.1, -4.1, -0.1), (4.1, 4.1, 3.1)  # what holds every scene
SOLIDS = KLEVR.names[1:]

Variant = Literal["upright", "float"]

_CODE = 1337  # tells the random streams of this suite from those of others
_SCENE_STREAM, _CAMERA_STREAM = 0, 1
_FLOOR_M = 8.0
_CAMERA_M = 11.26  # from the origin
_FOCAL_PER_WIDTH = 35.0 / 32.0
_COUNT = (4, 12)
_SCALE_M = (0.7, 1.4)  # longest side of a solid
_TRIES = 100
_SUN_M, _SUN_REACH_M, _SHADOW_SIZE = 2000.0, 7.0, 512
_TEETH = 8
_WHITE = (3.0, 3.0, 3.0)  # linear light that the camera shows as 255


def klevr_camera(width: int) -> CameraIntrinsics:
    """A square picture of 49.1 degrees."""
    focal, middle = _FOCAL_PER_WIDTH * width, (width - 1) / 2
    return CameraIntrinsics(focal, focal, middle, middle, width, width)


def make_klevr(seed: int, variant: Variant = "upright") -> Scene:
    """The scene of ``seed``: 4 to 12 solids of any hue that do not touch.

    Args:
        seed: Not negative.
        variant: "upright" = resting on the floor, turned about the vertical; "float" = in the air, turned any way.
    """
    rng = np.random.default_rng((_CODE, KLEVR_VERSION, seed, _SCENE_STREAM))
    kinds = rng.integers(len(SOLIDS), size=int(rng.integers(_COUNT[0], _COUNT[1] + 1)))
    grey = rng.uniform(0.2, 0.4)
    hues = rng.uniform(size=len(kinds))
    materials = [_matte((grey, grey, grey))] + [_matte(display_hsv(hue, 1.0, 1.0)) for hue in hues]
    solids = [_solid(SOLIDS[kind], rng.uniform(*_SCALE_M), 1 + k) for k, kind in enumerate(kinds)]
    floor = Assembly("background")
    floor.box(0, (0.0, 0.0, -0.05), (_FLOOR_M, _FLOOR_M, 0.1))
    placed = None
    while placed is None:
        placed = _placed(solids, variant, rng)
    primitives = pack([floor.parts, *placed], KLEVR)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(35.0, 65.0))
    sun, T_world_sun = sun_camera(np.array([0.0, 0.0, 1.0]), azimuth, elevation, _SUN_M)
    focal = _SHADOW_SIZE / 2 * _SUN_M / _SUN_REACH_M
    shadow = shadow_map(primitives, T_world_sun, focal, _SHADOW_SIZE)
    daylight = Daylight("background", sun, shadow, T_world_sun, focal, 0.06, 0.5, (_WHITE, _WHITE))
    nowhere = (np.inf, np.inf, np.inf)
    return Scene(seed, variant, nowhere, primitives, material_table(materials), NO_LAMPS, (), KLEVR, daylight)


def klevr_pose(seed: int, frame: int) -> Float64:
    """T_world_camera (4, 4) of a frame: anywhere on the upper half of a sphere round the origin, looking at it."""
    rng = np.random.default_rng((_CODE, KLEVR_VERSION, seed, _CAMERA_STREAM, frame))
    azimuth, pitch = rng.uniform(0, 2 * np.pi), np.arcsin(rng.uniform(0.1, 1.0))
    toward = np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
    return pose_of(_CAMERA_M * toward, azimuth + np.pi, -pitch)


def klevr_views(
    seed: int, frames: Iterable[int], intrinsics: CameraIntrinsics, *, variant: Variant = "upright"
) -> Iterator[RoomView]:
    """Labelled views (ids of ``labels.KLEVR``) by a perfect camera, in the order of ``frames``.

    Args:
        seed: Of the scene and its cameras.
        frames: Numbers of frames, each of which is the same whichever others are rendered.
        intrinsics: From ``klevr_camera``, or any other.
        variant: See ``make_klevr``.
    """
    scene = make_klevr(seed, variant)
    for number in frames:
        pose = klevr_pose(seed, number)
        view = render_view(scene, intrinsics, pose)
        frame = PosedFrame(
            stamp_ns=(number + 1) * FRAME_NS,
            seq=number,
            camera_id="klevr",
            rgb=view.rgb,
            depth_m=view.depth_m,
            label=view.label,
            intrinsics=intrinsics,
            T_world_camera=pose,
            pose_source="klevr",
        )
        yield RoomView(frame, view, pose)


def _matte(color: tuple[float, float, float]) -> Material:
    return Material(Pattern.FLAT, color, color, 1.0, 0)


def _solid(name: str, size: float, material: int) -> Assembly:
    """A solid round the origin whose longest side is ``size`` metres."""
    solid, thick = Assembly(name), 0.3 * size
    if name == "cube":
        solid.box(material, (0, 0, 0), (size, size, size))
    elif name == "cylinder":
        solid.cylinder(material, (0, 0, 0), (size, size, size))
    elif name == "sphere":
        solid.ellipsoid(material, (0, 0, 0), (size, size, size))
    elif name == "torus":
        solid.torus(material, (0, 0, 0), (size, size, thick))
    else:
        solid.cylinder(material, (0, 0, 0), (0.76 * size, 0.76 * size, thick))
        for angle in np.arange(_TEETH) * 2 * np.pi / _TEETH:
            center = (0.41 * size * float(np.cos(angle)), 0.41 * size * float(np.sin(angle)), 0.0)
            solid.box(material, center, (0.18 * size, 0.15 * size, thick), yaw=float(angle))
    return solid


def _placed(solids: list[Assembly], variant: Variant, rng: np.random.Generator) -> list[list[Part]] | None:
    """Parts of each solid in the world; None where one found no place beside the others."""
    taken: list[tuple[Float64, float]] = []
    groups: list[list[Part]] = []
    for solid in solids:
        low, high = solid.bounds()
        half = (high - low) / 2
        floats = variant == "float"
        reach = float(np.linalg.norm(half if floats else half[:2])) if solid.label == "cube" else _reach(half, floats)
        for _ in range(_TRIES):
            middle = rng.uniform(-_FLOOR_M / 2 + reach, _FLOOR_M / 2 - reach, 3)
            middle[2] = rng.uniform(reach, BOX_HIGH_M[2] - reach) if floats else half[2]
            axes = slice(None) if floats else slice(2)  # circles round what rests, spheres round what floats
            if all(np.linalg.norm((middle - other)[axes]) > reach + far for other, far in taken):
                break
        else:
            return None
        taken.append((middle, reach))
        turn = _any_rotation(rng) if floats else rotation_z(rng.uniform(0, 2 * np.pi))
        groups.append(turned_parts(solid, turn, middle))
    return groups


def _reach(half: Float64, floats: bool) -> float:
    """Radius of the circle, or of the sphere, round a round solid of half extents (3,)."""
    return float(np.hypot(half[0], half[2])) if floats else float(half[0])


def _any_rotation(rng: np.random.Generator) -> Float64:
    """(3, 3), uniform over all rotations."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
