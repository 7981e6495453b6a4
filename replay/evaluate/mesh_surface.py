"""Compare a replay's map with a reference mesh: how far the surface is off, how much of it is there, and its labels."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.metrics import confusion_of
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float32, Int32

NEAR_M = 0.05  # a mesh vertex with a map point this near counts as mapped
ROUGHLY_M = 0.10  # and as roughly mapped


def compare_with_mesh(folder: Path, mesh: Path) -> dict[str, Any]:
    """``surface_figures`` of the map in a replay's folder, and ``mesh_miou``: labels at the vertices of the mesh (see
    ``read_mesh``), null without labels. Raises MapError: a file is missing or does not hold what it should.
    """
    vertices, faces, label = read_mesh(mesh)
    voxel_map = VoxelMap.load(folder / "map.npz")
    require_metres(voxel_map.scale_known, f"{folder / 'map.npz'} next to {mesh}")
    points = voxel_map.points()
    if not len(points.xyz):
        raise MapError(f"{folder / 'map.npz'}: the map is empty")
    nearest, index = cKDTree(points.xyz).query(vertices, workers=-1)
    found: dict[str, Any] = {**surface_figures(points.xyz, vertices, faces), "mesh_miou": None}
    if label is not None:
        labels = voxel_map.label_set
        truth = np.where(np.isin(label, labels.ids), label, labels.ignore_id).astype(np.uint8)
        mapped = np.where(nearest < NEAR_M, points.label[index], np.uint8(labels.ignore_id))
        found["mesh_miou"] = confusion_of(truth, mapped, labels, str(mesh)).metrics().miou
    return found


def read_mesh(path: Path) -> tuple[Float32, Int32, Any]:
    """A mesh in the world of a map: an .npz with ``vertices`` (V, 3) metres, ``faces`` (F, 3) and, if there are any
    (else None), ``label`` (V,) uint8 ids of the map's label set; others are not counted. Raises MapError: it is
    missing or does not hold these."""
    try:
        with np.load(path) as data:
            return data["vertices"].astype(np.float32), data["faces"].astype(np.int32), data.get("label")
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise MapError(f"{path}: needs arrays 'vertices' (V, 3) and 'faces' (F, 3) in an .npz: {error}") from error


def surface_figures(xyz: Float32, vertices: Float32, faces: Int32) -> dict[str, float]:
    """How points (N, 3) of a surface, N > 0, lie on a mesh.

    Gives ``median_m``, ``p95_m``: distance of points to the mesh; ``on_mesh``: points within 5 cm, of all (a map may
    hold more than the mesh); ``complete``, ``complete_10cm``: fraction of vertices with a point within 5 and 10 cm.
    """
    distance = _distance_to_mesh(xyz, vertices, faces)
    nearest, _ = cKDTree(xyz).query(vertices, workers=-1)
    return {
        "median_m": round(float(np.median(distance)), 5),
        "p95_m": round(float(np.percentile(distance, 95)), 4),
        "on_mesh": round(float((distance < NEAR_M).mean()), 4),
        "complete": round(float((nearest < NEAR_M).mean()), 4),
        "complete_10cm": round(float((nearest < ROUGHLY_M).mean()), 4),
    }


def _distance_to_mesh(xyz: Float32, vertices: Float32, faces: Any) -> Float32:
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.uint32)))
    return scene.compute_distance(o3d.core.Tensor(np.ascontiguousarray(xyz))).numpy()
