"""OpenSfM's ``reconstruction.json``, as OpenDroneMap makes it, too, with the pictures in ``images``.

The layout is that of https://opensfm.org/docs/dataset.html. Pixels count from the picture's middle, divided by its
longer side. Poses are world to camera, rotations as axis times angle, camera axes are OpenCV's. With a
``reference_lla`` that is not zero OpenSfM has aligned the model by GPS: then x is east, y north, z up, and
lengths are metres. Without, the model is oriented like one of COLMAP.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.geometry import invert_pose
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    PICTURES,
    ImportOptions,
    convert_known,
    inside,
    read_plain_json,
    unknown_keys,
    unknown_notice,
)
from semantic_mapper.replay.importers.posed import PosedModel, PosedPicture, PosedPictures, has_picture, place_model
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, GpsPosition
from semantic_mapper.replay.sfm.scale import RegisteredFrame, median_depth, scene_depth
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float64

FILE, REFERENCE = "reconstruction.json", "reference_lla.json"
MAX_BYTES = 1 << 31
PINHOLE = ("perspective", "simple_radial", "radial", "brown")  # of lenses that OpenCV's pinhole model has
FISHEYE = ("fisheye", "fisheye_opencv")  # and its fisheye model
_LOOKED_AT, _POINTS = 20, 5000  # cameras and points whose depth is looked at

ReadT = TypeVar("ReadT")
Vector = tuple[float, float, float]


class _Camera(msgspec.Struct):
    width: float
    height: float
    projection_type: str = "perspective"
    focal: float | None = None
    focal_x: float | None = None
    focal_y: float | None = None
    c_x: float = 0.0
    c_y: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


class _PosedImage(msgspec.Struct):
    rotation: Vector
    translation: Vector
    camera: str
    capture_time: Any = None  # seconds; 0 = not known


class _Reference(msgspec.Struct):
    latitude: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    longitude: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    altitude: float


class _Model(msgspec.Struct):
    cameras: dict[str, Any] = {}  # each is read by itself, so that a bad one costs no other
    shots: dict[str, Any] = {}
    points: Any = None  # they tell the depth alone
    reference_lla: _Reference | None = None


def find_opensfm(folder: Path) -> Path | None:
    """The file of a reconstruction: here, or below ``opensfm``; None = none."""
    return next((f for f in (folder / FILE, folder / "opensfm" / FILE) if f.is_file()), None)


def open_opensfm(folder: Path, options: ImportOptions) -> PosedPictures:
    """The largest reconstruction of a folder, opened.

    Raises:
        ImportSourceError: none, one that cannot be read, no folder of pictures, or a lens that is no pinhole camera's.
    """
    file = find_opensfm(folder)
    if file is None:
        raise ImportSourceError(f"{folder}: no {FILE} in it, or below opensfm/")
    plain = read_plain_json(file, MAX_BYTES, list)
    sizes = [len(_table(_table(model).get("shots"))) for model in plain]
    if not any(sizes):
        raise ImportSourceError(f"{file}: holds no posed picture")
    number = sizes.index(max(sizes))
    model = convert_known(plain[number], _Model, str(file))
    names = sorted(model.shots, key=numeric_order)
    root = _root(folder, file, names)
    cameras: dict[str, CameraIntrinsics | str] = {}
    for camera, values in model.cameras.items():
        try:
            where = f"{file}, camera '{camera}'"
            cameras[camera] = _intrinsics(convert_known(values, _Camera, where), where)
        except ImportSourceError as error:
            cameras[camera] = str(error)
    pictures: list[PosedPicture] = []
    left_out: list[str] = []
    for name in names:
        try:
            shot = convert_known(model.shots[name], _PosedImage, f"{file}, shot '{name}'")
            pictures.append(_picture(root, name, shot, cameras, file))
        except ImportSourceError as error:
            left_out.append(str(error))
    if not pictures:
        raise ImportSourceError(left_out[0])
    poses = np.stack([picture.T_world_camera for picture in pictures])
    reference = model.reference_lla or _reference_in_file(file)
    if reference is None or not (reference.latitude or reference.longitude):
        posed = place_model(poses, pictures, options, lambda: _depth(model.points, pictures))
    elif options.scale is not None:
        raise ImportSourceError(f"{file}: is in metres already, by GPS; leave out --scale")
    else:
        origin = GpsPosition(reference.latitude, reference.longitude, reference.altitude)
        said = ["scale, up and north are those that OpenSfM found by GPS"]
        far = scene_depth(_depth(model.points, pictures))
        posed = PosedModel(poses, True, said, {ORIGIN_KEY: str(origin), **far})
    opened = posed.pictures("opensfm", folder, pictures, options)
    opened.notices += unknown_notice(file, unknown_keys(map(_table, model.cameras.values()), _Camera))
    unposed = [
        path for path in sorted(root.iterdir()) if path.suffix.lower() in PICTURES and path.name not in model.shots
    ]
    if left_out:
        opened.notices.append(f"{counted(len(left_out), 'picture')} left out; the first: {left_out[0]}")
    if unposed:
        opened.notices.append(
            f"{counted(len(unposed), 'picture')} in {root} without a pose; the first: {unposed[0].name}"
        )
    if len(sizes) > 1:
        others = ", ".join(str(size) for n, size in enumerate(sizes) if n != number)
        opened.notices.append(
            f"the reconstruction fell into {len(sizes)} parts; the largest is imported, those of {others} "
            "pictures are not"
        )
    return opened


def _table(value: Any) -> dict[str, Any]:
    """What is of another type holds nothing."""
    return value if isinstance(value, dict) else {}


def _read(file: Path, kind: type[ReadT]) -> ReadT:
    try:
        return read_json(file, kind, MAX_BYTES)
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error


def _reference_in_file(file: Path) -> _Reference | None:
    """Older versions keep it in a file of its own."""
    other = file.with_name(REFERENCE)
    return _read(other, _Reference) if other.is_file() else None


def _root(folder: Path, file: Path, names: list[str]) -> Path:
    roots = (file.parent / "images", folder / "images", file.parent.parent / "images", file.parent)
    for root in roots:
        if any(has_picture(root, name) for name in names):
            return root
    inside(roots[0], names[0])  # tells of a name that leads out of it
    raise ImportSourceError(f"{folder}: the pictures are missing; '{names[0]}' is not in {roots[0]}")


def _picture(
    root: Path, name: str, shot: _PosedImage, cameras: Mapping[str, CameraIntrinsics | str], file: Path
) -> PosedPicture:
    camera = cameras.get(shot.camera, f"{file}, shot '{name}': its camera '{shot.camera}' is missing")
    if isinstance(camera, str):
        raise ImportSourceError(camera)
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = cv2.Rodrigues(np.array(shot.rotation))[0]
    T_camera_world[:3, 3] = shot.translation
    time = shot.capture_time
    time_s = time if type(time) in (int, float) and 0 < time < MAX_STAMP_NS / 1e9 else None
    stamp_ns = None if time_s is None else round(time_s * 1e9)
    return PosedPicture(inside(root, name), camera, invert_pose(T_camera_world), stamp_ns=stamp_ns)


def _intrinsics(camera: _Camera, where: str) -> CameraIntrinsics:
    fisheye = camera.projection_type in FISHEYE
    if not fisheye and (camera.projection_type not in PINHOLE or camera.k4):
        raise ImportSourceError(
            f"{where}: the lens model '{camera.projection_type}'{' with k4' if camera.k4 else ''} is not read, but "
            f"{', '.join((*PINHOLE, *FISHEYE))}; run `opensfm undistort` and import the folder undistorted"
        )
    fx = camera.focal if camera.focal_x is None else camera.focal_x
    fy = fx if camera.focal_y is None else camera.focal_y
    if fx is None or fy is None:
        raise ImportSourceError(f"{where}: has no focal length: focal, or focal_x and focal_y")
    size = max(camera.width, camera.height)
    cx, cy = camera.c_x * size + camera.width / 2 - 0.5, camera.c_y * size + camera.height / 2 - 0.5
    lens = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3)
    if fisheye and (camera.p1 or camera.p2):
        raise ImportSourceError(f"{where}: a fisheye with p1 and p2 is not read; run `opensfm undistort`")
    if fisheye:
        lens = (camera.k1, camera.k2, camera.k3, camera.k4)
    try:
        sides = (int(camera.width), int(camera.height))
        return lens_intrinsics("fisheye" if fisheye else "opencv", lens, (fx * size, fy * size, cx, cy), sides)
    except (ConfigError, FrameError) as error:
        raise ImportSourceError(f"{where}: {error}") from error


def _depth(points: Any, pictures: list[PosedPicture]) -> float:
    """Median depth of the points in front of some cameras and within their pictures; 0 without points."""
    rows = [_table(point).get("coordinates") for point in _table(points).values()]
    numbers = [
        row
        for row in rows[:: max(1, len(rows) // _POINTS)]
        if isinstance(row, list) and len(row) == 3 and all(isinstance(value, int | float) for value in row)
    ]
    xyz = np.array(numbers, np.float64).reshape(-1, 3)
    step = max(1, len(pictures) // _LOOKED_AT)
    frames = [RegisteredFrame(0, p.T_world_camera, _seen(xyz, p)) for p in pictures[::step]]
    return median_depth(frames) if any(len(frame.xyz) for frame in frames) else 0.0


def _seen(xyz: Float64, picture: PosedPicture) -> Float64:
    T_camera_world, k = invert_pose(picture.T_world_camera), picture.intrinsics
    p = xyz @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    z = np.maximum(p[:, 2], 1e-9)
    inside_x = np.abs(k.fx * p[:, 0] / z + k.cx - k.width / 2) < k.width / 2
    inside_y = np.abs(k.fy * p[:, 1] / z + k.cy - k.height / 2) < k.height / 2
    return xyz[(p[:, 2] > 0) & inside_x & inside_y]
