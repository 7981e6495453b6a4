"""Calibration files, and the one place where lens distortion is taken out of an image.

A file is TOML or JSON: ``fx fy cx cy width height`` in pixels and ``distortion``, OpenCV's coefficients
(k1 k2 p1 p2 k3 ...); with ``fisheye = true`` those of its fisheye model (k1 k2 k3 k4). Of a camera on a rig it also has
``T_rig_camera``, where the camera sits, row by row. YAML is that of ROS (camera_info) or Kalibr.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import cv2
import msgspec
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

from semantic_mapper.config import (
    MAX_FILE_BYTES,
    AtLeastOne,
    Config,
    Positive,
    check_values,
    convert_config,
    read_json,
    read_toml,
)
from semantic_mapper.drivers.lens import clear_view, lens_intrinsics
from semantic_mapper.errors import CameraError, ConfigError, FrameError, PoseError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.geometry import camera_matrix, check_pose, invert_pose
from semantic_mapper.types import COEFFICIENTS, CameraIntrinsics, FisheyeIntrinsics, Float32, Float64, UInt8

PlaneT = TypeVar("PlaneT", Float32, UInt8)
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]  # a pose, row by row
_YAML = (".yaml", ".yml")
SIDES = ("left", "right")  # of a stereo pair, by the half of the images that its device gives
GUESSED_VIEW_DEG = 60.0  # horizontal, of a camera that nobody has calibrated
_WANTED = (
    "a calibration has fx fy cx cy width height and distortion (TOML); of YAML, ROS's camera_info (image_width, "
    "image_height, camera_matrix, distortion_model, distortion_coefficients) and Kalibr's (cam0: camera_model, "
    "intrinsics, distortion_model, distortion_coeffs, resolution) are read"
)


class CalibrationFile(Config, frozen=True):
    """A calibration as it stands on disk."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: AtLeastOne
    height: AtLeastOne
    distortion: tuple[float, ...] = ()
    fisheye: bool = False  # the lens is OpenCV's fisheye model, also called equidistant
    T_rig_camera: Matrix | None = None  # of a camera on a rig
    about: dict[str, Any] = msgspec.field(default_factory=dict)  # when, how, how well: for people


@dataclass(frozen=True, slots=True, eq=False)
class StereoCalibration:
    """A calibrated pair."""

    # left, right: With distortion, both of one size.
    left: CameraIntrinsics
    right: CameraIntrinsics
    T_right_left: Float64  # (4, 4) from the left camera to the right one, metres
    swapped: bool = False  # the right camera's image is in the left half of what the device gives


def load_calibration(path: Path) -> CameraIntrinsics:
    """Read a calibration file: TOML, with the suffix ``.json`` JSON, with ``.yaml`` ROS's camera_info or Kalibr's.

    Raises ConfigError: missing, of another form, or with impossible values.
    """
    file = None if path.suffix.lower() in _YAML else _load_file(path)
    try:
        k = _load_yaml(path) if file is None else _intrinsics(file, "fisheye" if file.fisheye else "opencv")
        if not (0 < k.cx < k.width and 0 < k.cy < k.height):
            raise ConfigError(f"the principal point ({k.cx:g}, {k.cy:g}) is outside of the {k.width}x{k.height} image")
        return k
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (FrameError, YAMLError, ValueError, RecursionError) as error:  # ValueError: ConfigError, UTF-8, msgspec
        reason = " ".join(str(error).split())[:300]
        raise ConfigError(f"{path}: {reason}" + (f"; {_WANTED}" if file is None else "")) from error


def load_mount(path: Path) -> Float64 | None:
    """T_rig_camera (4, 4) of a calibration file; None where it has none. ``ConfigError`` as of ``load_calibration``."""
    rows = None if path.suffix.lower() in _YAML else _load_file(path).T_rig_camera
    return None if rows is None else rigid_matrix(rows, f"{path}: T_rig_camera")


def rigid_matrix(rows: Matrix, where: str) -> Float64:
    """Rows -> (4, 4); ``ConfigError`` where they are no rigid transform."""
    T = np.array(rows, np.float64)
    try:
        check_pose(T, where)
    except PoseError as error:
        raise ConfigError(str(error)) from error
    return T


