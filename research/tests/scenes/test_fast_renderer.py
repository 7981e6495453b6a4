"""The compiled renderer against the plain one on scenes that no room has, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from research.scenes import Scene, render_view
from research.scenes.fast_cast import cast_pixels
from research.scenes.fast_shade import shade_pixels
from research.scenes.materials import MaterialTable, Pattern
from research.scenes.primitives import Primitives, Shape
from research.scenes.scene import Lights, extremes, kernel_arrays, shadow_cubes
from research.tests.scenes.torch_renderer import render_view_torch
from semantic_mapper.errors import ShapeError
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics, Float64

CAMERA = CameraIntrinsics(fx=40.0, fy=42.0, cx=30.0, cy=22.0, width=64, height=48)


def random_turns(rng: np.random.Generator, count: int) -> Float64:
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q *= np.sign(np.einsum("pii->pi", r))[:, None]
    return q * np.linalg.det(q)[:, None, None]


def random_scene(seed: int, count: int = 21) -> Scene:
    rng = np.random.default_rng(seed)
    primitives = Primitives(
        shape=np.arange(count) % len(Shape),
        center=rng.uniform((-2, -1.5, 1), (2, 1.5, 4), (count, 3)),
        half=rng.uniform(0.1, 0.9, (count, 3)),
        rotation=random_turns(rng, count),
        label=np.full(count, ROOMS.ids[0], np.uint8),
        instance=np.arange(1, count + 1).astype(np.uint16),
        group=np.arange(count),
        material=np.arange(count) % len(Pattern),
        casts_shadow=np.ones(count, np.bool_),
    )
    kinds = len(Pattern)
    materials = MaterialTable(
        np.arange(kinds),
        rng.random((kinds, 3)),
        rng.random((kinds, 3)),
        rng.uniform(0.05, 0.4, kinds),
        rng.integers(0, 1 << 31, kinds),
        np.where(np.arange(kinds) % 3, 0.0, 0.2),
        np.where(np.arange(kinds) % 2, 0.0, 0.5),
        np.where(np.arange(kinds) % 4, 0.0, 0.6),
    )
    position = np.array([[0.0, 0.0, -0.5], [1.5, -2.5, 2.0]])
    cubes = shadow_cubes(primitives, position, 32)
    lights = Lights(position, np.ones((2, 3)), cubes, *extremes(cubes), np.array([0.5, 0.0]), np.full(3, 0.2))
    return Scene(seed, "test", (4.0, 4.0, 4.0), primitives, materials, lights)


@pytest.mark.parametrize("seed", range(3))
def test_every_shape_and_pattern_looks_as_in_the_plain_renderer(seed: int) -> None:
    scene, pose = random_scene(seed), np.eye(4)
    fast, plain = render_view(scene, CAMERA, pose), render_view_torch(scene, CAMERA, pose)
    same = fast.instance == plain.instance
    assert (~same).sum() <= 5  # ties at edges may fall either way
    assert len(np.unique(fast.instance)) > 6
    np.testing.assert_allclose(fast.depth_m[same], plain.depth_m[same], atol=1e-5)
    difference = np.abs(fast.rgb.astype(int) - plain.rgb.astype(int)).max(-1)
    assert (difference > 2).sum() <= 20


def test_a_scene_without_primitives_is_empty() -> None:
    none, pose = np.zeros((0, 3)), np.eye(4)
    camera = (pose[:3, 3], pose[:3, :3], 40.0, 40.0, 10.0, 10.0, 21, 15)
    depth, index = cast_pixels(np.zeros(0, np.int64), none, none, np.zeros((0, 3, 3)), *camera)
    assert depth.shape == index.shape == (15, 21)
    assert np.isinf(depth).all() and (index == -1).all()


def test_rays_from_nowhere_hit_nothing() -> None:
    p, pose = random_scene(0).primitives, np.eye(4)
    for origin in (np.full(3, np.nan), np.full(3, 1e300)):
        camera = (origin, pose[:3, :3], 40.0, 40.0, 10.0, 10.0, 21, 15)
        assert (cast_pixels(p.shape, p.center, p.half, p.rotation, *camera)[1] == -1).all()


def test_arrays_of_other_shapes_and_foreign_materials_are_refused() -> None:
    scene, pose = random_scene(0), np.eye(4)
    p = scene.primitives
    camera = (pose[:3, 3], pose[:3, :3], 40.0, 40.0, 10.0, 10.0)
    with pytest.raises(ShapeError, match="half"):
        cast_pixels(p.shape, p.center, p.half[1:], p.rotation, *camera, 21, 15)
    depth, index = cast_pixels(p.shape, p.center, p.half, p.rotation, *camera, 21, 15)
    with pytest.raises(ShapeError, match="index"):
        shade_pixels(depth, index[1:], *kernel_arrays(scene), *camera)
    foreign = replace(scene, primitives=replace(p, material=np.full(len(p), len(Pattern))))
    with pytest.raises(ShapeError, match=f"{len(Pattern)} materials"):
        shade_pixels(depth, index, *kernel_arrays(foreign), *camera)
    cut = replace(scene, lights=replace(scene.lights, shadow_low=scene.lights.shadow_low[:, :, 1:]))
    with pytest.raises(ShapeError, match="low"):
        shade_pixels(depth, index, *kernel_arrays(cut), *camera)
