"""COLMAP's models, text and binary, with their pictures in ``images`` beside ``sparse`` (or beside the model).

Poses become OpenCV's camera to world with z up, by how the camera was held. Their unit is their own, unless a scale is
given; without one, the median depth of the points becomes 2 units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.replay.importers.base import DepthScale, ImportOptions
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures, inside
from semantic_mapper.replay.sfm.colmap_model import ColmapModel, find_model, read_model
from semantic_mapper.replay.sfm.scale import UNSCALED_DEPTH_M, PlacedFrame, median_depth, upright


def open_colmap(folder: Path, options: ImportOptions) -> PosedPictures:
    """A folder with a COLMAP model, opened.

    Raises:
        ImportSourceError: no model, one that cannot be read, or no folder of pictures.
    """
    place = find_model(folder)
    if place is None:
        raise ImportSourceError(f"{folder}: no COLMAP model (cameras, images and points3D, .bin or .txt) in it")
    model = read_model(place)
    if not model.images:
        raise ImportSourceError(f"{place}: the model has no registered image")
    roots = (folder / "images", *(parent / "images" for parent in place.parents[:3]), folder)
    first = model.images[0].name
    root = next((root for root in roots if inside(root, first).is_file()), None)
    if root is None:
        raise ImportSourceError(f"{folder}: the pictures of the model are missing; '{first}' is not in {roots[0]}")
    poses = np.stack([image.T_world_camera for image in model.images])
    T = upright(poses[0], camera_up(poses))
    factor = 1.0 if options.scale is not None or not model.points else _unscaled(model)
    pictures: list[PosedPicture] = []
    for image in model.images:
        pose = T @ image.T_world_camera
        pose[:3, 3] *= factor
        pictures.append(PosedPicture(inside(root, image.name), model.cameras[image.camera_id], pose))
    scale = DepthScale(1000.0, convention="a COLMAP model has no depth images")
    return PosedPictures("colmap", folder, pictures, options, depth_scale=scale, metric=False)


def _unscaled(model: ColmapModel) -> float:
    """What makes the median depth of the points ``UNSCALED_DEPTH_M``."""
    frames = [
        PlacedFrame(
            0,
            image.T_world_camera,
            np.array([model.points[int(p)] for p in image.point_ids if int(p) in model.points]).reshape(-1, 3),
        )
        for image in model.images
    ]
    depth = median_depth(frames) if any(len(frame.xyz) for frame in frames) else 0.0
    return UNSCALED_DEPTH_M / depth if depth > 0 else 1.0
