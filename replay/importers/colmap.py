"""COLMAP's models, text and binary, with their pictures in ``images`` next to ``sparse`` (or to the model).

Where the pictures have GPS positions, these tell scale, up and north. Otherwise up is how the camera was held, and the
unit is the model's own, unless a scale is given; without one, the median depth of the points becomes 2 units.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import PICTURES, ImportOptions, inside
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures, has_picture, place_model
from semantic_mapper.replay.sfm.colmap_model import ColmapImage, ColmapModel, find_models, read_model
from semantic_mapper.replay.sfm.scale import RegisteredFrame, median_depth


def open_colmap(folder: Path, options: ImportOptions) -> PosedPictures:
    """A folder with a COLMAP model, opened.

    Raises:
        ImportSourceError: no model, one that cannot be read, or no folder of pictures.
    """
    notices: list[str] = []
    place, model = _largest(folder, notices)
    roots = list(dict.fromkeys((folder / "images", *(parent / "images" for parent in place.parents[:3]), folder)))
    found = {root: sum(has_picture(root, image.name) for image in model.images) for root in roots}
    root = max(roots, key=lambda root: found[root])
    if not found[root]:
        name = model.images[0].name
        inside(roots[0], name)  # tells of a name that leads out of it
        raise ImportSourceError(f"{folder}: the pictures of the model are missing; '{name}' is not in {roots[0]}")
    images: list[tuple[Path, ColmapImage]] = []
    left_out = [*model.left_out]
    for image in model.images:
        try:
            images.append((inside(root, image.name), image))
        except ImportSourceError as error:
            left_out.append(str(error))
    if left_out:
        notices.append(f"{counted(len(left_out), 'image')} left out; the first: {left_out[0]}")
    if model.damaged:
        notices.append(f"the model is damaged in {counted(len(model.damaged), 'place')}; the first: {model.damaged[0]}")
    names = {file for file, _ in images}
    places, below = ({file.parent for file in names}, "*") if root == folder else ({root}, "**/*")
    pictures_there = sorted(path for place in places for path in place.glob(below))
    unposed = [path for path in pictures_there if path.suffix.lower() in PICTURES and path not in names]
    if unposed:
        notices.append(
            f"{counted(len(unposed), 'picture')} in {root} without a pose in this model; the first: {unposed[0].name}"
        )
    poses = np.stack([image.T_world_camera for _, image in images])
    pictures = [PosedPicture(file, model.cameras[image.camera_id], image.T_world_camera) for file, image in images]
    posed = place_model(poses, pictures, options, lambda: _depth(model))
    opened = posed.pictures("colmap", folder, pictures, options)
    opened.notices += notices
    return opened


def _largest(folder: Path, notices: list[str]) -> tuple[Path, ColmapModel]:
    """The model of most images; the others are named.

    Raises:
        ImportSourceError: none that can be read and has an image.
    """
    places = find_models(folder)
    if not places:
        raise ImportSourceError(f"{folder}: no COLMAP model (cameras, images and points3D, .bin or .txt) in it")
    models: dict[Path, ColmapModel] = {}
    for place in places:
        try:
            models[place] = read_model(place)
        except ImportSourceError as error:
            if len(places) == 1:
                raise
            notices.append(f"a model is left out: {error}")
    chosen = max(models, key=lambda place: len(models[place].images), default=None)
    if chosen is None or not models[chosen].images:
        raise ImportSourceError(f"{places[0]}: the model has no registered image" + "".join(f"; {n}" for n in notices))
    if len(models) > 1:
        others = ", ".join(f"{p.name} of {len(m.images)}" for p, m in models.items() if p != chosen)
        notices.append(
            f"the largest of {len(models)} models is imported, {chosen.name} of {len(models[chosen].images)} pictures; "
            f"left out: {others}. To import another one, name its folder"
        )
    return chosen, models[chosen]


def _depth(model: ColmapModel) -> float:
    """Median depth of the points as the images see them; 0 = none sees any."""
    frames = [
        RegisteredFrame(
            0,
            image.T_world_camera,
            np.array([model.points[int(p)] for p in image.point_ids if int(p) in model.points]).reshape(-1, 3),
        )
        for image in model.images
    ]
    return median_depth(frames) if any(len(frame.xyz) for frame in frames) else 0.0
