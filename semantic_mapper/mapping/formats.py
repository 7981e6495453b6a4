"""A map as files of other programs: PLY and GLB (surface), NPZ (points).

Files hold the world frame, in metres unless they say "scale: unknown"; one that cannot be written is a ``MapError``. Of
PLY, ``comment label 3 chair`` says what the id 3 of ``label`` means; names are ASCII with Python's escapes. Where depth
was computed somewhere, PLY and NPZ have ``measured``: 0 there, 1 where a sensor measured the surface. GLB (glTF 2.0)
has y up: the mesh's node holds the rotation, vertices keep the coordinates of the world; colours are linear light, 16
bits so that sRGB's 8 survive."""

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapMesh, MapPoints
from semantic_mapper.types import Float64, UInt8

ColorBy = Literal["rgb", "class", "confidence"]
SurfaceT = TypeVar("SurfaceT", MapPoints, MapMesh)


def sure_points(points: MapPoints, min_confidence: float) -> MapPoints:
    """The points whose label is at least so sure; all of them for 0."""
    keep = points.confidence >= min_confidence
    measured = None if points.measured is None else points.measured[keep]
    return MapPoints(points.xyz[keep], points.rgb[keep], points.label[keep], points.confidence[keep], measured)


def sure_faces(mesh: MapMesh, min_confidence: float) -> MapMesh:
    """The faces all of whose corners are at least so sure, and their vertices; the whole mesh for 0."""
    if min_confidence <= 0:
        return mesh
    faces = mesh.faces[(mesh.confidence >= min_confidence)[mesh.faces].all(axis=1)]
    used, corners = np.unique(faces, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int32)
    measured = None if mesh.measured is None else mesh.measured[used]
    return MapMesh(mesh.vertices[used], faces, mesh.rgb[used], mesh.label[used], mesh.confidence[used], measured)


def colored(surface: SurfaceT, label_set: LabelSet, by: ColorBy) -> SurfaceT:
    """The surface with other colours: the camera's, those of the classes, or dark (0) to bright (1) for confidence."""
    if by == "rgb":
        return surface
    if by == "class":
        return dataclasses.replace(surface, rgb=label_set.colorize(surface.label))
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    rgb = np.asarray(table, np.uint8)[np.rint(surface.confidence * 255).astype(np.uint8)]
    return dataclasses.replace(surface, rgb=rgb)


MAX_NAME = 200  # characters of a class name in a comment
_PLY_NAMES = {"<f4": "float", "|u1": "uchar"}
_PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


def write_ply(path: Path, surface: MapPoints | MapMesh, label_set: LabelSet, *, scale_known: bool = True) -> None:
    """Write points or a mesh as binary little-endian PLY: x y z red green blue label confidence, lists of vertices."""
    mesh = surface if isinstance(surface, MapMesh) else None
    xyz = surface.xyz if isinstance(surface, MapPoints) else surface.vertices
    columns = dict(zip(("x", "y", "z"), xyz.astype("<f4").T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), surface.rgb.T, strict=True))
    columns |= {"label": surface.label, "confidence": surface.confidence.astype("<f4")}
    if surface.measured is not None and not surface.measured.all():
        columns["measured"] = surface.measured.astype(np.uint8)
    vertices = np.empty(len(xyz), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        vertices[name] = values
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [] if scale_known else ["comment scale: unknown"]
    lines += [f"comment label {i} {_escaped(n)}" for i, n in zip(label_set.ids, label_set.names, strict=True)]
    lines += [f"comment label {label_set.ignore_id} unknown", f"element vertex {len(vertices)}"]
    lines += [f"property {_PLY_NAMES[values.dtype.str]} {name}" for name, values in columns.items()]
    faces = np.empty(0 if mesh is None else len(mesh.faces), _PLY_FACE)
    if mesh is not None:
        faces["count"], faces["corners"] = 3, mesh.faces
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with atomic_write(path, raises=MapError) as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _escaped(name: str) -> str:
    """One line of printable ASCII; Open3D's reader writes past its buffer at lines above 1,000 characters."""
    while len(escaped := name.encode("unicode_escape").decode("ascii")) > MAX_NAME:
        name = name[:-1]  # a whole letter, however long its escape is
    return escaped


_UINT16, _UINT32, _FLOAT = 5123, 5125, 5126
_VERTICES, _INDICES = {"target": 34962}, {"target": 34963}  # what a part of the numbers is for


def write_glb(path: Path, mesh: MapMesh, up: Float64, *, scale_known: bool = True) -> None:
    """Write a mesh as GLB; ``up`` (3,) is a unit vector, up in the world. ``MapError``: no faces, which glTF cannot
    hold, or more than 4 GiB."""
    if not len(mesh.faces):
        raise MapError(f"{path}: glTF cannot hold a mesh without faces")
    ends = {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    parts: list[tuple[NDArray[Any], dict[str, Any], dict[str, Any]]] = [
        (mesh.vertices.astype("<f4"), _VERTICES, {"componentType": _FLOAT, "type": "VEC3", **ends}),
        (_linear_color(mesh.rgb), _VERTICES, {"componentType": _UINT16, "type": "VEC4", "normalized": True}),
        (mesh.faces.astype("<u4").reshape(-1), _INDICES, {"componentType": _UINT32, "type": "SCALAR"}),
    ]
    starts = np.cumsum([0, *(array.nbytes for array, _, _ in parts)]).tolist()  # multiples of four bytes, as glTF asks
    turn = np.eye(4)
    turn[:3, :3] = turn_onto(up, np.array((0.0, 1.0, 0.0)))
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0, "mode": 4}
    document = {
        "asset": {"version": "2.0", "generator": "semantic-mapper"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "world", "mesh": 0, "matrix": turn.T.reshape(-1).tolist()}],  # column by column
        "meshes": [{"name": "map", "primitives": [primitive], "extras": {} if scale_known else {"scale": "unknown"}}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": [{"bufferView": n, "count": len(array), **a} for n, (array, _, a) in enumerate(parts)],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, **view}
            for start, (array, view, _) in zip(starts[:-1], parts, strict=True)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + starts[-1]
    if total > 2**32 - 1:
        raise MapError(f"{path}: {total / 2**30:.1f} GiB are too many for a GLB; choose ply-mesh or larger voxels")
    with atomic_write(path, raises=MapError) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", starts[-1], b"BIN\0"))
        for array, _, _ in parts:
            file.write(array.tobytes())


def _linear_color(rgb: UInt8) -> NDArray[np.uint16]:
    """(V, 3) sRGB bytes -> (V, 4) linear light, opaque."""
    s = np.arange(256) / 255
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    color = np.full((len(rgb), 4), 65535, "<u2")
    color[:, :3] = np.rint(table * 65535).astype(np.uint16)[rgb]
    return color
