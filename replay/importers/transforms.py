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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from semantic_mapper.drivers.lens import is_fisheye_model, lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    convert_known,
    first_size,
    inside,
    read_plain_json,
    refuse_keys,
    unknown_keys,
    unknown_notice,
)
from semantic_mapper.replay.importers.posed import GL_AXES, PosedPicture, PosedPictures
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float64

FILE = "transforms.json"
MAX_BYTES = 1 << 29  # hours of frames at 60 Hz
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # Blender's data sets leave them out
_NEUTRAL = (  # they turn or fit the world, or are of training
    "aabb_scale", "orientation_override", "auto_scale_poses_override", "enable_depth_loading",
)  # fmt: skip
_OTHER_AXES = ("from_mitsuba", "from_na")  # instant-ngp's flags for poses of another convention
_OTHER_LENS = re.compile(r"latlong|equirectangular|orthographic|ftheta\w*|distortion_params")  # instant-ngp, nerfstudio
_AXES = re.compile(r"(camera_|world_)?(coordinate_system|coordinate_convention|convention|axes)", re.IGNORECASE)


class _Lens(msgspec.Struct, kw_only=True):
    """Of a frame, or of all of them."""

    camera_model: str | None = None
    lens_model: str | None = None
    distortion_model: str | None = None
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
    units: str | None = None  # of the poses
    unit: str | None = None
    from_mitsuba: bool | None = None
    from_na: bool | None = None


def open_transforms(folder: Path, options: ImportOptions) -> PosedPictures:
    """A data set of nerfstudio or instant-ngp, opened.

    Raises:
        ImportSourceError: the file is missing or of another form, or a lens that cannot be undone.
    """
    file = folder / FILE
    plain = cast("dict[str, Any]", read_plain_json(file, MAX_BYTES))
    found = convert_known(plain, _Transforms, str(file))
    for name in _OTHER_AXES:
        if getattr(found, name):
            raise ImportSourceError(f"{file}: '{name}' means poses in other axes than OpenGL's, which are not read")
    refuse_keys(plain, _OTHER_LENS, str(file))
    axes = _camera_axes(plain, file)
    left_out: list[str] = []
    frames: list[tuple[int, _Frame]] = []
    for number, frame in enumerate(found.frames):
        try:
            refuse_keys(frame, _OTHER_LENS, f"{file}, frame {number}")
            frames.append((number, convert_known(frame, _Frame, f"{file}, frame {number}")))
        except ImportSourceError as error:
            left_out.append(str(error))
    notices = unknown_notice(
        file,
        [
            *unknown_keys([{k: v for k, v in plain.items() if not _AXES.fullmatch(k)}], _Transforms, _NEUTRAL),
            *unknown_keys(found.frames, _Frame),
        ],
    )
    size = _common_size(folder, found, [frame for _, frame in frames])
    pictures: list[PosedPicture] = []
    stamps_ns = _stamps([_time(frame) for _, frame in frames], file, notices)
    metres = _metres_per_unit(found, file, notices) if options.scale is None else None
    for (number, frame), stamp_ns in zip(frames, stamps_ns, strict=True):
        try:
            where = f"{file}, frame {number} ('{frame.file_path[:80]}')"
            pictures.append(_picture(folder, found, frame, size, axes, stamp_ns, where))
        except ImportSourceError as error:
            left_out.append(str(error))
    if left_out:
        notices.append(f"{counted(len(left_out), 'frame')} of {len(found.frames)} left out; the first: {left_out[0]}")
    if not pictures and left_out:
        raise ImportSourceError(f"{folder}: holds no posed picture: {left_out[0]}")
    pictures.sort(key=lambda picture: numeric_order(picture.file.name))
    if metres is not None:
        for picture in pictures:
            picture.T_world_camera[:3, 3] *= metres
    scale, measured, said = _depth_scale(file, found, [frame for _, frame in frames], pictures, options, metres or 1.0)
    opened = PosedPictures(
        "transforms",
        folder,
        pictures,
        options,
        depth_scale=scale,
        metric=measured or bool(_unit(found)),
    )
    opened.notices += [*notices, *said]
    return opened


