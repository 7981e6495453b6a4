"""Where models of structure from motion lie, whose unit and axes are their own: by GPS, or upright by the cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.replay.importers.base import DepthScale, ImportOptions, inside
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, place_by_gps, read_position
from semantic_mapper.replay.sfm.scale import UNSCALED_DEPTH_M, scene_depth, upright
from semantic_mapper.types import Float64


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel:
    """A model in the world of a log.

    Args:
        poses: (N, 4, 4) T_world_camera.
        metric: Whether lengths are metres, but for a scale that is given.
        notices: What is to be said of it.
        metadata: Of the log.
    """

    poses: Float64
    metric: bool
    notices: list[str] = field(default_factory=list[str])
    metadata: dict[str, str] = field(default_factory=dict[str, str])

    def pictures(
        self, source: str, folder: Path, pictures: list[PosedPicture], options: ImportOptions
    ) -> PosedPictures:
        """The recording, once its pictures, posed as in the model, are moved."""
        moved = [replace(picture, T_world_camera=T) for picture, T in zip(pictures, self.poses, strict=True)]
        scale = DepthScale(1000.0, convention=f"a model of {source} has no depth images")
        opened = PosedPictures(source, folder, moved, options, depth_scale=scale, metric=self.metric)
        opened.notices += self.notices
        opened.info = msgspec.structs.replace(opened.info, metadata={**opened.info.metadata, **self.metadata})
        return opened


def has_picture(root: Path, name: str) -> bool:
    """Whether a model's picture is in this folder; one whose name leads out of it, or cannot be one, is not."""
    try:
        return inside(root, name).is_file()
    except (ImportSourceError, OSError):
        return False


def place_model(
    poses: Float64, pictures: list[PosedPicture], options: ImportOptions, depth: Callable[[], float]
) -> PlacedModel:
    """Place a model by the positions of its pictures if they have some and no scale is given, else upright.

    Args:
        poses: (N, 4, 4) T_model_camera.
        pictures: Theirs.
        options: Of the import.
        depth: Tells the median depth of the model's points; 0 = it has none.
    """
    notices: list[str] = []
    median = depth()
    if options.scale is None:
        try:
            fit = place_by_gps(poses, [read_position(picture.file) for picture in pictures])
        except ImportSourceError as error:
            notices.append(f"GPS is not used: {error}")
        else:
            if fit is not None:
                said = [f"scale, up and north: {fit}"]
                moved = np.stack([fit.moved(pose) for pose in poses])
                return PlacedModel(moved, True, said, {ORIGIN_KEY: str(fit.origin), **scene_depth(fit.scale * median)})
    placed = upright(poses[0], camera_up(poses)) @ poses
    if options.scale is not None:
        return PlacedModel(placed, False, notices, scene_depth(options.scale * median))
    placed[:, :3, 3] *= UNSCALED_DEPTH_M / median if median > 0 else 1.0
    return PlacedModel(placed, False, notices)
