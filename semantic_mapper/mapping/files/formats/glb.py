"""glTF 2.0 in one binary file (GLB): a header, one chunk of JSON, one chunk of numbers.

glTF is right-handed, in metres, with y up. Vertices keep the coordinates of the world; the mesh's node holds the
rotation that takes the world's up to +y, so that viewers show the map upright and programs find world coordinates.

Vertex attributes: POSITION; COLOR_0 (linear light, as glTF asks, 16 bits so that sRGB's 8 survive); _LABEL (uint8
class id, each padded to four bytes as glTF asks); _CONFIDENCE (float). ``extras.label_set`` of the mesh says what the
ids mean, ``extras.scale`` is "unknown" where lengths are not metres.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapMesh
from semantic_mapper.types import Float64, UInt8

_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_UINT8, _UINT16, _UINT32, _FLOAT = 5121, 5123, 5125, 5126
_VERTICES, _INDICES = 34962, 34963  # what a part of the numbers is for
_MAX_BYTES = 2**32 - 1


def write_glb(path: Path, mesh: MapMesh, label_set: LabelSet, up: Float64, *, scale_known: bool = True) -> None:
    """Write a mesh as GLB.

    Args:
        path: Of the file.
        mesh: With at least one face: glTF has no empty meshes.
        label_set: For ``extras``.
        up: (3,) unit vector, up in the world.
        scale_known: Whether lengths are metres; ``extras`` say where not.

    Raises:
        MapError: no faces, more than 4 GiB, or the file cannot be written.
    """
    if not len(mesh.faces):
        raise MapError(f"{path}: glTF cannot hold a mesh without faces")
    labels = np.zeros((len(mesh.label), 4), np.uint8)
    labels[:, 0] = mesh.label
    parts: list[tuple[NDArray[Any], dict[str, Any], dict[str, Any]]] = [
        (
            mesh.vertices.astype("<f4"),
            {"target": _VERTICES},
            {
                "componentType": _FLOAT,
                "type": "VEC3",
                "min": mesh.vertices.min(axis=0).tolist(),
                "max": mesh.vertices.max(axis=0).tolist(),
            },
        ),
        (
            _linear_color(mesh.rgb),
            {"target": _VERTICES},
            {"componentType": _UINT16, "type": "VEC4", "normalized": True},
        ),
        (labels, {"target": _VERTICES, "byteStride": 4}, {"componentType": _UINT8, "type": "SCALAR"}),
        (mesh.confidence.astype("<f4"), {"target": _VERTICES}, {"componentType": _FLOAT, "type": "SCALAR"}),
        (mesh.faces.astype("<u4").reshape(-1), {"target": _INDICES}, {"componentType": _UINT32, "type": "SCALAR"}),
    ]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    start = 0
    for n, (array, view, accessor) in enumerate(parts):  # each a multiple of four bytes long, so all start on one
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, **view})
        accessors.append({"bufferView": n, "count": len(array), **accessor})
        start += array.nbytes
    document = _document(label_set, up, views, accessors, start)
    if not scale_known:
        document["meshes"][0]["extras"]["scale"] = "unknown"
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + start
    if total > _MAX_BYTES:
        raise MapError(
            f"{path}: {total / 2**30:.1f} GiB are more than a GLB can hold; choose ply-mesh or larger voxels"
        )
    with atomic_write(path, raises=MapError) as file:
        file.write(struct.pack("<III", _MAGIC, _VERSION, total))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", start, _BIN))
        for array, _, _ in parts:
            file.write(array.tobytes())


def _document(
    label_set: LabelSet, up: Float64, views: list[dict[str, Any]], accessors: list[dict[str, Any]], size: int
) -> dict[str, Any]:
    turn = np.eye(4)
    turn[:3, :3] = turn_onto(up, np.array((0.0, 1.0, 0.0)))
    primitive = {
        "attributes": {"POSITION": 0, "COLOR_0": 1, "_LABEL": 2, "_CONFIDENCE": 3},
        "indices": 4,
        "material": 0,
        "mode": 4,
    }
    labels = {
        "name": label_set.name,
        "ids": label_set.ids,
        "names": label_set.names,
        "colors": label_set.colors,
        "ignore_id": label_set.ignore_id,
    }
    return {
        "asset": {"version": "2.0", "generator": "semantic-mapper"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "world", "mesh": 0, "matrix": turn.T.reshape(-1).tolist()}],  # column by column
        "meshes": [{"name": "map", "primitives": [primitive], "extras": {"label_set": labels}}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }


def _linear_color(rgb: UInt8) -> NDArray[np.uint16]:
    """(V, 3) sRGB bytes -> (V, 4) linear light, opaque."""
    s = np.arange(256) / 255
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    color = np.full((len(rgb), 4), 65535, "<u2")
    color[:, :3] = np.rint(table * 65535).astype(np.uint16)[rgb]
    return color
