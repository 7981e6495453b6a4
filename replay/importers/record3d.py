"""Record3D's "EXR + RGB" export of an iPhone or iPad: ``metadata.json`` and ``rgb/N.jpg`` (or .png).

``metadata.json`` has ``K`` (9 numbers, column by column) for pictures of ``w`` x ``h``, ``fps``, and ``poses``, one for
each picture: qx qy qz qw tx ty tz, camera to world in metres, in OpenGL's camera axes and ARKit's world, where y is up.
The depth of this export is OpenEXR, which is not read: frames come without depth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.replay.importers.base import DepthScale, ImportOptions, numbered_files
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics

FILE = "metadata.json"
MAX_NORM_ERROR = 0.1  # of a unit quaternion


class _Metadata(msgspec.Struct):
    w: Annotated[int, Meta(ge=1, le=1 << 14)]
    h: Annotated[int, Meta(ge=1, le=1 << 14)]
    K: Annotated[list[float], Meta(min_length=9, max_length=9)]
    poses: list[Annotated[list[float], Meta(min_length=7, max_length=7)]]
    fps: Annotated[float, Meta(gt=0, le=1000)] = 60.0


def open_record3d(folder: Path, options: ImportOptions) -> PosedPictures:
    """An export, opened.

    Raises:
        ImportSourceError: metadata or pictures are missing or cannot be understood.
    """
    file = folder / FILE
    try:
        found = read_json(file, _Metadata)
        fx, fy, cx, cy = found.K[0], found.K[4], found.K[6], found.K[7]
        intrinsics = CameraIntrinsics(fx, fy, cx - 0.5, cy - 0.5, found.w, found.h)
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error
    except FrameError as error:
        raise ImportSourceError(f"{file}: K: {error}") from error
    images = numbered_files(folder / "rgb", (".jpg", ".jpeg", ".png"))
    if not images:
        raise ImportSourceError(f"{folder / 'rgb'}: no pictures; export as 'EXR + RGB'")
    if max(images) >= len(found.poses):
        raise ImportSourceError(f"{file}: has {len(found.poses)} poses, and pictures are numbered up to {max(images)}")
    pictures: list[PosedPicture] = []
    for number, image in images.items():
        row = np.array(found.poses[number], np.float64)
        if not np.isfinite(row).all() or abs(np.linalg.norm(row[:4]) - 1) > MAX_NORM_ERROR:
            raise ImportSourceError(f"{file}: pose {number} is no unit quaternion qx qy qz qw and position")
        T = T_Z_UP_Y_UP @ pose_matrix(row[4:], row[:4]) @ GL_AXES
        pictures.append(PosedPicture(image, intrinsics, T, stamp_ns=round(number * 1e9 / found.fps)))
    scale = DepthScale(1000.0, convention="no depth image is read")
    opened = PosedPictures("record3d", folder, pictures, options, depth_scale=scale, metric=True)
    if (folder / "depth").is_dir():
        opened.notices.append("the depth images (OpenEXR) are not read; frames come without depth")
    return opened
