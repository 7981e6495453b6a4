"""Maps for other programs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.map_types import MapPoints

_PLY_VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("label", "u1"),
        ("confidence", "<f4"),
    ]
)
_PLY_TYPES = {"<f4": "float", "|u1": "uchar"}


def write_ply(path: Path, points: MapPoints) -> None:
    """Write points as binary little-endian PLY with x y z red green blue label confidence, metres.

    The file appears whole or not at all.

    Raises:
        MapError: the file cannot be written.
    """
    vertices = np.empty(len(points.xyz), _PLY_VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        vertices[name] = points.xyz[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        vertices[name] = points.rgb[:, column]
    vertices["label"] = points.label
    vertices["confidence"] = points.confidence
    names = _PLY_VERTEX.names or ()
    properties = "".join(f"property {_PLY_TYPES[_PLY_VERTEX[name].str]} {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(header.encode("ascii"))
            file.write(vertices.tobytes())
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise MapError(f"{path}: cannot write the point cloud: {error}") from error
