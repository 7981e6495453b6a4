"""PLY, binary little-endian: points, or a mesh. World frame, metres; class ids with their names as comments.

``comment label 3 chair`` says what the id 3 of the property ``label`` means. Names are ASCII, with Python's escapes for
what is not, backslashes included: ``name.encode().decode("unicode_escape")`` gives the name back.

``comment scale: unknown`` stands where lengths are not metres.

Where depth was computed somewhere, there is a property ``measured``: 0 there, 1 where a sensor measured the surface.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapMesh, MapPoints
from semantic_mapper.types import Float32

_VERTEX = [
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("red", "u1"),
    ("green", "u1"),
    ("blue", "u1"),
    ("label", "u1"),
    ("confidence", "<f4"),
]
_MEASURED = ("measured", "u1")
MAX_NAME = 200  # characters of a class name in a comment
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])
_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, points: MapPoints, label_set: LabelSet, *, scale_known: bool = True) -> None:
    """Write points as x y z red green blue label confidence; a comment names each class.

    Raises:
        MapError: the file cannot be written.
    """
    vertices = _vertices(points.xyz, points)
    _write(path, vertices, np.empty(0, _FACE), label_set, mesh=False, scale_known=scale_known)


def write_ply_mesh(path: Path, mesh: MapMesh, label_set: LabelSet, *, scale_known: bool = True) -> None:
    """Write a triangle mesh: vertices as ``write_ply`` has them, faces as lists ``vertex_indices``.

    Raises:
        MapError: the file cannot be written.
    """
    faces = np.empty(len(mesh.faces), _FACE)
    faces["count"], faces["corners"] = 3, mesh.faces
    _write(path, _vertices(mesh.vertices, mesh), faces, label_set, mesh=True, scale_known=scale_known)


def _vertices(xyz: Float32, surface: MapPoints | MapMesh) -> NDArray[np.void]:
    computed = surface.measured is not None and not surface.measured.all()
    vertices = np.empty(len(xyz), np.dtype([*_VERTEX, _MEASURED] if computed else _VERTEX))
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = surface.rgb[:, column]
    vertices["label"] = surface.label
    vertices["confidence"] = surface.confidence
    if computed:
        vertices[_MEASURED[0]] = surface.measured
    return vertices


def _write(
    path: Path,
    vertices: NDArray[np.void],
    faces: NDArray[np.void],
    label_set: LabelSet,
    *,
    mesh: bool,
    scale_known: bool,
) -> None:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if scale_known else ["comment scale: unknown"]
    lines += [f"comment label {i} {_escaped(n)}" for i, n in zip(label_set.ids, label_set.names, strict=True)]
    lines.append(f"comment label {label_set.ignore_id} unknown")
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property {_TYPES[vertices.dtype[name].str]} {name}" for name in vertices.dtype.names or ()]
    if mesh:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines.append("end_header")
    with atomic_write(path, raises=MapError) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _escaped(name: str) -> str:
    """One line of printable ASCII; Open3D's reader writes past its buffer at lines above 1,000 characters."""
    while len(escaped := name.encode("unicode_escape").decode("ascii")) > MAX_NAME:
        name = name[:-1]  # a whole letter, however long its escape is
    return escaped
