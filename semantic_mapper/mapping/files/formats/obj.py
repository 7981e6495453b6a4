"""Wavefront OBJ with its MTL: a mesh whose faces are grouped by class, one material a class."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapMesh
from semantic_mapper.types import UInt8


def write_obj(
    path: Path, mesh: MapMesh, label_set: LabelSet, *, class_materials: bool, scale_known: bool = True
) -> tuple[Path, Path]:
    """Write ``path`` and, beside it, the material library of the same stem (.mtl).

    OBJ knows neither units nor an up axis: vertices are in the world frame, metres, to the micrometre. Each has its
    colour behind its position (``v x y z r g b``), as most programs read it. A face is of the class that most of its
    corners are of (the first one's where all differ); material ``ID_NAME`` stands for a class, ``ID_unknown`` for none.

    Args:
        class_materials: Whether materials have the colours of their classes; else they are white, so that programs
            which multiply both show the colours of the vertices.
        scale_known: Whether lengths are metres; a comment says where not.

    Returns:
        The two files.

    Raises:
        MapError: a file cannot be written.
    """
    library = path.with_suffix(".mtl")
    names = {i: _material(i, name) for i, name in zip(label_set.ids, label_set.names, strict=True)}
    names[label_set.ignore_id] = _material(label_set.ignore_id, "unknown")
    label = face_labels(mesh)
    used = np.unique(label)
    with atomic_write(library, raises=MapError) as file:
        for class_id in used.tolist():
            color = label_set.colorize(np.array(class_id, np.uint8)) / 255 if class_materials else np.ones(3)
            values = " ".join(f"{c:.6f}" for c in color)
            file.write(f"newmtl {names[class_id]}\nKd {values}\nKa 0 0 0\nKs 0 0 0\nillum 1\n\n".encode())
    rows = np.concatenate((mesh.vertices.astype(np.float64), mesh.rgb / 255), axis=1).tolist()
    with atomic_write(path, raises=MapError) as file:
        file.write(b"" if scale_known else b"# scale: unknown\n")
        file.write(f"mtllib {library.name}\n".encode())
        file.writelines(b"v %.6f %.6f %.6f %.4f %.4f %.4f\n" % tuple(row) for row in rows)
        for class_id in used.tolist():
            file.write(f"g {names[class_id]}\nusemtl {names[class_id]}\n".encode())
            corners = (mesh.faces[label == class_id].astype(np.int64) + 1).tolist()  # OBJ counts from 1
            file.writelines(b"f %d %d %d\n" % tuple(face) for face in corners)
    return path, library


def face_labels(mesh: MapMesh) -> UInt8:
    """Class id of each face, (F,) uint8: that of most corners, of the first one where all three differ."""
    a, b, c = mesh.label[mesh.faces].T
    return np.where(b == c, b, a).astype(np.uint8)


def _material(class_id: int, name: str) -> str:
    """Names of materials end at white space, and programs differ in which letters they know."""
    return f"{class_id}_{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)}"