def _depth_scale(
    file: Path,
    found: _Transforms,
    frames: Sequence[_Frame],
    pictures: Sequence[PosedPicture],
    options: ImportOptions,
    multiplied: float,
) -> tuple[DepthScale, bool, list[str]]:
    """Of the depth images, whether there is one that makes the poses metres, and what is to be said of them.

    ``multiplied`` is what the positions of the file were multiplied by already.
    """
    there = [
        picture.depth_file for picture in pictures if picture.depth_file is not None and picture.depth_file.is_file()
    ]
    if any(frame.depth_path and not frame.depth_file_path for frame in frames):
        if any(frame.depth_file_path for frame in frames):
            raise ImportSourceError(f"{file}: has depth_file_path and depth_path, of two units; keep one of them")
        factor = found.integer_depth_scale or 0.0
        if not 0 < factor < 1e3:
            if options.without_depth:
                return DepthScale(1000.0, convention="not read"), False, []
            raise ImportSourceError(
                f"{file}: depth_path needs integer_depth_scale, the unit of the poses per number of the depth images; "
                "write it, or import without depth (--topic depth=none)"
            )
        units = 1 / (factor * (options.scale or 1.0) * multiplied)  # depth in the unit of the poses follows them
        return DepthScale(units, file, float_units_per_m=units), False, []
    factor = 0.001 if found.depth_unit_scale_factor is None else found.depth_unit_scale_factor
    if not 0 < factor < 1e3:
        raise ImportSourceError(f"{file}: depth_unit_scale_factor {factor:g} cannot be")
    said: list[str] = []
    scale = DepthScale(1 / factor, file, float_units_per_m=1 / factor)
    if found.depth_unit_scale_factor is None:
        scale = DepthScale(
            1000.0, convention="nerfstudio's millimetres; another unit belongs into depth_unit_scale_factor"
        )
    measured = bool(there) and not options.without_depth
    if measured and options.scale is not None:
        said.append(
            f"--scale {options.scale:g} is of the poses; the depth images keep their own unit: {scale}; if depth has "
            f"the unit of the poses, multiply depth_unit_scale_factor by {options.scale:g}, too"
        )
    return scale, measured, said


def _camera_axes(plain: Mapping[str, Any], file: Path) -> Float64:
    """``T_given_cv`` (4, 4): OpenGL's axes, unless a key says OpenCV's.

    Raises:
        ImportSourceError: a key names other axes.
    """
    for key, value in plain.items():
        if isinstance(value, str) and _AXES.fullmatch(key):
            if value.strip().lower() in ("opencv", "colmap"):
                return np.eye(4)
            if value.strip().lower() not in ("opengl", "blender", "nerf", "nerfstudio", "arkit", ""):
                raise ImportSourceError(f"{file}: '{key}' is '{value[:40]}'; camera axes of OpenGL and OpenCV are read")
    return GL_AXES


def _common_size(folder: Path, found: _Transforms, frames: Sequence[_Frame]) -> tuple[int, int] | None:
    """(width, height) of the first picture that can be read, for files that do not tell it; None = none."""
    if found.w is not None and found.h is not None:
        return None

    def images() -> Iterator[Path]:
        for frame in frames:
            with suppress(ImportSourceError):  # reported when its turn comes
                yield _image(folder, frame)

    return first_size(images())


def _image(folder: Path, frame: _Frame) -> Path:
    named = inside(folder, frame.file_path)
    return next((p for s in _SUFFIXES if (p := named.with_name(named.name + s)).is_file()), named)


_UNITS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
}
_BELIEVABLE_S = (1e-3, 10.0)  # between two frames


def _unit(found: _Transforms) -> str:
    return (found.units or found.unit or "").strip().lower()


def _metres_per_unit(found: _Transforms, file: Path, notices: list[str]) -> float | None:
    """What makes translations those that they were before a program has scaled them, in metres; None = nothing.

    Raises:
        ImportSourceError: a unit that is not known, or a scale that cannot be.
    """
    unit, scale = _unit(found), found.applied_scale or 1.0
    if unit and unit not in _UNITS:
        raise ImportSourceError(f"{file}: the unit '{unit[:40]}' is not known, only m, cm and mm; convert the poses")
    if found.applied_transform is not None:
        A = np.array(found.applied_transform, np.float64)
        if A.shape not in ((3, 4), (4, 4)) or not np.linalg.det(A[:3, :3]) > 1e-9:
            raise ImportSourceError(f"{file}: applied_transform is no rotation with a scale")
        scale *= float(np.cbrt(np.linalg.det(A[:3, :3])))
    if not 1e-6 < scale < 1e6:
        raise ImportSourceError(f"{file}: a scale of {scale:g} (applied_scale, applied_transform) cannot be")
    factor = _UNITS.get(unit, 1.0) / scale
    if abs(factor - 1) < 1e-6:
        return None
    notices.append(f"{file}: positions are multiplied by {factor:g}, as units, applied_scale and applied_transform say")
    return factor


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


