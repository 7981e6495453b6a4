"""Exports of iPhones and iPads: Polycam's raw data, and Record3D's "EXR + RGB". Both have ARKit's world, where y is up,
and OpenGL's camera axes.

Polycam's layout is that of https://github.com/PolyCam/polyform ("Polycam's data format"): ``t_ij`` is camera to world;
without corrected pictures and cameras there are ``images`` and ``cameras``, as ARKit gave them.

``K`` of Record3D has 9 numbers, column by column, and a pose is qx qy qz qw tx ty tz, camera to world. Newer versions
add ``perFrameIntrinsicCoeffs`` (fx fy cx cy of each picture, as the lens focuses and is stabilised) and
``frameTimestamps`` (seconds), which come first. The depth of this export is OpenEXR, which is not read: frames come
without depth.
"""

import math
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import (
    PICTURES,
    BadFrameError,
    DepthScale,
    ImportOptions,
    camera_of,
    first_size,
)
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics, Float64

POLYCAM_SCALE = DepthScale(1000.0, convention="Polycam's millimetres")
RECORD3D_SCALE = DepthScale(1000.0, convention="no depth image is read")
RECORD3D_FPS = 60.0  # where nothing tells it
_POLYCAM_LENS = re.compile(r"[kp]_?\d|distort\w*|is_fisheye")
_POLYCAM_KNOWN = ("timestamp", "center_depth")  # the time is that of the files' names
_RECORD3D_KNOWN = ("dw", "dh", "initPose", "cameraType")  # of the depth images, and of what is known from the poses


