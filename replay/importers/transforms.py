"""``transforms.json`` of nerfstudio and instant-ngp: pictures with poses, in OpenGL's camera axes.

The layout is that of https://docs.nerf.studio/quickstart/data_conventions.html: ``fl_x fl_y cx cy w h`` and lens ``k1
k2 k3 p1 p2`` (or ``camera_angle_x``, ``camera_angle_y``) for all frames or in a frame, and ``frames`` with
``file_path`` and ``transform_matrix`` (camera to world). The first pixel's centre is at 0.5. ``camera_model``
OPENCV_FISHEYE, or instant-ngp's ``is_fisheye``, means OpenCV's fisheye lens, ``k1 k2 k3 k4``.

With ``depth_file_path`` (16-bit PNG, millimetres unless ``depth_unit_scale_factor`` says otherwise) poses are in
metres, otherwise in a unit of their own. A given scale makes metres of the poses alone: such depth images have a unit
that the file tells, and poses of structure from motion with the depth of a sensor are the case in which both differ.
The depth of instant-ngp, ``depth_path``, is in the unit of the poses, times ``integer_depth_scale``, and is scaled with
them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.drivers.lens import is_fisheye_model
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.replay.importers.base import BadFrameError, DepthScale, ImportOptions, camera_of, first_size
from semantic_mapper.replay.importers.posed import GL_AXES, PosedPicture, PosedPictures
from semantic_mapper.replay.importers.tables import (
    convert_known,
    inside,
    keep_good,
    left_out_notice,
    read_plain_json,
    refuse_keys,
    unknown_notice,
)
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float64

FILE = "transforms.json"
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # Blender's data sets leave them out
_NEUTRAL = (  # they turn or fit the world, or are of training
    "aabb_scale", "orientation_override", "auto_scale_poses_override", "enable_depth_loading",
)  # fmt: skip
# Lenses of instant-ngp and nerfstudio that are not undone, and poses in other axes or units than nerfstudio's.
_REFUSED = re.compile(
    r"latlong|equirectangular|orthographic|ftheta\w*|distortion_params|from_mitsuba|from_na|units?"
    r"|(camera_|world_)?(coordinate_system|coordinate_convention|convention|axes)"
)
_OUR_AXES = ("opengl", "blender", "nerf", "nerfstudio", "arkit")
_BELIEVABLE_S = (1e-3, 10.0)  # between two frames


class _Lens(msgspec.Struct, kw_only=True):
    """Of a frame, or of all of them."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    x_fov: float | None = None  # of instant-ngp, degrees
    y_fov: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    k5: float | None = None
    k6: float | None = None
    p1: float | None = None
    p2: float | None = None


class _Frame(_Lens, kw_only=True):
    file_path: str
    transform_matrix: list[list[float]] | None = None
    depth_file_path: str | None = None
    depth_path: str | None = None
    timestamp: float | str | None = None  # in a unit that nothing tells


class _Transforms(_Lens, kw_only=True):
    frames: list[dict[str, Any]]
    depth_unit_scale_factor: float | None = None
    integer_depth_scale: float | None = None
    applied_scale: float | None = None  # of nerfstudio: what poses were multiplied by
    applied_transform: list[list[float]] | None = None  # what they were moved by


