"""Models of structure from motion, with their pictures: COLMAP's, and OpenSfM's, as OpenDroneMap makes them, too.

Where the pictures have GPS positions, these tell scale, up and north. Otherwise up is how the camera was held, and the
unit is the model's own, unless a scale is given; without one, the median depth of the points becomes 2 units.

OpenSfM's ``reconstruction.json`` has the layout of https://opensfm.org/docs/dataset.html. Pixels count from the
picture's middle, divided by its longer side. Poses are world to camera, rotations as axis times angle, camera axes are
OpenCV's. With a ``reference_lla`` that is not zero OpenSfM has aligned the model by GPS: then x is east, y north, z up,
and lengths are metres.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.files import numeric_order
from semantic_mapper.geometry import invert_pose, project, transform
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import PICTURES, BadFrameError, DepthScale, ImportOptions, camera_of
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.replay.sfm.colmap import ColmapImage, ColmapModel, find_models, read_model
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, GpsPosition, place_by_gps, read_position
from semantic_mapper.replay.sfm.scale import UNSCALED_DEPTH_M, scene_depth, upright
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float64

FILE = "reconstruction.json"  # of OpenSfM
PINHOLE = ("perspective", "simple_radial", "radial", "brown")  # of its lenses that OpenCV's pinhole model has
FISHEYE = ("fisheye", "fisheye_opencv")  # and its fisheye model
_LOOKED_AT, _POINTS = 20, 5000  # cameras and points whose depth is looked at


def open_colmap(folder: Path, options: ImportOptions) -> PosedPictures:
    """A folder with a COLMAP model, opened.

    Raises ImportSourceError: no model, one that cannot be read, or no folder of pictures.
    """
    notices: list[str] = []
    place, model = _largest(folder, notices)
    roots = (folder / "images", *(parent / "images" for parent in place.parents[:3]), folder)
    root = _root(folder, roots, [image.name for image in model.images])
    notices += tables.left_out_notice("image", model.left_out)

    def picture_of(image: ColmapImage) -> PosedPicture:
        return PosedPicture(tables.inside(root, image.name), model.cameras[image.camera_id], image.T_world_camera)

    pictures = tables.keep_good(picture_of, model.images, "image", notices)
    return _opened("colmap", folder, pictures, model.xyz, options, notices)


def _largest(folder: Path, notices: list[str]) -> tuple[Path, ColmapModel]:
    """The model of most images; the others are named."""
    places = find_models(folder)
    if not places:
        raise ImportSourceError(f"{folder}: no COLMAP model (cameras, images and points3D, .bin or .txt) in it")
    models = dict(tables.keep_good(lambda place: (place, read_model(place)), places, "model", notices))
    chosen = max(models, key=lambda place: len(models[place].images), default=places[0])
    if not models or not models[chosen].images:
        raise ImportSourceError("; ".join((f"{places[0]}: the model has no registered image", *notices)))
    if len(models) > 1:
        others = ", ".join(f"{p.name} of {len(m.images)}" for p, m in models.items() if p != chosen)
        notices.append(
            f"the largest of {len(models)} models is imported, {chosen.name} of {len(models[chosen].images)} pictures; "
            f"left out: {others}. To import another one, name its folder"
        )
    return chosen, models[chosen]


class _Camera(msgspec.Struct):
    """Of OpenSfM."""

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


class _Shot(msgspec.Struct):
    rotation: tuple[float, float, float]
    translation: tuple[float, float, float]
    camera: str
    capture_time: Any = None  # seconds; 0 = not known


class _Reference(msgspec.Struct):
    latitude: Annotated[float, msgspec.Meta(ge=-90, le=90)]
    longitude: Annotated[float, msgspec.Meta(ge=-180, le=180)]
    altitude: float


class _Point(msgspec.Struct):
    coordinates: tuple[float, float, float]


class _Reconstruction(msgspec.Struct):
    cameras: dict[str, dict[str, Any]] = {}  # each is read by itself, so that a bad one costs no other
    shots: dict[str, Any] = {}
    points: dict[str, _Point] = {}
    reference_lla: _Reference | None = None


def find_opensfm(folder: Path) -> Path | None:
    """The file of a reconstruction: here, or below ``opensfm``; None = none."""
    return next((f for f in (folder / FILE, folder / "opensfm" / FILE) if f.is_file()), None)


def open_opensfm(folder: Path, options: ImportOptions) -> PosedPictures:
    """The largest reconstruction of a folder, opened.

    Raises ImportSourceError: none, one that cannot be read, no folder of pictures, or a lens that is no pinhole
    camera's.
    """
    file = find_opensfm(folder)
    if file is None:
        raise ImportSourceError(f"{folder}: no {FILE} in it, or below opensfm/")
    parts = [tables.convert_known(part, _Reconstruction, file) for part in tables.read_plain_json(file, list)]
    model = max(parts, key=lambda part: len(part.shots), default=_Reconstruction())
    if not model.shots:
        raise ImportSourceError(f"{file}: holds no posed picture")
    notices = tables.unknown_notice(file, model.cameras.values(), _Camera)
    if len(parts) > 1:
        others = ", ".join(str(len(part.shots)) for part in parts if part is not model)
        notices.append(
            f"the reconstruction fell into {len(parts)} parts; the largest is imported, those of {others} pictures are "
            "not"
        )
    names = sorted(model.shots, key=numeric_order)
    root = _root(folder, (file.parent / "images", folder / "images", file.parent.parent / "images"), names)

    def picture_of(name: str) -> PosedPicture:
        return _opensfm_picture(root, name, model, f"{file}, shot '{name}'")

    pictures = tables.keep_good(picture_of, names, "picture", notices)
    points = np.array([point.coordinates for point in model.points.values()], np.float64).reshape(-1, 3)
    origin = None
    if model.reference_lla is not None and (model.reference_lla.latitude or model.reference_lla.longitude):
        origin = GpsPosition(*msgspec.structs.astuple(model.reference_lla))
    if origin is not None and options.scale is not None:
        raise ImportSourceError(f"{file}: is in metres already, by GPS; leave out --scale")
    return _opened("opensfm", folder, pictures, points, options, notices, origin)


def _opensfm_picture(root: Path, name: str, model: _Reconstruction, where: str) -> PosedPicture:
    shot = tables.convert_known(model.shots[name], _Shot, where)
    if shot.camera not in model.cameras:
        raise ImportSourceError(f"{where}: its camera '{shot.camera}' is missing")
    camera = tables.convert_known(model.cameras[shot.camera], _Camera, f"{where}, camera '{shot.camera}'")
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = cv2.Rodrigues(np.array(shot.rotation))[0]
    T_camera_world[:3, 3] = shot.translation
    time = shot.capture_time
    stamp_ns = round(time * 1e9) if type(time) in (int, float) and 0 < time < MAX_STAMP_NS / 1e9 else None
    return PosedPicture(
        tables.inside(root, name), _opensfm_intrinsics(camera, where), invert_pose(T_camera_world), stamp_ns
    )


def _opensfm_intrinsics(camera: _Camera, where: str) -> CameraIntrinsics:
    fisheye = camera.projection_type in FISHEYE
    unread = (camera.p1 or camera.p2) if fisheye else (camera.projection_type not in PINHOLE or camera.k4)
    if unread:
        raise ImportSourceError(
            f"{where}: the lens model '{camera.projection_type}' is not read, but {', '.join((*PINHOLE, *FISHEYE))}, "
            "the first without k4, the last two without p1 and p2; run `opensfm undistort` and import the folder "
            "undistorted"
        )
    fx = camera.focal if camera.focal_x is None else camera.focal_x
    fy = fx if camera.focal_y is None else camera.focal_y
    if fx is None or fy is None:
        raise ImportSourceError(f"{where}: has no focal length: focal, or focal_x and focal_y")
    size = max(camera.width, camera.height)
    cx, cy = camera.c_x * size + camera.width / 2 - 0.5, camera.c_y * size + camera.height / 2 - 0.5
    lens = (camera.k1, camera.k2, camera.p1, camera.p2, camera.k3)
    if fisheye:
        lens = (camera.k1, camera.k2, camera.k3, camera.k4)
    return camera_of(
        where, (fx * size, fy * size, cx, cy), (camera.width, camera.height), "fisheye" if fisheye else "opencv", lens
    )


def _root(folder: Path, roots: tuple[Path, ...], names: list[str]) -> Path:
    """The folder that most of a model's pictures are in."""
    found = {root: sum(_is_picture(root, name) for name in names) for root in roots}
    root = max(roots, key=lambda root: found[root])
    if not found[root]:
        tables.inside(root, names[0])  # tells of a name that leads out of it
        raise ImportSourceError(f"{folder}: the pictures are missing; '{names[0]}' is not in {root}")
    return root


