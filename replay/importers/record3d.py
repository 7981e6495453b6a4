"""Record3D's "EXR + RGB" export of an iPhone or iPad: ``metadata.json`` and ``rgb/N.jpg`` (or .png).

``metadata.json`` has ``K`` (9 numbers, column by column) for pictures of ``w`` x ``h``, ``fps``, and ``poses``, one for
each picture: qx qy qz qw tx ty tz, camera to world in metres, in OpenGL's camera axes and ARKit's world, where y is up.
Newer versions add ``perFrameIntrinsicCoeffs`` (fx fy cx cy of each picture, as the lens focuses and is stabilised) and
``frameTimestamps`` (seconds), which come first.
The depth of this export is OpenEXR, which is not read: frames come without depth.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    DepthScale,
    ImportOptions,
    convert_known,
    first_size,
    numbered_files,
    read_plain_json,
    unknown_keys,
    unknown_notice,
)
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics

FILE = "metadata.json"
MAX_BYTES = 1 << 29  # hours of frames at 60 Hz
_KNOWN = ("dw", "dh", "initPose", "cameraType")  # of the depth images, and of what is known from the poses
FPS = 60.0  # where nothing tells it
MAX_NORM_ERROR = 0.1  # of a unit quaternion


class _Metadata(msgspec.Struct, rename={"per_frame_k": "perFrameIntrinsicCoeffs", "frame_times": "frameTimestamps"}):
    poses: list[list[float | None] | None]
    w: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None  # None = that of the pictures
    h: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None
    K: list[float | None] | None = None
    per_frame_k: list[list[float | None] | None] | None = None
    frame_times: list[float | None] | None = None
    fps: float | None = None


def open_record3d(folder: Path, options: ImportOptions) -> PosedPictures:
    """An export, opened.

    Raises:
        ImportSourceError: metadata or pictures are missing or cannot be understood.
    """
    file = folder / FILE
    plain = read_plain_json(file, MAX_BYTES)
    found = convert_known(plain, _Metadata, str(file))
    notices = unknown_notice(file, unknown_keys([plain], _Metadata, _KNOWN))
    images = numbered_files(folder / "rgb", (".jpg", ".jpeg", ".png"), notices)
    if not images:
        raise ImportSourceError(f"{folder / 'rgb'}: no pictures; export as 'EXR + RGB'")
    size = (found.w, found.h) if found.w and found.h else first_size(images.values())
    if size is None:
        raise ImportSourceError(f"{file}: has no w and h, and no picture that tells them")
    if not found.frame_times and not 0 < (found.fps or 0) <= 1000:
        notices.append(f"{file}: tells neither times nor fps: stamps are made up at {FPS:g} frames a second")
    pictures: list[PosedPicture] = []
    left_out: list[str] = []
    for (number, image), seconds in zip(images.items(), _seconds(found, list(images)), strict=True):
        try:
            pictures.append(_picture(found, number, image, seconds, (int(size[0]), int(size[1]))))
        except ValueError as error:  # FrameError, too
            left_out.append(f"{image}: {error}")
    if left_out:
        notices.append(f"{counted(len(left_out), 'picture')} left out; the first: {left_out[0]}")
    if not pictures:
        raise ImportSourceError(f"{file}: tells the pose of none of the pictures: {left_out[0]}")
    missing = len(found.poses) - len(images)
    if missing > 0:
        notices.append(f"{counted(missing, 'pose')} without a picture in {folder / 'rgb'}")
    scale = DepthScale(1000.0, convention="no depth image is read")
    opened = PosedPictures("record3d", folder, pictures, options, depth_scale=scale, metric=True)
    opened.notices += notices
    if (folder / "depth").is_dir():
        opened.notices.append("the depth images (OpenEXR) are not read; frames come without depth")
    return opened


def _seconds(found: _Metadata, numbers: list[int]) -> list[float]:
    """Time of each picture, from 0; one that is missing lies between its neighbours."""
    fps = found.fps if found.fps and 0 < found.fps <= 1000 else FPS
    told = [(number, time) for number, time in enumerate(found.frame_times or ()) if time is not None]
    if not told:
        return [number / fps for number in numbers]
    known, times = np.array(told, np.float64).T
    wanted = np.array(numbers, np.float64)
    beyond = np.maximum(wanted - known[-1], 0) / fps  # pictures behind the last time follow at the usual rate
    return (np.interp(wanted, known, times) + beyond - times.min()).tolist()


def _picture(found: _Metadata, number: int, image: Path, seconds: float, size: tuple[int, int]) -> PosedPicture:
    """Raises: ValueError: the picture has no pose, or intrinsics."""
    row = np.array(found.poses[number] if number < len(found.poses) else None, np.float64)
    if row.shape != (7,) or not np.isfinite(row).all() or abs(np.linalg.norm(row[:4]) - 1) > MAX_NORM_ERROR:
        raise ValueError("its pose is missing, or no unit quaternion qx qy qz qw and position")
    T = T_Z_UP_Y_UP @ pose_matrix(row[4:], row[:4]) @ GL_AXES
    own = found.per_frame_k[number] if found.per_frame_k and number < len(found.per_frame_k) else None
    k = [value for value in (own or ())[:4] if value and value > 0]
    if len(k) < 4 and found.K is not None and len(found.K) == 9:
        k = [value for value in (found.K[0], found.K[4], found.K[6], found.K[7]) if value and value > 0]
    if len(k) < 4:
        raise ValueError("it has no intrinsics: neither K nor 4 numbers of perFrameIntrinsicCoeffs")
    fx, fy, cx, cy = k
    return PosedPicture(image, CameraIntrinsics(fx, fy, cx - 0.5, cy - 0.5, *size), T, stamp_ns=round(seconds * 1e9))
