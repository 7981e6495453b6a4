"""Calibration files, and the one place where lens distortion is taken out of an image.

A file is TOML or JSON: ``fx fy cx cy width height`` in pixels and ``distortion``, OpenCV's coefficients
(k1 k2 p1 p2 k3 ...); with ``fisheye = true`` those of its fisheye model (k1 k2 k3 k4). Of a camera on a rig it also has
``T_rig_camera``, where the camera sits, row by row. YAML is that of ROS (camera_info) or Kalibr.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import AtLeastOne, Config, Positive, convert_config, read_json, read_toml
from semantic_mapper.drivers.calibration_yaml import read_calibration_yaml
from semantic_mapper.drivers.lens import lens_intrinsics, rectify_maps
from semantic_mapper.errors import CameraError, ConfigError, FrameError, PoseError
from semantic_mapper.files import write_bytes
from semantic_mapper.geometry import check_pose
from semantic_mapper.types import COEFFICIENTS, CameraIntrinsics, FisheyeIntrinsics, Float32, Float64, UInt8

PlaneT = TypeVar("PlaneT", Float32, UInt8)
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]  # a pose, row by row
_YAML = (".yaml", ".yml")
GUESSED_VIEW_DEG = 60.0  # horizontal, of a camera that nobody has calibrated


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


def load_calibration(path: Path) -> CameraIntrinsics:
    """Read a calibration file: TOML, with the suffix ``.json`` JSON, with ``.yaml`` ROS's camera_info or Kalibr's.

    Raises:
        ConfigError: missing, of another form, or with impossible values.
    """
    k = read_calibration_yaml(path) if path.suffix.lower() in _YAML else _intrinsics(_load_file(path), path)
    if not (0 < k.cx < k.width and 0 < k.cy < k.height):
        raise ConfigError(
            f"{path}: the principal point ({k.cx:g}, {k.cy:g}) is outside of the {k.width}x{k.height} image"
        )
    return k


def load_mount(path: Path) -> Float64 | None:
    """T_rig_camera (4, 4) of a calibration file; None where it has none.

    Raises:
        ConfigError: see ``load_calibration``, or the matrix is no rigid transform.
    """
    rows = None if path.suffix.lower() in _YAML else _load_file(path).T_rig_camera
    return None if rows is None else rigid_matrix(rows, f"{path}: T_rig_camera")


def rigid_matrix(rows: Matrix, where: str) -> Float64:
    """Rows -> (4, 4).

    Raises:
        ConfigError: no rigid transform.
    """
    T = np.array(rows, np.float64)
    try:
        check_pose(T, where)
    except PoseError as error:
        raise ConfigError(str(error)) from error
    return T


def save_calibration(
    path: Path, measured: CameraIntrinsics, T_rig_camera: Float64 | None, about: Mapping[str, str | float]
) -> None:
    """Write a calibration file, TOML, that reads back to the same numbers.

    Args:
        path: Replaced if it is there.
        measured: With distortion.
        T_rig_camera: (4, 4) where the camera is on a rig.
        about: When, how, how well: for people.

    Raises:
        OSError: it cannot be written.
    """
    lines = [f"{name} = {getattr(measured, name)!r}" for name in ("fx", "fy", "cx", "cy", "width", "height")]
    lines.append(f"distortion = {list(measured.distortion)!r}")
    if isinstance(measured, FisheyeIntrinsics):
        lines.append("fisheye = true")
    if T_rig_camera is not None:
        lines += ["T_rig_camera = [", *(f"    {row!r}," for row in T_rig_camera.tolist()), "]"]
    lines += ["", "[about]", *(f"{name} = {_toml_value(value)}" for name, value in about.items())]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def require_calibration(path: str, uncalibrated: bool, camera: str) -> CameraIntrinsics | None:
    """The calibration that a driver was given; None where the user wants images for calibrating.

    Args:
        path: Of the file; empty = none.
        uncalibrated: Whether the user has asked for images without one.
        camera: For the message.

    Raises:
        CameraError: neither, or both; says the ways out.
        ConfigError: see ``load_calibration``.
    """
    if path and uncalibrated:
        raise CameraError(f"{camera}: has a calibration and is to be used uncalibrated; leave one of the two out")
    if path:
        return load_calibration(Path(path))
    if uncalibrated:
        return None
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
    """Makes the RGB image of an ideal pinhole camera of what a lens gives.

    The image keeps its size; its edges are cut so far that no pixel is made up.

    Args:
        measured: Of the camera with its lens.

    Raises:
        ConfigError: the distortion leaves no image that a pinhole camera could have made.
    """

    def __init__(self, measured: CameraIntrinsics) -> None:
        self.intrinsics = measured
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self._exact: tuple[np.ndarray, np.ndarray] | None = None
        if measured.distorted:
            self.intrinsics, *exact = rectify_maps(measured)
            self._exact = (exact[0], exact[1])
            self._maps = cv2.convertMaps(*self._exact, cv2.CV_16SC2)

    def nearest(self, image: PlaneT) -> PlaneT:
        """Depth or classes (H, W) in the pixels of the lens -> of the rectified image, each from the nearest pixel."""
        if self._exact is None:
            return image
        # The maps of integers, which are quicker, round down here.
        return cast("PlaneT", cv2.remap(image, *self._exact, cv2.INTER_NEAREST))

    def __call__(self, bgr: UInt8) -> UInt8:
        """(H, W, 3) BGR as OpenCV captures it -> rectified RGB of the same size."""
        if self._maps is not None:
            bgr = np.asarray(cv2.remap(bgr, *self._maps, cv2.INTER_LINEAR), np.uint8)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def _toml_value(value: str | float) -> str:
    return json.dumps(value) if isinstance(value, str) else repr(value)  # a JSON string is a TOML one


def _intrinsics(file: CalibrationFile, path: Path) -> CameraIntrinsics:
    try:
        if not file.fisheye and len(file.distortion) in COEFFICIENTS:
            return CameraIntrinsics(file.fx, file.fy, file.cx, file.cy, file.width, file.height, file.distortion)
        model = "fisheye" if file.fisheye else "opencv"
        k = (file.fx, file.fy, file.cx, file.cy)
        return lens_intrinsics(model, file.distortion, k, (file.width, file.height))
    except (ConfigError, FrameError) as error:
        raise ConfigError(f"{path}: {error}") from error


def _load_file(path: Path) -> CalibrationFile:
    plain = read_json(path, dict) if path.suffix.lower() == ".json" else read_toml(path)
    return convert_config(plain, CalibrationFile, str(path))
