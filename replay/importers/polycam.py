"""Polycam's raw data, as its developer mode exports them: pictures, poses and LiDAR depth of an iPhone or iPad.

The layout is that of https://github.com/PolyCam/polyform ("Polycam's data format"): below ``keyframes``,
``corrected_images`` and ``corrected_cameras`` (else ``images`` and ``cameras``, as ARKit gave them), ``depth`` (16-bit
PNG, millimetres, smaller than the pictures) and ``confidence`` (8 bits, 0 = low). Files are named by the time of
capture in microseconds. ``t_ij`` is camera to world, in OpenGL's camera axes and ARKit's world, where y is up.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.errors import FrameError, ImportSourceError
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    PICTURES,
    DepthScale,
    ImportOptions,
    convert_known,
    numbered_files,
    read_plain_json,
    read_rgb,
    refuse_keys,
    unknown_keys,
    unknown_notice,
    without_picture,
)
from semantic_mapper.replay.importers.posed import GL_AXES, T_Z_UP_Y_UP, PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics, Float64

_LENS = re.compile(r"[kp]_?\d|distort\w*|is_fisheye")
_KNOWN = ("timestamp", "center_depth")  # the time is that of the files' names
DEPTH_SCALE = DepthScale(1000.0, convention="Polycam's millimetres")


class _Camera(msgspec.Struct):
    fx: float
    fy: float
    cx: float
    cy: float
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
    width: float | None = None  # not in corrected_cameras since 2025
    height: float | None = None


def open_polycam(folder: Path, options: ImportOptions) -> PosedPictures:
    """A capture, opened.

    Raises:
        ImportSourceError: cameras are missing or cannot be understood.
    """
    keyframes = folder / "keyframes"
    corrected = (keyframes / "corrected_cameras").is_dir() and (keyframes / "corrected_images").is_dir()
    notices: list[str] = []
    all_images = numbered_files(keyframes / "images", PICTURES, notices)
    images = numbered_files(keyframes / "corrected_images", PICTURES, notices) if corrected else all_images
    if corrected and not images:
        notices.append(f"{keyframes / 'corrected_images'} is empty: ARKit's own pictures and poses are taken")
        corrected, images = False, all_images
    kind = "corrected_" if corrected else ""
    cameras = numbered_files(keyframes / f"{kind}cameras", (".json",), notices)
    notices += without_picture("camera", cameras, images, keyframes / f"{kind}images")
    if missing := sorted({*all_images} - {*images}):
        notices.append(
            f"{counted(len(missing), 'picture')} of images/ that corrected_images/ lacks left out; the first: "
            f"{all_images[missing[0]].name}"
        )
    if not images:
        raise ImportSourceError(f"{keyframes / 'images'}: no pictures; export 'raw data' (developer mode)")
    first = min(images)
    pictures: list[PosedPicture] = []
    left_out: list[str] = []
    unknown: set[str] = set()
    for time_us, file in images.items():
        camera = keyframes / f"{kind}cameras" / f"{file.stem}.json"
        try:
            plain = read_plain_json(camera, 1 << 20)
            unknown.update(unknown_keys([plain], _Camera, _KNOWN))
            refuse_keys(plain, _LENS, str(camera))
            intrinsics, T_world_camera = _camera(plain, camera, file)
        except ImportSourceError as error:
            left_out.append(str(error))
            continue
        depth, confidence = (keyframes / name / f"{file.stem}.png" for name in ("depth", "confidence"))
        stamp_ns = 1000 * (time_us - first)
        pictures.append(PosedPicture(file, intrinsics, T_world_camera, depth, stamp_ns, confidence))
    if not pictures:
        raise ImportSourceError(f"{keyframes}: no picture has a camera that can be used: {left_out[0]}")
    opened = PosedPictures("polycam", folder, pictures, options, depth_scale=DEPTH_SCALE, metric=True)
    if not corrected:
        opened.notices.append("no corrected_images: poses are ARKit's own, and the lens distortion is not undone")
    if left_out:
        opened.notices.append(f"{counted(len(left_out), 'picture')} left out, without a camera: {left_out[0]}")
    opened.notices += [*notices, *unknown_notice(keyframes / f"{kind}cameras", sorted(unknown))]
    return opened


def _camera(plain: dict[str, Any], file: Path, picture: Path) -> tuple[CameraIntrinsics, Float64]:
    c = convert_known(plain, _Camera, str(file))
    width, height = c.width, c.height
    if not width or not height:
        rgb, _ = read_rgb(picture)
        height, width = rgb.shape[:2]
    rows = [[getattr(c, f"t_{i}{j}") for j in range(4)] for i in range(3)]
    T_world_gl = np.array([*rows, [0.0, 0.0, 0.0, 1.0]], np.float64)
    try:
        intrinsics = CameraIntrinsics(c.fx, c.fy, c.cx - 0.5, c.cy - 0.5, int(width), int(height))
    except FrameError as error:
        raise ImportSourceError(f"{file}: {error}") from error
    return intrinsics, T_Z_UP_Y_UP @ T_world_gl @ GL_AXES