def open_transforms(folder: Path, options: ImportOptions) -> PosedPictures:
    """A data set of nerfstudio or instant-ngp, opened.

    Raises ImportSourceError: the file is missing or of another form, or a lens that cannot be undone.
    """
    file = folder / FILE
    plain = {key: value for key, value in read_plain_json(file).items() if value not in _OUR_AXES}
    found = convert_known(plain, _Transforms, file)
    refuse_keys(plain, _REFUSED, file)
    notices = unknown_notice(file, [plain], _Transforms, _NEUTRAL) + unknown_notice(file, found.frames, _Frame)
    left_out: list[str] = []

    def read_frame(numbered: tuple[int, dict[str, Any]]) -> tuple[_Frame, Path]:
        where = f"{file}, frame {numbered[0]}"
        refuse_keys(numbered[1], _REFUSED, where)
        frame = convert_known(numbered[1], _Frame, where)
        return frame, _image(folder, frame.file_path)

    read = keep_good(read_frame, enumerate(found.frames), left_out)
    frames = [frame for frame, _ in read]
    if read and (found.w is None or found.h is None):
        found.w, found.h = first_size((image for _, image in read), folder)
    stamps_ns = _stamps([_time(frame) for frame in frames], file, notices)
    factor = _metres_per_unit(found, file, notices) if options.scale is None else 1.0

    def picture_of(stamped: tuple[tuple[_Frame, Path], int | None]) -> PosedPicture:
        (frame, image), stamp_ns = stamped
        lens, pose = _intrinsics(found, frame, image), _pose(frame.transform_matrix, image)
        pose[:3, 3] *= factor
        depth = frame.depth_file_path or frame.depth_path
        return PosedPicture(image, lens, pose, stamp_ns, inside(folder, depth) if depth else None)

    pictures = keep_good(picture_of, zip(read, stamps_ns, strict=True), left_out)
    notices += left_out_notice("frame", left_out)
    pictures.sort(key=lambda picture: numeric_order(picture.file.name))
    scale = _depth_scale(file, found, frames, options, factor)
    has_sensor = any(frame.depth_file_path for frame in frames) and not options.without_depth
    if has_sensor and options.scale is not None:
        notices.append(
            f"--scale {options.scale:g} is of the poses; the depth images keep their own unit: {scale}; if depth has "
            f"the unit of the poses, multiply depth_unit_scale_factor by {options.scale:g}, too"
        )
    return PosedPictures(f"transforms {folder.resolve().name}", pictures, options, scale, notices, metric=has_sensor)


def _depth_scale(
    file: Path, found: _Transforms, frames: Sequence[_Frame], options: ImportOptions, factor: float
) -> DepthScale:
    """Of the depth images; ``factor`` is what the positions of the file were multiplied by."""
    unit = found.depth_unit_scale_factor
    if any(f.depth_path and not f.depth_file_path for f in frames) and not options.without_depth:  # of instant-ngp
        unit = (found.integer_depth_scale or 0.0) * (options.scale or 1.0) * factor  # depth follows the poses
    if unit is None:
        return DepthScale(
            1000.0, convention="nerfstudio's millimetres; another unit belongs into depth_unit_scale_factor"
        )
    if not 0 < unit < 1e3:
        raise ImportSourceError(
            f"{file}: {unit:g} m cannot be the unit of depth; depth_path needs integer_depth_scale, the unit of the "
            "poses per number of the depth images, and depth_file_path takes depth_unit_scale_factor, in metres; write "
            "it, or import without depth (--topic depth=none)"
        )
    return DepthScale(1 / unit, file, float_units_per_m=1 / unit)


def _image(folder: Path, name: str) -> Path:
    named = inside(folder, name)
    return next((p for s in _SUFFIXES if (p := named.with_name(named.name + s)).is_file()), named)


def _metres_per_unit(found: _Transforms, file: Path, notices: list[str]) -> float:
    """What makes positions those that they were before nerfstudio has scaled them."""
    scale = found.applied_scale or 1.0
    if found.applied_transform is not None:
        try:
            determinant = float(np.linalg.det(np.array(found.applied_transform, np.float64)[:3, :3]))
        except (ValueError, IndexError, np.linalg.LinAlgError):
            determinant = 0.0
        scale *= float(np.cbrt(determinant))
    if not 1e-6 < scale < 1e6:
        raise ImportSourceError(f"{file}: a scale of {scale:g} (applied_scale, applied_transform) cannot be")
    if abs(scale - 1) < 1e-6:
        return 1.0
    notices.append(f"{file}: positions are multiplied by {1 / scale:g}, as applied_scale and applied_transform say")
    return 1 / scale


