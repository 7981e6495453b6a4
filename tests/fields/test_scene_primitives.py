"""Intervals of rays inside of primitives, against points tested one by one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.fields.scene.primitives import Primitive, closed_mesh, triangulate
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.types import Float64, RayBatch

L_SHAPE = np.array(((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)), np.float64) - 0.8
TURNED = pose_matrix(np.array((0.3, -0.2, 0.1)), np.array((0.2, -0.3, 0.4, 0.8)))


def box(number: int = 1, size: tuple[float, float, float] = (1.0, 2.0, 0.5), T: Float64 = TURNED) -> Primitive:
    return Primitive(number, "chair", "box", T, np.array(size), thing=True)


def prism() -> Primitive:
    return replace(box(2), shape="prism", polygon=L_SHAPE, size=np.array((2.0, 2.0, 1.5)))


def ball() -> Primitive:
    return replace(box(3), shape="ellipsoid", size=np.array((1.5, 1.0, 2.5)))


def inside(primitive: Primitive, points: Float64) -> NDArray[np.bool_]:
    """Whether points are inside, from the shape itself."""
    local = (points - primitive.T_world_box[:3, 3]) @ primitive.T_world_box[:3, :3]
    if primitive.shape == "box":
        return np.all(np.abs(local) <= primitive.size / 2, axis=-1)
    if primitive.shape == "ellipsoid":
        return np.asarray(((2 * local / primitive.size) ** 2).sum(-1) <= 1)
    polygon = primitive.polygon
    assert polygon is not None
    x, y = local[..., 0], local[..., 1]
    crossings = np.zeros(x.shape, int)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        if y0 != y1:
            crossings += ((y0 <= y) != (y1 <= y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return (crossings % 2 == 1) & (np.abs(local[..., 2]) <= primitive.size[2] / 2)


def rays_of(origin: Float64, direction: Float64, near: float = 0.0) -> RayBatch:
    o, d = torch.from_numpy(origin).float(), torch.from_numpy(direction).float()
    nothing = torch.zeros(len(o))
    return RayBatch(o, d, nothing + near, nothing + 10, nothing)


@pytest.mark.parametrize("primitive", [box(), prism(), ball()], ids=lambda p: p.shape)
def test_intervals_are_where_points_are_inside(primitive: Primitive) -> None:
    rng = np.random.default_rng(0)
    origin, direction = rng.normal(size=(300, 3)), rng.normal(size=(300, 3))
    found = PrimitiveSet([primitive]).intervals(rays_of(origin, direction))
    z = np.tile(np.linspace(0, 4, 200), (300, 1))
    points = origin.astype(np.float32)[:, None] + z[..., None] * direction.astype(np.float32)[:, None]
    expected = inside(primitive, points)
    said = found.inside(torch.from_numpy(z).float()).any(-1).numpy()
    assert 0.01 < expected.mean() < 0.9
    wrong = (said != expected).mean()
    assert wrong < (0.02 if primitive.shape == "ellipsoid" else 0.0005)  # a ball of flat faces
    if primitive.shape == "prism":
        assert (found.count == 2).any()


def test_meshes_face_outwards_whatever_the_order_of_their_corners() -> None:
    vertices, faces = prism().mesh()
    mixed = faces.copy()
    mixed[::2] = mixed[::2, ::-1]
    for v, f in ((vertices, faces), closed_mesh(vertices, mixed)):
        a, b, c = (v[f[:, i]] for i in range(3))
        assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(4.5)


def test_open_meshes_and_bad_outlines_are_refused() -> None:
    vertices, faces = box().mesh()
    with pytest.raises(ConfigError, match="3 of 18 edges"):
        closed_mesh(vertices, faces[1:])
    with pytest.raises(ConfigError, match="vertices 0 to 7"):
        closed_mesh(vertices, faces + 1)
    with pytest.raises(ConfigError, match="outline"):
        triangulate(np.array(((0, 0), (1, 1), (1, 0), (0, 1)), np.float64))
    broken = replace(box(7), shape="mesh", vertices=vertices, faces=faces[1:])
    with pytest.raises(ConfigError, match=r"box 7 \(chair\)"):
        PrimitiveSet([broken])