def save_calibration(
    path: Path, measured: CameraIntrinsics, T_rig_camera: Float64 | None, about: Mapping[str, str | float]
) -> None:
    """Write a calibration file, TOML, that reads back to the same numbers; ``ConfigError`` where it cannot be written.

    ``T_rig_camera`` (4, 4) where the camera is on a rig; ``about``: when, how, how well, for people.
    """
    names = ("fx", "fy", "cx", "cy", "width", "height")
    lens: dict[str, Any] = {name: getattr(measured, name) for name in names}
    lens["distortion"] = list(measured.distortion)
    if isinstance(measured, FisheyeIntrinsics):
        lens["fisheye"] = True
    if T_rig_camera is not None:
        lens["T_rig_camera"] = T_rig_camera.tolist()
    whole, described = ([f"{key} = {json.dumps(value)}" for key, value in part.items()] for part in (lens, about))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, "\n".join([*whole, "", "[about]", *described, ""]).encode(), raises=ConfigError)


def load_stereo(folder: Path) -> StereoCalibration:
    """Read the folder of a stereo pair: a file for each of its ``SIDES``. Where they sit tells whose half is which.

    Raises ConfigError: a file is missing or wrong, does not say where its camera sits or has a fisheye lens, or the two
    are of different sizes.
    """
    files = [folder / f"{side}.toml" for side in SIDES]
    try:
        (left, T_rig_left), (right, T_rig_right) = ((load_calibration(file), load_mount(file)) for file in files)
    except ConfigError as error:
        raise ConfigError(f"{error}; `semantic-mapper calibrate --stereo` makes the folder of a pair") from error
    if T_rig_left is None or T_rig_right is None:
        raise ConfigError(f"{folder}: T_rig_camera is missing; `semantic-mapper calibrate --stereo` finds it")
    if isinstance(left, FisheyeIntrinsics) or isinstance(right, FisheyeIntrinsics):
        raise ConfigError(f"{folder}: the cameras of a pair cannot have fisheye lenses")
    if (left.width, left.height) != (right.width, right.height):
        raise ConfigError(f"{folder}: the left and the right images have different sizes")
    T_right_left = invert_pose(T_rig_right) @ T_rig_left
    if T_right_left[0, 3] > 0:
        return StereoCalibration(right, left, invert_pose(T_right_left), swapped=True)
    return StereoCalibration(left, right, T_right_left)


def require_calibration(path: str, uncalibrated: bool, camera: str) -> CameraIntrinsics | None:
    """The calibration that a driver was given as a file; None where the user wants images for calibrating.

    Raises CameraError: neither, or both; says the ways out. ConfigError: see ``load_calibration``.
    """
    if path and uncalibrated:
        raise CameraError(f"{camera}: has a calibration and is to be used uncalibrated; leave one of the two out")
    if path or uncalibrated:
        return load_calibration(Path(path)) if path else None
    raise CameraError(
        f"{camera}: has no calibration, and without its focal length nothing can be mapped. Ways out: make a file with "
        "`semantic-mapper calibrate`; or write one from the data sheet (fx fy cx cy width height distortion); name "
        'it with calibration = "FILE". A camera with a calibration of its own (kind "oak") needs none'
    )


def guess_intrinsics(width: int, height: int) -> CameraIntrinsics:
    """What an average webcam has; good for showing images, not for mapping."""
    focal = width / 2 / math.tan(math.radians(GUESSED_VIEW_DEG / 2))
    return CameraIntrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


class Rectifier:
    """Makes the RGB image of an ideal pinhole camera of what a lens gives; ``ConfigError`` without one.

    The image keeps its size; its edges are cut so far that no pixel is made up.
    """

    def __init__(self, measured: CameraIntrinsics) -> None:
        self.intrinsics = measured
        self._exact: tuple[Float32, Float32] | None = None  # where its pixels lie in the image of the lens: x and y
        if not measured.distorted:
            return
        K, lens, size = camera_matrix(measured), np.array(measured.distortion), (measured.width, measured.height)
        fisheye = isinstance(measured, FisheyeIntrinsics)
        undistort_maps = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
        try:
            self.intrinsics = clear_view([(measured, np.eye(3))], *size)
        except FrameError as error:
            raise ConfigError(
                f"the lens distortion {lens.tolist()} leaves no usable image: {error}; calibrate the camera again"
            ) from error
        x, y = undistort_maps(K, lens, np.eye(3), camera_matrix(self.intrinsics), size, cv2.CV_32FC1)
        self._exact = np.asarray(x, np.float32), np.asarray(y, np.float32)
        self._maps = cv2.convertMaps(*self._exact, cv2.CV_16SC2)

    def nearest(self, image: PlaneT) -> PlaneT:
        """Depth or classes (H, W) in the pixels of the lens -> of the rectified image, each from the nearest pixel."""
        if self._exact is None:
            return image
        # The maps of integers, which are quicker, round down here.
        return cast("PlaneT", cv2.remap(image, *self._exact, cv2.INTER_NEAREST))

    def __call__(self, bgr: UInt8) -> UInt8:
        """(H, W, 3) BGR as OpenCV captures it -> rectified RGB of the same size."""
        if self._exact is not None:
            bgr = np.asarray(cv2.remap(bgr, *self._maps, cv2.INTER_LINEAR), np.uint8)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def _intrinsics(lens: CalibrationFile, model: str = "opencv") -> CameraIntrinsics:
    k, size = (lens.fx, lens.fy, lens.cx, lens.cy), (lens.width, lens.height)
    if model == "opencv" and len(lens.distortion) in COEFFICIENTS:
        return CameraIntrinsics(*k, *size, lens.distortion)
    return lens_intrinsics(model, lens.distortion, k, size)


