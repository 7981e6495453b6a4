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

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from semantic_mapper.drivers.lens import is_fisheye_model
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import BadFrameError, DepthScale, ImportOptions, camera_of, first_size
from semantic_mapper.replay.importers.posed import GL_AXES, PosedPicture, PosedPictures
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import CameraIntrinsics

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
# A frame's own stand for all of the file's.
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
_Row = tuple[float, float, float, float]
_Matrix = Annotated[list[_Row], msgspec.Meta(min_length=3, max_length=4)]


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
    transform_matrix: _Matrix
    depth_file_path: str | None = None
    depth_path: str | None = None


class _Transforms(_Lens, kw_only=True):
    frames: list[dict[str, Any]]
    depth_unit_scale_factor: float | None = None
    integer_depth_scale: float | None = None
    applied_scale: float | None = None  # of nerfstudio: what poses were multiplied by
    applied_transform: _Matrix | None = None  # what they were moved by


def open_transforms(folder: Path, options: ImportOptions) -> PosedPictures:
    """A data set of nerfstudio or instant-ngp, opened.

    Raises ImportSourceError: the file is missing or of another form, or a lens that cannot be undone.
    """
    file = folder / FILE
    plain = {key: value for key, value in tables.read_plain_json(file).items() if value not in _OUR_AXES}
    found = tables.convert_known(plain, _Transforms, file)
    tables.refuse_keys(plain, _REFUSED, file)
    notices = tables.unknown_notice(file, [plain], _Transforms, _NEUTRAL)
    notices += tables.unknown_notice(file, found.frames, _Frame)
    shared = {name: value for name in _Lens.__struct_fields__ if (value := getattr(found, name)) is not None}

    def read_frame(numbered: tuple[int, dict[str, Any]]) -> tuple[_Frame, Path]:
        where = f"{file}, frame {numbered[0]}"
        tables.refuse_keys(numbered[1], _REFUSED, where)
        own = {key: value for key, value in numbered[1].items() if value is not None}
        of_all = {key: shared[key] for key in shared if key not in _FOCAL or not any(own.get(name) for name in _FOCAL)}
        frame = tables.convert_known(of_all | own, _Frame, where)
        return frame, _image(folder, frame.file_path)

    read = tables.keep_good(read_frame, enumerate(found.frames), "frame", notices)
    frames = [frame for frame, _ in read]
    size = (0.0, 0.0) if (found.w and found.h) or not read else first_size((image for _, image in read), folder)
    factor = _metres_per_unit(found, file, notices) if options.scale is None else 1.0

    def picture_of(read: tuple[_Frame, Path]) -> PosedPicture:
        frame, image = read
        T = np.eye(4)
        T[: len(frame.transform_matrix)] = frame.transform_matrix
        T[:3, 3] *= factor
        lens = _intrinsics(frame, (frame.w or size[0], frame.h or size[1]), image)
        depth = frame.depth_file_path or frame.depth_path
        return PosedPicture(image, lens, T @ GL_AXES, depth_file=tables.inside(folder, depth) if depth else None)

    pictures = tables.keep_good(picture_of, read, "frame", notices)
    pictures.sort(key=lambda picture: numeric_order(picture.file.name))
    scale = _depth_scale(file, found, frames, options, factor)
    has_sensor = any(frame.depth_file_path for frame in frames) and not options.without_depth
    if has_sensor and options.scale is not None:
        notices.append(
            f"--scale {options.scale:g} is of the poses; the depth images keep their own unit: {scale}; if depth has "
            f"the unit of the poses, multiply depth_unit_scale_factor by {options.scale:g}, too"
        )
    source, scale_from = f"transforms {folder.resolve().name}", "" if has_sensor else SCALE_UNKNOWN
    return PosedPictures(source, pictures, options, scale, notices, scale_from=scale_from)


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
    named = tables.inside(folder, name)
    return next((p for s in _SUFFIXES if (p := named.with_name(named.name + s)).is_file()), named)


def _metres_per_unit(found: _Transforms, file: Path, notices: list[str]) -> float:
    """What makes positions those that they were before nerfstudio has scaled them."""
    scale = found.applied_scale or 1.0
    if found.applied_transform is not None:
        scale *= float(np.cbrt(np.linalg.det(np.array(found.applied_transform)[:3, :3])))
    if not 1e-6 < scale < 1e6:
        raise ImportSourceError(f"{file}: a scale of {scale:g} (applied_scale, applied_transform) cannot be")
    if abs(scale - 1) < 1e-6:
        return 1.0
    notices.append(f"{file}: positions are multiplied by {1 / scale:g}, as applied_scale and applied_transform say")
    return 1 / scale


def _intrinsics(k: _Frame, size: tuple[float, float], image: Path) -> CameraIntrinsics:
    fx = k.fl_x or _focal(k.camera_angle_x, k.x_fov, size[0])
    fy = k.fl_y or _focal(k.camera_angle_y, k.y_fov, size[1])
    fx, fy = fx or fy, fy or fx
    if not fx or not fy:
        raise BadFrameError(image, "has no focal length: fl_x, or camera_angle_x")
    model = k.camera_model or "OPENCV"
    lens, other = ("k1", "k2", "p1", "p2", "k3"), ("k4", "k5", "k6")
    if k.is_fisheye or is_fisheye_model(model):
        model, lens, other = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4"), ("p1", "p2", "k5", "k6")
    strange = [name for name in other if getattr(k, name)]
    if strange:
        raise BadFrameError(
            image,
            f"camera_model '{model}' has no {', '.join(strange)} that programs agree on; undistort the images first",
        )
    cx, cy = (side / 2 if c is None else c for side, c in zip(size, (k.cx, k.cy), strict=True))
    coefficients = [getattr(k, name) or 0.0 for name in lens]
    return camera_of(image, (fx, fy, cx - 0.5, cy - 0.5), size, model, coefficients)


def _focal(angle: float | None, fov_deg: float | None, side: float) -> float | None:
    angle = math.radians(fov_deg or 0.0) if angle is None else angle
    return side / 2 / math.tan(angle / 2) if 0 < angle < math.pi else None