def _picture(
    folder: Path,
    all_frames: _Transforms,
    frame: _Frame,
    size: tuple[int, int] | None,
    axes: Float64,
    stamp_ns: int | None,
    where: str,
) -> PosedPicture:
    image = _image(folder, frame)
    T_world_gl = _matrix(frame.transform_matrix, image)
    depth = frame.depth_file_path or frame.depth_path
    lens = _intrinsics(all_frames, frame, size, where)
    return PosedPicture(image, lens, T_world_gl @ axes, None if not depth else inside(folder, depth), stamp_ns)


def _matrix(rows: list[list[float]] | None, image: Path) -> Float64:
    if rows is None:
        raise BadFrameError(image, "has no transform_matrix")
    try:
        T = np.array(rows, np.float64)
    except ValueError as error:
        raise BadFrameError(image, f"transform_matrix has to be 4x4 numbers: {error}") from error
    if T.shape == (3, 4):
        T = np.vstack((T, (0, 0, 0, 1)))
    if T.shape != (4, 4):
        raise BadFrameError(image, f"transform_matrix has to be 4x4 numbers: it is {'x'.join(map(str, T.shape))}")
    return T


def _intrinsics(all_frames: _Lens, frame: _Lens, size: tuple[int, int] | None, where: str) -> CameraIntrinsics:
    values = {name: own if own is not None else getattr(all_frames, name) for name, own in _fields(frame).items()}
    width, height = values["w"], values["h"]
    if width is None or height is None:
        if size is None:
            raise ImportSourceError(f"{where}: has no w and h, and no picture that tells them")
        width, height = size
    own_fx, own_fy = (
        frame.fl_x or _focal(_angle(frame.camera_angle_x, frame.x_fov), width),
        frame.fl_y or _focal(_angle(frame.camera_angle_y, frame.y_fov), height),
    )
    angles = (
        _angle(all_frames.camera_angle_x, all_frames.x_fov),
        _angle(all_frames.camera_angle_y, all_frames.y_fov),
    )
    fx = own_fx or all_frames.fl_x or _focal(angles[0], width)
    fy = own_fy or (None if own_fx else all_frames.fl_y or _focal(angles[1], height))
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise ImportSourceError(f"{where}: has no focal length: fl_x, or camera_angle_x")
    cx = width / 2 if values["cx"] is None else values["cx"]
    cy = height / 2 if values["cy"] is None else values["cy"]
    k1, k2, k3, k4, p1, p2 = (values[name] or 0.0 for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = values["camera_model"] or values["lens_model"] or values["distortion_model"] or "OPENCV"
    if values["is_fisheye"] or is_fisheye_model(model):
        model, lens, left = "OPENCV_FISHEYE", (k1, k2, k3, k4), {"p1": p1, "p2": p2}
    else:
        lens, left = (k1, k2, p1, p2, k3), {"k4": k4}
    left |= {name: values[name] or 0.0 for name in ("k5", "k6")}
    strange = [name for name, value in left.items() if value]
    if strange:
        raise ImportSourceError(
            f"{where}: camera_model '{model}' has no {', '.join(strange)} that programs agree on; undistort the images "
            "first"
        )
    try:
        return lens_intrinsics(model, lens, (fx, fy, cx - 0.5, cy - 0.5), (int(width), int(height)))
    except (ConfigError, FrameError) as error:
        raise ImportSourceError(f"{where}: {error}") from error


def _fields(lens: _Lens) -> Mapping[str, Any]:
    return {name: getattr(lens, name) for name in _Lens.__struct_fields__}


def _angle(radians: float | None, degrees: float | None) -> float | None:
    return radians if radians is not None or degrees is None else math.radians(degrees)


def _focal(angle: float | None, side: float) -> float | None:
    return side / 2 / math.tan(angle / 2) if angle is not None and 0 < angle < math.pi else None
