"""Boxes, ellipsoids, prisms and meshes in the world that say of what class their inside is.

All shapes become closed triangle meshes; ``boxes`` gives the intervals of rays inside each, in torch.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import interpolate_pose
from semantic_mapper.types import Float64, Int64

ShapeName = Literal["box", "ellipsoid", "prism", "mesh"]
AROUND, RINGS = 20, 10  # of the triangles of an ellipsoid
ROUNDING = 1e-9  # of a size: nothing is moved by less
ALONE_NS = 50_000_000  # a pose at one time alone holds for so long before and after


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """One annotated piece of space."""

    id: int  # 1 to 65535, of this primitive alone
    class_name: str  # of the label set
    # What it is, in the axes of ``T_world_box``, whose origin is the middle of its bounds (``centred``)
    shape: ShapeName
    T_world_box: Float64  # (4, 4) float64 pose; of one that moves, its first
    size: Float64  # (3,) metres, the sides of a box, the diameters of an ellipsoid, the bounds of a prism or a mesh
    thing: bool  # whether it is one countable thing, or part of some stuff
    # (N, 2) metres, outline of a prism in x and y; it reaches from -size[2] / 2 to size[2] / 2 in z
    polygon: Float64 | None = None
    # (V, 3) float64 metres in the box's axes and (F, 3) int64, of a mesh
    vertices: Float64 | None = None
    faces: Int64 | None = None
    # Of one that moves: (ns, (4, 4) pose) at each time that is known
    stamps: tuple[tuple[int, Float64], ...] | None = None

    @property
    def moves(self) -> bool:
        """Whether it is at different places at different times."""
        return self.stamps is not None

    def pose_at(self, stamp_ns: int) -> Float64 | None:
        """Its pose (4, 4) at a time, between two stamps on the way from one to the other; None by more than half of
        the median gap of the stamps before the first or after the last."""
        if self.stamps is None:
            return self.T_world_box
        known = sorted(self.stamps, key=lambda entry: entry[0])
        times = np.array([t for t, _ in known], np.int64)
        beyond = max(int(times[0]) - stamp_ns, stamp_ns - int(times[-1]))
        if beyond > (np.median(np.diff(times)) / 2 if len(times) > 1 else ALONE_NS):
            return None
        after = int(np.clip(np.searchsorted(times, stamp_ns), 0, len(times) - 1))
        if beyond >= 0 or times[after] == stamp_ns:
            return known[after][1]
        fraction = (stamp_ns - int(times[after - 1])) / int(times[after] - times[after - 1])
        return interpolate_pose(known[after - 1][1], known[after][1], fraction)

    def mesh(self) -> tuple[Float64, Int64]:
        """Vertices (V, 3) float64 world metres and faces (F, 3) int64 of its closed surface, facing outwards.
        Raises ConfigError: the surface is open, or has no volume."""
        vertices, faces = _local_mesh(self)
        vertices, faces = closed_mesh(vertices, faces)
        return vertices @ self.T_world_box[:3, :3].T + self.T_world_box[:3, 3], faces


def moved(box: Primitive, move: Callable[[Float64], Float64]) -> Primitive:
    """A primitive with all its poses (4, 4) changed alike."""
    stamps = None if box.stamps is None else tuple((when, move(pose)) for when, pose in box.stamps)
    return replace(box, T_world_box=move(box.T_world_box), stamps=stamps)


def centred(box: Primitive) -> Primitive:
    """The same piece of space, with the origin of its axes in the middle of its outline or mesh."""
    middle = np.zeros(3)
    if box.polygon is not None:
        middle[:2] = (box.polygon.min(0) + box.polygon.max(0)) / 2
    if box.vertices is not None:
        middle = (box.vertices.min(0) + box.vertices.max(0)) / 2
    if np.abs(middle).max() <= ROUNDING * box.size.max():
        return box
    shift = np.eye(4)
    shift[:3, 3] = middle
    box = moved(box, lambda pose: pose @ shift)
    if box.polygon is not None:
        return replace(box, polygon=box.polygon - middle[:2])
    assert box.vertices is not None
    return replace(box, vertices=box.vertices - middle)


def resized(box: Primitive, size: Float64) -> Primitive:
    """A primitive of another size (3,) along its own axes round its middle; outlines and meshes scale with it."""
    ratio = size / box.size
    if box.polygon is not None:
        return replace(box, size=size, polygon=box.polygon * ratio[:2])
    if box.vertices is not None:
        return replace(box, size=size, vertices=box.vertices * ratio)
    return replace(box, size=size)


def closed_mesh(vertices: Float64, faces: Int64) -> tuple[Float64, Int64]:
    """A mesh with each place once and all triangles facing outwards; polygons of 4 corners become triangles.
    Raises ConfigError: a face with a vertex that is not there, an edge of other than two triangles, or no volume."""
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ConfigError(f"faces must name vertices 0 to {len(vertices) - 1}")
    extent = float(np.ptp(vertices, axis=0).max())
    places, place_of = np.unique(np.round(vertices / max(extent * ROUNDING, 1e-12)), axis=0, return_inverse=True)
    first = np.zeros(len(places), np.int64)
    first[place_of.ravel()] = np.arange(len(vertices))
    faces = place_of.ravel()[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    used = Counter(tuple(sorted(edge)) for face in faces.tolist() for edge in _edges(face))
    odd = sum(n != 2 for n in used.values())
    if odd or not used:
        raise ConfigError(
            f"the surface is open: {odd} of {len(used)} edges do not join exactly two triangles; close the mesh"
        )
    vertices = vertices[first]
    faces = _facing_outwards(vertices, faces)
    return vertices, faces


def _edges(face: Sequence[int]) -> list[tuple[int, int]]:
    return [(face[0], face[1]), (face[1], face[2]), (face[2], face[0])]


def _facing_outwards(vertices: Float64, faces: Int64) -> Int64:
    """The same triangles, turned so that each connected surface has its front outside."""
    of_edge: dict[tuple[int, int], list[int]] = {}
    for number, face in enumerate(faces.tolist()):
        for a, b in _edges(face):
            of_edge.setdefault((min(a, b), max(a, b)), []).append(number)
    turned = faces.copy()
    seen = np.zeros(len(faces), np.bool_)
    for start in range(len(faces)):
        if seen[start]:
            continue
        piece, seen[start] = [start], True
        for number in piece:
            for a, b in _edges(turned[number].tolist()):
                for other in of_edge[min(a, b), max(a, b)]:
                    if seen[other]:
                        continue
                    if (a, b) in _edges(turned[other].tolist()):
                        turned[other] = turned[other][::-1]
                    seen[other] = True
                    piece.append(other)
        a, b, c = (vertices[turned[piece, i]] - vertices[turned[start, 0]] for i in range(3))
        volume = float((a * np.cross(b, c)).sum())
        if volume == 0:
            raise ConfigError("the surface has no volume; give a solid")
        if volume < 0:
            turned[piece] = turned[piece, ::-1]
    return turned


def _local_mesh(primitive: Primitive) -> tuple[Float64, Int64]:
    """Vertices in the box's axes, and faces."""
    match primitive.shape:
        case "box":
            square = np.array(((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
            return _prism(square * primitive.size[:2], float(primitive.size[2]))
        case "prism":
            assert primitive.polygon is not None
            return _prism(primitive.polygon, float(primitive.size[2]))
        case "ellipsoid":
            vertices, faces = _sphere()
            return vertices * primitive.size, faces
        case "mesh":
            assert primitive.vertices is not None and primitive.faces is not None
            return primitive.vertices, primitive.faces


def _prism(polygon: Float64, height: float) -> tuple[Float64, Int64]:
    n = len(polygon)
    x, y = polygon.T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:  # clockwise
        polygon = polygon[::-1]
    low, high = (np.c_[polygon, np.full(n, z)] for z in (-height / 2, height / 2))
    cap = triangulate(polygon)
    i, j = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate((np.stack((i, j, j + n), 1), np.stack((i, j + n, i + n), 1)))
    return np.concatenate((low, high)), np.concatenate((cap[:, ::-1], cap + n, sides))


def _sphere() -> tuple[Float64, Int64]:
    """A sphere of diameter 1 as wide as the round one has volume."""
    theta, phi = np.pi * np.arange(1, RINGS)[:, None] / RINGS, 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi), -1)
    vertices = 0.5 * np.concatenate(([(0, 0, 1)], ring.reshape(-1, 3), [(0, 0, -1)]))
    # Here, since training machines may lack SciPy.
    from scipy.spatial import ConvexHull  # pyright: ignore[reportMissingTypeStubs]

    hull = ConvexHull(vertices)
    return vertices * (math.pi / 6 / hull.volume) ** (1 / 3), hull.simplices.astype(np.int64)


def triangulate(polygon: Float64) -> Int64:
    """Triangles (N - 2, 3) of a simple polygon (N, 2) whose corners go round anticlockwise.
    Raises ConfigError: it crosses or touches itself, or all its corners lie on a line."""
    left = list(range(len(polygon)))
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        for k in range(len(left)):
            a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
            if _cross(polygon, a, b, c) <= 0:
                continue
            others = [p for p in left if p not in (a, b, c)]
            if not any(_in_triangle(polygon, p, a, b, c) for p in others):
                triangles.append((a, b, c))
                del left[k]
                break
        else:
            raise ConfigError("the outline crosses or touches itself; give a simple polygon")
    if len(left) < 3 or _cross(polygon, *left) <= 0:
        raise ConfigError("the outline has no area; give a simple polygon of at least 3 corners")
    return np.array([*triangles, tuple(left)], np.int64)


def _cross(polygon: Float64, a: int, b: int, c: int) -> float:
    ab, ac = polygon[b] - polygon[a], polygon[c] - polygon[a]
    return float(ab[0] * ac[1] - ab[1] * ac[0])


def _in_triangle(polygon: Float64, p: int, a: int, b: int, c: int) -> bool:
    return all(_cross(polygon, i, j, p) >= 0 for i, j in ((a, b), (b, c), (c, a)))