def _is_picture(root: Path, name: str) -> bool:
    try:
        return tables.inside(root, name).is_file()
    except (ImportSourceError, OSError):  # its name leads out of the folder, or cannot be one
        return False


def _opened(
    source: str,
    folder: Path,
    pictures: list[PosedPicture],
    points: Float64,
    options: ImportOptions,
    notices: list[str],
    origin: GpsPosition | None = None,
) -> PosedPictures:
    """Pictures posed in a model's world and unit, in the world of a log."""
    if not pictures:
        raise ImportSourceError("; ".join((f"{folder}: holds no posed picture", *notices)))
    names = {picture.file for picture in pictures}
    there = (file for place in {file.parent for file in names} for file in place.iterdir())
    unposed = sorted(str(file) for file in there if file.suffix.lower() in PICTURES and file not in names)
    notices += tables.left_out_notice("picture", unposed, "without a pose in this model")
    poses = np.stack([picture.pose for picture in pictures if not isinstance(picture.pose, BadFrameError)])
    scale_from, scale, depth = "GPS, by OpenSfM", 1.0, _median_depth(points, pictures, poses)
    fit = None
    if origin is None and options.scale is None:
        try:
            fit = place_by_gps(poses, [read_position(picture.file) for picture in pictures])
        except ImportSourceError as error:
            notices.append(f"GPS is not used: {error}")
    if origin is not None:
        notices.append("scale, up and north are those that OpenSfM found by GPS")
    elif fit is not None:
        notices.append(f"scale, up and north: {fit}")
        scale_from, origin, scale, poses = (
            str(fit),
            fit.origin,
            fit.scale,
            np.stack([fit.moved(pose) for pose in poses]),
        )
    else:
        scale_from, poses = SCALE_UNKNOWN, upright(poses[0], camera_up(poses)) @ poses
        if options.scale is None:
            poses[:, :3, 3] *= UNSCALED_DEPTH_M / depth if depth > 0 else 1.0
    opened = PosedPictures(
        f"{source} {folder.resolve().name}",
        [replace(picture, pose=pose) for picture, pose in zip(pictures, poses, strict=True)],
        options,
        DepthScale(1000.0, convention=f"a model of {source} has no depth images"),
        notices,
        scale_from=scale_from,
    )
    metadata = {} if origin is None else {ORIGIN_KEY: str(origin)}
    if opened.info.scale_known:
        metadata |= scene_depth((options.scale or scale) * depth)
    opened.info = msgspec.structs.replace(opened.info, metadata={**opened.info.metadata, **metadata})
    return opened


def _median_depth(points: Float64, pictures: list[PosedPicture], poses: Float64) -> float:
    """Of the points before some of the cameras and within their pictures; 0 without any."""
    points = points[:: max(1, len(points) // _POINTS)]
    step = max(1, len(pictures) // _LOOKED_AT)
    depths: list[Float64] = []
    for picture, T_camera_model in zip(pictures[::step], invert_pose(poses[::step]), strict=True):
        k, p = picture.intrinsics, transform(T_camera_model, points)
        p = p[p[:, 2] > 0]
        u, v = project(p, k).T
        depths.append(p[(u > 0) & (u < k.width) & (v > 0) & (v < k.height), 2])
    found = np.concatenate(depths)
    return float(np.median(found)) if len(found) else 0.0
