"""Scenes for `research.experiments.scene_grid`: matte objects on a grey floor before white."""

from __future__ import annotations

import numpy as np

from research.scenes.materials import Material, Pattern, material_table
from research.scenes.primitives import Assembly, pack, place_parts
from research.scenes.render import render_view
from research.scenes.scene import Lights, Scene, extremes, shadow_cubes
from semantic_mapper.geometry import look_at
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

BOX_M = (-4.1, -4.1, -0.2, 4.1, 4.1, 3.0)  # that the objects stand in
RADIUS_M = 11.3  # of the sphere that cameras stand on
SIDE_PX = 72
FOCAL_PX = 79.0  # the box fills the image


def objects_scene(seed: int) -> Scene:
    """4 to 12 boxes, cylinders and ellipsoids of one plain colour each, on a grey floor."""
    rng = np.random.default_rng(seed)
    materials = [Material(Pattern.PLAIN, (0.35, 0.35, 0.35), (0.35, 0.35, 0.35), 10.0, 0)]
    floor = Assembly("floor")
    floor.box(0, (0.0, 0.0, -0.05), (8.0, 8.0, 0.1))
    groups, placed = [floor.parts], np.zeros((0, 3))
    for number in range(int(rng.integers(4, 13))):
        size = rng.uniform(0.5, 1.1)
        center = rng.uniform(-3, 3, 2)
        if len(placed) and (np.linalg.norm(placed[:, :2] - center, axis=1) < placed[:, 2] + size).any():
            continue
        placed = np.append(placed, [[*center, size]], axis=0)
        color = tuple(rng.uniform(0.02, 0.8, 3).tolist())
        materials.append(Material(Pattern.PLAIN, color, color, 10.0, number))
        item = Assembly("box")
        make = (item.box, item.cylinder, item.ellipsoid)[int(rng.integers(3))]
        make(len(materials) - 1, (0.0, 0.0, size), (1.6 * size, 1.6 * size, 2 * size), label="table")
        groups.append(place_parts(item, rng.uniform(0, 6.3), np.array([*center, 0.0])))
    primitives = pack(groups)
    position = np.array([[4.0, -5.0, 9.0], [-6.0, 2.0, 7.0]])
    cubes = shadow_cubes(primitives, position, 192)
    lights = Lights(
        position, np.array([[12.0] * 3, [6.0] * 3]), cubes, *extremes(cubes), np.array([0.8, 0.8]), np.full(3, 0.3)
    )
    return Scene(seed, "objects", (8.0, 8.0, 3.0), primitives, material_table(materials), lights)


def object_frames(scene: Scene, count: int, seed: int) -> list[PosedFrame]:
    """Views from a half sphere round the objects, white where nothing is."""
    rng = np.random.default_rng((seed, 1))
    k = CameraIntrinsics(FOCAL_PX, FOCAL_PX, (SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2, SIDE_PX, SIDE_PX)
    return [_frame(scene, k, _on_sphere(rng), number) for number in range(count)]


def _on_sphere(rng: np.random.Generator) -> Float64:
    around, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 0.95)
    flat = np.sqrt(1 - height**2)
    eye = RADIUS_M * np.array([flat * np.cos(around), flat * np.sin(around), height])
    return look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]))


def _frame(scene: Scene, k: CameraIntrinsics, T_world_camera: Float64, number: int) -> PosedFrame:
    view = render_view(scene, k, T_world_camera)
    rgb = np.where(view.exact_depth_m[..., None] > 0, view.rgb, np.uint8(255))
    return PosedFrame(number * 10**8, number, "objects", rgb, None, view.label, k, T_world_camera)
