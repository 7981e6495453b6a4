"""Record3D's "EXR + RGB" export of an iPhone or iPad: ``metadata.json`` and ``rgb/N.jpg`` (or .png).

``metadata.json`` has ``K`` (9 numbers, column by column) for pictures of ``w`` x ``h``, ``fps``, and ``poses``, one for
each picture: qx qy qz qw tx ty tz, camera to world in metres, in OpenGL's camera axes and ARKit's world, where y is up.
Newer versions add ``perFrameIntrinsicCoeffs`` (fx fy cx cy of each picture, as the lens focuses and is stabilised) and
``frameTimestamps`` (seconds), which come first.
The depth of this export is OpenEXR, which is not read: frames come without depth.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

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
    without_picture,
)
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics

FILE = "metadata.json"
MAX_BYTES = 1 << 29  # hours of frames at 60 Hz
_KNOWN = ("dw", "dh", "initPose", "cameraType")  # of the depth images, and of what is known from the poses
FPS = 60.0  # where nothing tells it
MAX_SIDE = 1 << 14  # pixels
MAX_NORM_ERROR = 0.1  # of a unit quaternion


class _Metadata(msgspec.Struct, rename={"per_frame_k": "perFrameIntrinsicCoeffs", "frame_times": "frameTimestamps"}):
    """Values are read one by one, so that a bad one costs no other."""

    poses: list[Any]
    w: Any = None
    h: Any = None
    K: Any = None
    per_frame_k: Any = None
    frame_times: Any = None
    fps: Any = None


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
    w, h = _number(found.w), _number(found.h)
    if w is not None and h is not None and min(w, h) >= 1 and max(w, h) <= MAX_SIDE:
        size = int(w), int(h)
    else:
        size = first_size(images.values())
    if size is None:
        raise ImportSourceError(f"{file}: has no w and h, and no picture that tells them")
    seconds = _seconds(found, list(images), file, notices)
    pictures: list[PosedPicture] = []
    left_out: list[str] = []
    for (number, image), second in zip(images.items(), seconds, strict=True):
        try:
            pictures.append(_picture(found, number, image, second, size))
        except ValueError as error:  # FrameError, too
            left_out.append(f"{image}: {error}")
    if left_out:
        notices.append(f"{counted(len(left_out), 'picture')} left out; the first: {left_out[0]}")
    if not pictures:
        raise ImportSourceError(f"{file}: tells the pose of none of the pictures: {left_out[0]}")
    notices += without_picture("pose", range(len(found.poses)), images, folder / "rgb")
    scale = DepthScale(1000.0, convention="no depth image is read")
    opened = PosedPictures("record3d", folder, pictures, options, depth_scale=scale, metric=True)
    opened.notices += notices
    if (folder / "depth").is_dir():
        opened.notices.append("the depth images (OpenEXR) are not read; frames come without depth")
    return opened


def _number(value: Any) -> float | None:
    """A finite number, also one that is written as text; else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _numbers(values: Any, at: int | None = None) -> list[float | None]:
    """Numbers of a list, or of the list at a place in it; empty where it is missing."""
    if at is not None:
        values = values[at] if isinstance(values, list) and at < len(values) else None
    return [_number(value) for value in values] if isinstance(values, list) else []


def _seconds(found: _Metadata, numbers: list[int], file: Path, notices: list[str]) -> list[float]:
    """Time of each picture, from 0. One that is missing lies between its neighbours, or at the usual rate beyond the
    first and the last."""
    fps = _number(found.fps)
    given = fps is not None and 0 < fps <= 1000
    rate = fps if fps is not None and given else FPS
    wanted = np.array(numbers, np.float64)
    given_times = [(number, time) for number, time in enumerate(_numbers(found.frame_times)) if time is not None]
    if not given_times:
        if not given:
            notices.append(f"{file}: tells neither times nor fps: stamps are made up at {FPS:g} frames a second")
        return (wanted / rate).tolist()
    known, times = np.array(given_times, np.float64).T
    missing = int((~np.isin(wanted, known)).sum())
    if missing:
        notices.append(
            f"{file}: frameTimestamps lack {counted(missing, 'picture')}; their stamps lie between those of their "
            f"neighbours, or follow at {rate:g} frames a second{'' if given else ' (assumed)'}"
        )
    beyond = np.maximum(wanted - known[-1], 0) - np.maximum(known[0] - wanted, 0)
    seconds = np.interp(wanted, known, times) + beyond / rate
    return (seconds - seconds.min()).tolist()


def _picture(found: _Metadata, number: int, image: Path, seconds: float, size: tuple[int, int]) -> PosedPicture:
    """Raises: ValueError: the picture has no pose, or intrinsics."""
    row = np.array(_numbers(found.poses, number), np.float64)
    if row.shape != (7,) or not np.isfinite(row).all() or abs(np.linalg.norm(row[:4]) - 1) > MAX_NORM_ERROR:
        raise ValueError("its pose is missing, or no unit quaternion qx qy qz qw and position")
    T = T_Z_UP_Y_UP @ pose_matrix(row[4:], row[:4]) @ GL_AXES
    k = [value for value in _numbers(found.per_frame_k, number)[:4] if value and value > 0]
    matrix = _numbers(found.K)
    if len(k) < 4 and len(matrix) == 9:
        k = [value for value in (matrix[0], matrix[4], matrix[6], matrix[7]) if value and value > 0]
    if len(k) < 4:
        raise ValueError("it has no intrinsics: neither K nor 4 numbers of perFrameIntrinsicCoeffs")
    fx, fy, cx, cy = k
    return PosedPicture(image, CameraIntrinsics(fx, fy, cx - 0.5, cy - 0.5, *size), T, stamp_ns=round(seconds * 1e9))
