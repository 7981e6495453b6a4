"""COLMAP's models, text and binary, with their pictures in ``images`` beside ``sparse`` (or beside the model).

Where the pictures have GPS positions, these tell scale, up and north. Otherwise up is how the camera was held, and the
unit is the model's own, unless a scale is given; without one, the median depth of the points becomes 2 units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers.base import ImportOptions
from semantic_mapper.replay.importers.placed import place_model
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures, inside
from semantic_mapper.replay.sfm.colmap_model import ColmapModel, find_model, read_model
from semantic_mapper.replay.sfm.scale import PlacedFrame, median_depth


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
    pictures = [
        PosedPicture(inside(root, image.name), model.cameras[image.camera_id], image.T_world_camera)
        for image in model.images
    ]
    return place_model(poses, pictures, options, lambda: _depth(model)).pictures("colmap", folder, pictures, options)


def _depth(model: ColmapModel) -> float:
    """Median depth of the points as the images see them; 0 = none sees any."""
    frames = [
        PlacedFrame(
            0,
            image.T_world_camera,
            np.array([model.points[int(p)] for p in image.point_ids if int(p) in model.points]).reshape(-1, 3),
        )
        for image in model.images
    ]
    return median_depth(frames) if any(len(frame.xyz) for frame in frames) else 0.0