def _load_file(path: Path) -> CalibrationFile:
    plain = read_json(path, dict) if path.suffix.lower() == ".json" else read_toml(path)
    return convert_config(plain, CalibrationFile, str(path))


# What other programs write as YAML: ROS's camera_info (camera_calibration, ``ros2 topic echo``), the same keys in
# OpenCV's FileStorage, and Kalibr's camera chain.

_Side = Annotated[int, msgspec.Meta(ge=1, le=1 << 14)]
_MESSAGE = {"width": "image_width", "height": "image_height", "k": "camera_matrix", "d": "distortion_coefficients"}


class _CameraInfo(msgspec.Struct):
    """ROS's file; in the message keys are shorter (``_MESSAGE``), in ROS 1 with capitals."""

    image_width: _Side
    image_height: _Side
    camera_matrix: Annotated[list[float], msgspec.Meta(min_length=9, max_length=9)]
    distortion_coefficients: list[float]
    distortion_model: str = ""
    binning_x: int = 0
    binning_y: int = 0
    roi: dict[str, Any] = {}


class _KalibrCamera(msgspec.Struct):
    camera_model: str
    intrinsics: Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
    distortion_model: str
    distortion_coeffs: list[float]
    resolution: tuple[_Side, _Side]


def _camera_info(plain: Mapping[str, Any]) -> CameraIntrinsics:
    flat = {
        key: value["data"] if isinstance(value, dict) and "data" in value else value for key, value in plain.items()
    }
    info = msgspec.convert(flat, _CameraInfo)
    if info.binning_x > 1 or info.binning_y > 1 or any(info.roi.values()):
        raise ConfigError("has binning or a region of interest, which is not read: calibrate it whole")
    K = info.camera_matrix
    if any(K[i] for i in (1, 3, 6, 7)):
        raise ConfigError("the camera matrix has skew, which is not undone; calibrate without it")
    size = (info.image_width, info.image_height)
    return lens_intrinsics(info.distortion_model, info.distortion_coefficients, (K[0], K[4], K[2], K[5]), size)


def _kalibr(plain: Mapping[str, Any]) -> CameraIntrinsics:
    cameras = sorted(name for name, value in plain.items() if isinstance(value, Mapping) and "intrinsics" in value)
    if len(cameras) > 1:
        raise ConfigError(f"holds the cameras {', '.join(cameras)}; keep the one that is meant in a file of its own")
    camera = msgspec.convert(plain[cameras[0]] if cameras else plain, _KalibrCamera)
    if camera.camera_model != "pinhole":
        raise ConfigError(f"camera_model '{camera.camera_model}' is not read: calibrate with pinhole-equi")
    fx, fy, cx, cy = camera.intrinsics
    return lens_intrinsics(camera.distortion_model, camera.distortion_coeffs, (fx, fy, cx, cy), camera.resolution)


def _load_yaml(path: Path) -> CameraIntrinsics:
    yaml = YAML(typ="safe", pure=True)
    text = read_regular(path, MAX_FILE_BYTES).decode("utf-8-sig")
    text, of_opencv = re.subn(r"\A%YAML:1\.0\s*|!!opencv-matrix", "", text)  # as OpenCV's FileStorage writes it
    if any(isinstance(event, AliasEvent) for event in yaml.parse(text)):  # of these, a short file makes a long one
        raise ConfigError("has aliases (*), which no calibration needs")
    documents: list[Any] = [document for document in yaml.load_all(text) if document is not None]
    if any(document != documents[0] for document in documents):  # `ros2 topic echo` prints many, which are one
        raise ConfigError("holds several calibrations; keep the one that is meant")
    if not documents or not isinstance(documents[0], dict):
        raise ConfigError("holds no calibration")
    values = {str(key): value for key, value in cast("dict[Any, Any]", documents[0]).items()}
    check_values(values, "its values")
    lowered = {_MESSAGE.get(key.lower(), key.lower()): value for key, value in values.items()}
    if "camera_matrix" not in lowered:
        return _kalibr(values)
    return _camera_info({"distortion_model": "opencv", **lowered} if of_opencv else lowered)