class _Camera(msgspec.Struct):
    """Of Polycam, with the numbers of ``_Pose``."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: float | None = None  # not in corrected_cameras since 2025
    height: float | None = None


_Pose = msgspec.defstruct("_Pose", [(f"t_{i}{j}", float) for i in range(3) for j in range(4)])  # camera to world


def open_polycam(folder: Path, options: ImportOptions) -> PosedPictures:
    """A capture of Polycam, opened. Raises ImportSourceError: no pictures, or none with a camera that can be used."""
    keyframes = folder / "keyframes"
    notices: list[str] = []
    images = tables.numbered_files(keyframes / "corrected_images", PICTURES, notices)
    kind = "corrected_"
    if not images or not (keyframes / "corrected_cameras").is_dir():
        images, kind = tables.numbered_files(keyframes / "images", PICTURES, notices), ""
        notices.append("no corrected_images: poses are ARKit's own, and the lens distortion is not undone")
    if not images:
        raise ImportSourceError(f"{keyframes / 'images'}: no pictures; export 'raw data' (developer mode)")
    cameras = tables.numbered_files(keyframes / f"{kind}cameras", (".json",), notices)
    notices += tables.without_picture("camera", cameras, images, keyframes / f"{kind}images")
    files: list[dict[str, Any]] = []

    def picture_of(timed: tuple[int, Path]) -> PosedPicture:
        time_us, image = timed
        file = keyframes / f"{kind}cameras" / f"{image.stem}.json"
        files.append(tables.read_plain_json(file))
        tables.refuse_keys(files[-1], _POLYCAM_LENS, file)
        c = tables.convert_known(files[-1], _Camera, file)
        size = (c.width, c.height) if c.width and c.height else first_size([image], file)
        intrinsics = camera_of(file, (c.fx, c.fy, c.cx - 0.5, c.cy - 0.5), size)
        T_world_gl = np.eye(4)
        T_world_gl[:3] = np.reshape(msgspec.structs.astuple(tables.convert_known(files[-1], _Pose, file)), (3, 4))
        T = T_Z_UP_Y_UP @ T_world_gl @ GL_AXES
        depth, confidence = (keyframes / name / f"{image.stem}.png" for name in ("depth", "confidence"))
        return PosedPicture(image, intrinsics, T, 1000 * (time_us - min(images)), depth, confidence)

    pictures = tables.keep_good(picture_of, images.items(), "picture", notices, "without a camera that can be used")
    notices += tables.unknown_notice(keyframes / f"{kind}cameras", files, _Camera, _POLYCAM_KNOWN)
    return PosedPictures(f"polycam {folder.resolve().name}", pictures, options, POLYCAM_SCALE, notices)


class _Metadata(msgspec.Struct, rename={"per_frame_k": "perFrameIntrinsicCoeffs", "frame_times": "frameTimestamps"}):
    """Of Record3D. Values of frames are read one by one, so that a bad one costs no other."""

    poses: list[Any]
    w: float
    h: float
    K: list[float] = []
    per_frame_k: list[Any] = []
    frame_times: list[Any] = []
    fps: float | None = None


def open_record3d(folder: Path, options: ImportOptions) -> PosedPictures:
    """An export of Record3D, opened.

    Raises ImportSourceError: metadata or pictures are missing or cannot be understood.
    """
    file = folder / "metadata.json"
    plain = tables.read_plain_json(file)
    found = tables.convert_known({key: value for key, value in plain.items() if value is not None}, _Metadata, file)
    notices = tables.unknown_notice(file, [plain], _Metadata, _RECORD3D_KNOWN)
    images = tables.numbered_files(folder / "rgb", PICTURES, notices)
    if not images:
        raise ImportSourceError(f"{folder / 'rgb'}: no pictures; export as 'EXR + RGB'")
    notices += tables.without_picture("pose", range(len(found.poses)), images, folder / "rgb")
    if (folder / "depth").is_dir():
        notices.append("the depth images (OpenEXR) are not read; frames come without depth")
    seconds = _seconds(found, list(images), file, notices)

    def picture_of(timed: tuple[tuple[int, Path], float]) -> PosedPicture:
        (number, image), second = timed
        return PosedPicture(
            image, _record3d_intrinsics(found, number, image), _record3d_pose(found, number, image), round(second * 1e9)
        )

    pictures = tables.keep_good(picture_of, zip(images.items(), seconds, strict=True), "picture", notices)
    return PosedPictures(f"record3d {folder.resolve().name}", pictures, options, RECORD3D_SCALE, notices)


def _numbers(rows: list[Any], number: int, count: int) -> Float64 | None:
    """The first ``count`` numbers of a row; None where they are missing or not finite."""
    try:
        row = np.array(rows[number][:count], np.float64)
    except (IndexError, TypeError, ValueError):
        return None
    return row if row.shape == (count,) and np.isfinite(row).all() else None


def _record3d_pose(found: _Metadata, number: int, image: Path) -> Float64:
    row = _numbers(found.poses, number, 7)
    if row is None or abs(np.linalg.norm(row[:4]) - 1) > tables.MAX_NORM_ERROR:
        raise BadFrameError(image, "its pose is missing, or no unit quaternion qx qy qz qw and position")
    return T_Z_UP_Y_UP @ pose_matrix(row[4:], row[:4]) @ GL_AXES


def _record3d_intrinsics(found: _Metadata, number: int, image: Path) -> CameraIntrinsics:
    k = _numbers(found.per_frame_k, number, 4)
    if (k is None or (k <= 0).any()) and len(found.K) == 9:
        k = np.array(found.K)[[0, 4, 6, 7]]
    if k is None or (k <= 0).any():
        raise BadFrameError(image, "it has no intrinsics: neither K nor 4 numbers of perFrameIntrinsicCoeffs")
    fx, fy, cx, cy = k.tolist()
    return camera_of(image, (fx, fy, cx - 0.5, cy - 0.5), (found.w, found.h))


def _seconds(found: _Metadata, numbers: list[int], file: Path, notices: list[str]) -> list[float]:
    """Time of each picture, from 0: its own where each has one, else by the rate."""
    times = [found.frame_times[n] if n < len(found.frame_times) else None for n in numbers]
    known = [float(time) for time in times if isinstance(time, int | float) and math.isfinite(time)]
    if len(known) == len(numbers):
        return [time - min(known) for time in known]
    given = found.fps is not None and 0 < found.fps <= 1000
    rate = found.fps if found.fps is not None and given else RECORD3D_FPS
    if known or not given:
        notices.append(
            f"{file}: {len(numbers) - len(known)} of {counted(len(numbers), 'picture')} have no time: stamps are made "
            f"up at {rate:g} frames a second{'' if given else ', which is assumed'}"
        )
    return [(number - min(numbers)) / rate for number in numbers]
