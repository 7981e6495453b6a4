"""Torus and prism: what rays hit, and the normals there, against the equations of the shapes."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes.fast_cast import cast_pixels
from research.scenes.fast_shade import PrimitiveArrays, surface_normals
from research.scenes.primitives import Assembly, Primitives, Shape, pack, rotation_x, rotation_z
from semantic_mapper.types import Float64

SIZE, FOCAL = 200, 220.0
CAMERA = (np.zeros(3), np.eye(3), FOCAL, FOCAL, SIZE / 2, SIZE / 2)


def one(shape: Shape, half: tuple[float, float, float], turn: Float64) -> Primitives:
    assembly = Assembly("wall")
    assembly.add(shape, 0, (0.0, 0.0, 4.0), (2 * half[0], 2 * half[1], 2 * half[2]))
    p = pack([assembly.parts])
    p.rotation[0] = turn
    return p


def cast(p: Primitives) -> tuple[Float64, np.ndarray]:
    return cast_pixels(p.shape, p.center, p.half, p.rotation, *CAMERA, SIZE, SIZE)


def own_points(p: Primitives, depth: Float64) -> Float64:
    v, u = np.nonzero(np.isfinite(depth))
    z = depth[v, u]
    world = np.stack(((u - SIZE / 2) / FOCAL * z, (v - SIZE / 2) / FOCAL * z, z), 1)
    return (world - p.center[0]) @ p.rotation[0] / p.half[0]


TURNS = (np.eye(3), rotation_z(0.7) @ rotation_x(1.1), rotation_x(np.pi / 2), rotation_z(2.0) @ rotation_x(-2.4))


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("half", [(1.0, 1.0, 0.3), (1.1, 0.7, 0.5)])
def test_rays_hit_a_torus_first_where_its_equation_says(turn: Float64, half: tuple[float, float, float]) -> None:
    p = one(Shape.TORUS, half, turn)
    depth, _ = cast(p)
    q = own_points(p, depth)
    assert len(q) > 1500
    np.testing.assert_allclose(np.hypot((np.hypot(q[:, 0], q[:, 1]) - 0.7) / 0.3, q[:, 2]), 1.0, atol=1e-5)
    # No ray that is found to miss, or to hit later, is inside anywhere before: sampled densely along each.
    v, u = np.mgrid[0:SIZE:7, 0:SIZE:7]
    t = np.linspace(2.5, 5.5, 1500)
    ray = np.stack(((u - SIZE / 2) / FOCAL, (v - SIZE / 2) / FOCAL, np.ones(u.shape)), -1)
    x = (ray[..., None, :] * t[:, None] - p.center[0]) @ p.rotation[0] / p.half[0]
    inside = np.hypot((np.hypot(x[..., 0], x[..., 1]) - 0.7) / 0.3, x[..., 2]) < 0.999
    first = np.where(inside.any(-1), t[inside.argmax(-1)], np.inf)
    assert (depth[v, u] <= first + 1e-9).all()


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("shape", [Shape.TORUS, Shape.PRISM, Shape.CYLINDER, Shape.FRUSTUM])
def test_normals_are_those_of_the_depth_by_finite_differences(shape: Shape, turn: Float64) -> None:
    p = one(shape, (1.0, 0.8, 0.4), turn)
    depth, index = cast(p)
    arrays = PrimitiveArrays(p.shape, p.center, p.half, p.rotation, p.material)
    normal = surface_normals(depth, index, arrays, *CAMERA)
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    z = np.where(np.isfinite(depth), depth, np.nan)
    world = np.stack(((u - SIZE / 2) / FOCAL * z, (v - SIZE / 2) / FOCAL * z, z), -1)
    with np.errstate(invalid="ignore"):
        found = np.cross(world[2:, 1:-1] - world[:-2, 1:-1], world[1:-1, 2:] - world[1:-1, :-2])
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
        agree = np.abs((found * normal[1:-1, 1:-1]).sum(-1))
    smooth = np.isfinite(agree) & ((normal * world).sum(-1)[1:-1, 1:-1] < -0.8)  # seen at no grazing angle
    assert smooth.sum() > 500
    assert np.quantile(agree[smooth], 0.03) > 0.995, "edges aside"
    hit = np.isfinite(depth)
    assert ((normal * world)[hit].sum(-1) < 1e-9).mean() > 0.995, "they face the camera, but for edges"
    np.testing.assert_allclose(np.linalg.norm(normal[hit], axis=1), 1.0)
    assert (normal[~hit] == 0).all()


@pytest.mark.parametrize("corners", [
    [(-1.0, -0.8), (1.0, -0.8), (0.1, 0.9)],
    [(-0.9, -0.7), (0.4, -1.0), (1.1, 0.2), (0.3, 0.9), (-0.8, 0.5)],
    [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)],
])  # fmt: skip
def test_a_polygon_of_prisms_has_its_outline_and_no_gap(corners: list[tuple[float, float]]) -> None:
    assembly = Assembly("wall")
    assembly.prism(0, corners, (3.0, 4.0))
    p = pack([assembly.parts])
    assert (p.shape == Shape.PRISM).all()
    depth, _ = cast(p)
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    x, y = (u - SIZE / 2) / FOCAL * 3.0, (v - SIZE / 2) / FOCAL * 3.0
    ends = np.array([*corners[1:], corners[0]])
    away = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for (ax, ay), (bx, by) in zip(corners, ends, strict=True)]
    inside = np.min(away, axis=0)
    np.testing.assert_allclose(depth[inside > 1e-6], 3.0)
    assert (depth[(inside < -1e-6)] > 3.0 + 1e-9).all()


def test_a_camera_inside_sees_the_inside_of_nothing() -> None:
    for shape in (Shape.TORUS, Shape.PRISM):
        p = one(shape, (1.0, 1.0, 0.3), np.eye(3))
        origin = p.center[0] + np.array([-0.7, 0.0, 0.0])
        depth, _ = cast_pixels(p.shape, p.center, p.half, p.rotation, origin, np.eye(3), *CAMERA[2:], SIZE, SIZE)
        assert np.isinf(depth).all()