def _time(frame: _Frame) -> float | None:
    """A frame's time in the file's unit; None if it is missing or impossible."""
    try:
        time = float(frame.timestamp) if frame.timestamp is not None else math.nan
    except ValueError:
        return None
    return time if 0 <= time < math.inf else None


def _stamps(times: Sequence[float | None], file: Path, notices: list[str]) -> list[int | None]:
    """Nanoseconds. The unit is that of Unix times where they are as large as these, else it follows from the gap."""
    known = np.sort([time for time in times if time is not None])
    if not len(known):
        return [None] * len(times)
    gap = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    unix = [n for n in range(4) if 1e9 <= known[-1] / 1000**n <= 4e9 and gap / 1000**n <= 1000]
    usual = [n for n in range(4) if _BELIEVABLE_S[0] <= gap / 1000**n <= _BELIEVABLE_S[1]]
    steps = next(iter((*unix, *usual)), 0)
    name = ("seconds", "milliseconds", "microseconds", "nanoseconds")[steps]
    rate = f", {1000**steps / gap:.3g} frames a second" if gap else ""
    notices.append(f"{file}: 'timestamp' is read as {name}{rate}")
    unit_ns = 1e9 / 1000**steps
    return [None if t is None or t * unit_ns >= MAX_STAMP_NS else round(t * unit_ns) for t in times]


def _pose(rows: list[list[float]] | None, image: Path) -> Float64:
    """``T_world_camera`` (4, 4)."""
    try:
        T = np.array(rows if rows is not None else [], np.float64)
    except ValueError:
        T = np.zeros(0)
    if T.shape == (3, 4):
        T = np.vstack((T, (0, 0, 0, 1)))
    if T.shape != (4, 4):
        raise BadFrameError(image, "has no transform_matrix of 4x4 numbers")
    return T @ GL_AXES


def _intrinsics(of_all: _Lens, frame: _Frame, image: Path) -> CameraIntrinsics:
    own, shared = _given(frame), _given(of_all)
    k: dict[str, Any] = {**shared, **own}
    (fx, fy), (all_fx, all_fy) = _focals(own, k), _focals(shared, k)
    fx, fy = (fx, fy) if fx or fy else (all_fx, all_fy)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise BadFrameError(image, "has no focal length: fl_x, or camera_angle_x")
    model = k.get("camera_model", "OPENCV")
    lens, other = ("k1", "k2", "p1", "p2", "k3"), ("k4", "k5", "k6")
    if k.get("is_fisheye") or is_fisheye_model(model):
        model, lens, other = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4"), ("p1", "p2", "k5", "k6")
    strange = [name for name in other if k.get(name)]
    if strange:
        raise BadFrameError(
            image,
            f"camera_model '{model}' has no {', '.join(strange)} that programs agree on; undistort the images first",
        )
    centre = k.get("cx", k["w"] / 2) - 0.5, k.get("cy", k["h"] / 2) - 0.5
    return camera_of(image, (fx, fy, *centre), (k["w"], k["h"]), model, [k.get(name, 0.0) for name in lens])


def _given(lens: _Lens) -> dict[str, Any]:
    values = {name: getattr(lens, name) for name in _Lens.__struct_fields__}
    return {name: value for name, value in values.items() if value is not None}


def _focals(lens: Mapping[str, Any], k: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """fx and fy of what a frame, or the file, says of them."""

    def focal(name: str, side: float) -> float | None:
        if lens.get(f"fl_{name}"):
            return lens[f"fl_{name}"]
        angle = lens.get(f"camera_angle_{name}", math.radians(lens.get(f"{name}_fov", 0.0)))
        return side / 2 / math.tan(angle / 2) if 0 < angle < math.pi else None

    return focal("x", k["w"]), focal("y", k["h"])
