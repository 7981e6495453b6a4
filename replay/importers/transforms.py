"""``transforms.json`` of nerfstudio and instant-ngp: pictures with poses, in OpenGL's camera axes.

The layout is that of https://docs.nerf.studio/quickstart/data_conventions.html: ``fl_x fl_y cx cy w h`` and lens ``k1
k2 k3 p1 p2`` (or ``camera_angle_x``) for all frames or in a frame, and ``frames`` with ``file_path`` and
``transform_matrix`` (camera to world). The first pixel's centre is at 0.5. With ``depth_file_path`` (16-bit PNG,
millimetres unless ``depth_unit_scale_factor`` says otherwise) poses are in metres, otherwise in a unit of their own.
A given scale makes metres of the poses alone: depth images have a unit that the file tells, and poses of structure from
motion with the depth of a sensor are the case in which both differ.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.replay.importers.base import DepthScale, ImportOptions, read_rgb
from semantic_mapper.replay.importers.posed import GL_AXES, PosedPicture, PosedPictures, inside
from semantic_mapper.types import CameraIntrinsics

FILE = "transforms.json"
PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # Blender's data sets leave them out


class _Lens(msgspec.Struct, kw_only=True):
    """Of a frame, or of all of them."""

    camera_model: str | None = None
    camera_angle_x: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    p1: float | None = None
    p2: float | None = None


class _Frame(_Lens, kw_only=True):
    file_path: str
    transform_matrix: list[list[float]]
    depth_file_path: str | None = None


class _Transforms(_Lens, kw_only=True):
    frames: list[_Frame]
    depth_unit_scale_factor: float = 0.001


def open_transforms(folder: Path, options: ImportOptions) -> PosedPictures:
    """A data set of nerfstudio or instant-ngp, opened.

    Raises:
        ImportSourceError: the file is missing or of another form, or a lens that is no pinhole camera's.
    """
    file = folder / FILE
    try:
        found = read_json(file, _Transforms)
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error
    if not 0 < found.depth_unit_scale_factor < 1e3:
        raise ImportSourceError(f"{file}: depth_unit_scale_factor {found.depth_unit_scale_factor:g} cannot be")
    pictures = [_picture(folder, found, frame, number) for number, frame in enumerate(found.frames)]
    pictures.sort(key=lambda picture: numeric_order(picture.file.name))
    scale = DepthScale(1 / found.depth_unit_scale_factor, file)
    measured = any(picture.depth_file is not None and picture.depth_file.is_file() for picture in pictures)
    opened = PosedPictures("transforms", folder, pictures, options, depth_scale=scale, metric=measured)
    if measured and options.scale is not None:
        opened.notices.append(
            f"--scale {options.scale:g} is of the poses; the depth images keep their own unit: {scale}; if depth has "
            f"the unit of the poses, multiply depth_unit_scale_factor by {options.scale:g}, too"
        )
    return opened


def _picture(folder: Path, all_frames: _Transforms, frame: _Frame, number: int) -> PosedPicture:
    where = f"{folder / FILE}, frame {number} ('{frame.file_path[:80]}')"
    named = inside(folder, frame.file_path)
    image = next((p for s in _SUFFIXES if (p := named.with_name(named.name + s)).is_file()), named)
    try:
        T_world_gl = np.array(frame.transform_matrix, np.float64)
        if T_world_gl.shape == (3, 4):
            T_world_gl = np.vstack((T_world_gl, (0, 0, 0, 1)))
        if T_world_gl.shape != (4, 4):
            raise ValueError(f"it is {'x'.join(map(str, T_world_gl.shape))}")
    except ValueError as error:
        raise ImportSourceError(f"{where}: transform_matrix has to be 4x4 numbers: {error}") from error
    depth = None if frame.depth_file_path is None else inside(folder, frame.depth_file_path)
    return PosedPicture(image, _intrinsics(all_frames, frame, image, where), T_world_gl @ GL_AXES, depth)


def _intrinsics(all_frames: _Lens, frame: _Lens, image: Path, where: str) -> CameraIntrinsics:
    def value(name: str) -> Any:
        own = getattr(frame, name)
        return getattr(all_frames, name) if own is None else own

    model = value("camera_model") or "OPENCV"
    if model.upper() not in PINHOLE_MODELS:
        raise ImportSourceError(f"{where}: camera_model '{model}' is no pinhole camera; undistort the images first")
    width, height = value("w"), value("h")
    if width is None or height is None:
        rgb, _ = read_rgb(image)
        height, width = rgb.shape[:2]
    fx, fy = value("fl_x"), value("fl_y")
    if fx is None and value("camera_angle_x") is not None and 0 < value("camera_angle_x") < math.pi:
        fx = width / 2 / math.tan(value("camera_angle_x") / 2)
    if fx is None:
        raise ImportSourceError(f"{where}: has no focal length: fl_x, or camera_angle_x")
    cx, cy = value("cx"), value("cy")
    lens = tuple(float(value(name) or 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    try:
        return CameraIntrinsics(
            float(fx),
            float(fx if fy is None else fy),
            (width / 2 if cx is None else cx) - 0.5,
            (height / 2 if cy is None else cy) - 0.5,
            int(width),
            int(height),
            lens if any(lens) else (),
        )
    except FrameError as error:
        raise ImportSourceError(f"{where}: {error}") from error
