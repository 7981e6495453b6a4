"""Polycam's raw data, as its developer mode exports them: pictures, poses and LiDAR depth of an iPhone or iPad.

The layout is that of https://github.com/PolyCam/polyform ("Polycam's data format"): below ``keyframes``,
``corrected_images`` and ``corrected_cameras`` (else ``images`` and ``cameras``, as ARKit gave them), ``depth`` (16-bit
PNG, millimetres, smaller than the pictures) and ``confidence`` (8 bits, 0 = low). Files are named by the time of
capture in microseconds. ``t_ij`` is camera to world, in OpenGL's camera axes and ARKit's world, where y is up.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.replay.importers.base import DepthScale, ImportOptions, numbered_files
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics

DEPTH_SCALE = DepthScale(1000.0, convention="Polycam's millimetres")


class _Camera(msgspec.Struct):
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float


def open_polycam(folder: Path, options: ImportOptions) -> PosedPictures:
    """A capture, opened.

    Raises:
        ImportSourceError: cameras are missing or cannot be understood.
    """
    keyframes = folder / "keyframes"
    corrected = (keyframes / "corrected_cameras").is_dir() and (keyframes / "corrected_images").is_dir()
    kind = "corrected_" if corrected else ""
    images = numbered_files(keyframes / f"{kind}images", (".jpg", ".jpeg", ".png"))
    if not images:
        raise ImportSourceError(f"{keyframes / 'images'}: no pictures; export 'raw data' (developer mode)")
    first = min(images)
    pictures: list[PosedPicture] = []
    missing = 0
    for time_us, file in images.items():
        camera = keyframes / f"{kind}cameras" / f"{file.stem}.json"
        if not camera.exists():
            missing += 1
            continue
        pictures.append(
            PosedPicture(
                file,
                *_read_camera(camera),
                depth_file=keyframes / "depth" / f"{file.stem}.png",
                stamp_ns=1000 * (time_us - first),
                confidence_file=keyframes / "confidence" / f"{file.stem}.png",
            )
        )
    opened = PosedPictures("polycam", folder, pictures, options, depth_scale=DEPTH_SCALE, metric=True)
    if not corrected:
        opened.notices.append("no corrected_images: poses are ARKit's own, and the lens distortion is not undone")
    if missing:
        opened.notices.append(f"{missing} pictures without a file of their camera are left out")
    return opened


def _read_camera(file: Path) -> tuple[CameraIntrinsics, np.ndarray]:
    try:
        c = read_json(file, _Camera)
        rows = [[getattr(c, f"t_{i}{j}") for j in range(4)] for i in range(3)]
        T_world_gl = np.array([*rows, [0.0, 0.0, 0.0, 1.0]], np.float64)
        intrinsics = CameraIntrinsics(c.fx, c.fy, c.cx - 0.5, c.cy - 0.5, c.width, c.height)
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error
    except FrameError as error:
        raise ImportSourceError(f"{file}: {error}") from error
    return intrinsics, T_Z_UP_Y_UP @ T_world_gl @ GL_AXES
