"""What of a map is exported, and in which colours."""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeVar

import cv2
import numpy as np

from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapMesh, MapPoints
from semantic_mapper.types import Float32, UInt8

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
    rgb = label_set.colorize(surface.label) if by == "class" else _confidence_colors(surface.confidence)
    return dataclasses.replace(surface, rgb=rgb)


def _confidence_colors(confidence: Float32) -> UInt8:
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    return np.asarray(table, np.uint8)[np.rint(confidence * 255).astype(np.uint8)]
