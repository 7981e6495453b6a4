"""Calibrations that other programs write as YAML: ROS's camera_info (camera_calibration, ``ros2 topic echo``), the same
keys in OpenCV's FileStorage, and Kalibr's camera chain."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent

from semantic_mapper.config import MAX_FILE_BYTES, check_values
from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.files import read_regular
from semantic_mapper.types import CameraIntrinsics

WANTED = (
    "a calibration has fx fy cx cy width height and distortion (TOML); of YAML, ROS's camera_info (image_width, "
    "image_height, camera_matrix, distortion_model, distortion_coefficients) and Kalibr's (cam0: camera_model, "
    "intrinsics, distortion_model, distortion_coeffs, resolution) are read"
)

_Side = Annotated[int, msgspec.Meta(ge=1, le=1 << 14)]
_Nine = Annotated[list[float], msgspec.Meta(min_length=9, max_length=9)]


class _Nines(msgspec.Struct):
    data: _Nine


class _Numbers(msgspec.Struct):
    data: list[float]


class _CameraInfo(msgspec.Struct):
    """As ``camera_calibration`` and ``camera_info_manager`` write it."""

    image_width: _Side
    image_height: _Side
    camera_matrix: _Nines
    distortion_coefficients: _Numbers
    distortion_model: str = ""


class _CameraInfoMessage(msgspec.Struct):
    """As the message is printed."""

    width: _Side
    height: _Side
    k: _Nine
    d: list[float]
    distortion_model: str = ""
    binning_x: int = 0
    binning_y: int = 0
    roi: dict[str, Any] = {}


class _KalibrCamera(msgspec.Struct):
    camera_model: str
    intrinsics: list[float]
    distortion_model: str
    distortion_coeffs: list[float]
    resolution: tuple[_Side, _Side]


def read_calibration_yaml(path: Path) -> CameraIntrinsics:
    """Read ROS's or Kalibr's calibration.

    Raises:
        ConfigError: missing, no YAML, of another form, several cameras, or a lens that is not undone.
    """
    plain = _read_yaml(path)
    try:
        if "camera_matrix" in plain:
            info = msgspec.convert(plain, _CameraInfo)
            K, lens = info.camera_matrix.data, info.distortion_coefficients.data
            return _from_matrix(K, info.distortion_model, lens, (info.image_width, info.image_height))
        lowered = {key.lower(): value for key, value in plain.items()}  # ROS 1 writes K and D
        if "k" in lowered:
            message = msgspec.convert(lowered, _CameraInfoMessage)
            if message.binning_x > 1 or message.binning_y > 1 or any(message.roi.values()):
                raise ConfigError("tells of binning or a region of interest, which is not read: calibrate it whole")
            return _from_matrix(message.k, message.distortion_model, message.d, (message.width, message.height))
        return _kalibr(plain)
    except (msgspec.ValidationError, ConfigError, FrameError) as error:
        raise ConfigError(f"{path}: {error}; {WANTED}") from error


def _from_matrix(K: list[float], model: str, lens: list[float], size: tuple[int, int]) -> CameraIntrinsics:
    if any(K[i] for i in (1, 3, 6, 7)):
        raise ConfigError("the camera matrix has skew, which is not undone; calibrate without it")
    return lens_intrinsics(model, lens, (K[0], K[4], K[2], K[5]), size)


def _kalibr(plain: Mapping[str, Any]) -> CameraIntrinsics:
    cameras = sorted(name for name, value in plain.items() if isinstance(value, Mapping) and "intrinsics" in value)
    if len(cameras) > 1:
        raise ConfigError(f"holds the cameras {', '.join(cameras)}; keep the one that is meant in a file of its own")
    camera = msgspec.convert(plain[cameras[0]] if cameras else plain, _KalibrCamera)
    if camera.camera_model != "pinhole":
        raise ConfigError(
            f"camera_model '{camera.camera_model}' is not read, only pinhole: calibrate with pinhole-equi"
        )
    if len(camera.intrinsics) != 4:
        raise ConfigError(f"intrinsics has {len(camera.intrinsics)} numbers, not fx fy cx cy")
    fx, fy, cx, cy = camera.intrinsics
    return lens_intrinsics(camera.distortion_model, camera.distortion_coeffs, (fx, fy, cx, cy), camera.resolution)


def _read_yaml(path: Path) -> dict[str, Any]:
    yaml = YAML(typ="safe", pure=True)
    try:
        text = read_regular(path, MAX_FILE_BYTES).decode("utf-8-sig")
        text, of_opencv = re.subn(r"\A%YAML:1\.0\s*|!!opencv-matrix", "", text)  # as OpenCV's FileStorage writes it
        if any(isinstance(event, AliasEvent) for event in yaml.parse(text)):  # of these, a short file makes a long one
            raise ConfigError("has aliases (*), which no calibration needs")
        documents: list[Any] = [document for document in yaml.load_all(text) if document is not None]
        if any(document != documents[0] for document in documents):  # `ros2 topic echo` prints many, which are one
            raise ConfigError("holds several calibrations; keep the one that is meant")
        plain = documents[0] if documents else None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (YAMLError, ValueError, RecursionError) as error:  # ValueError: ConfigError, UTF-8, endless numbers
        reason = " ".join(str(error).split())[:300]
        raise ConfigError(f"{path}: not valid YAML: {reason}; {WANTED}") from error
    if not isinstance(plain, dict):
        raise ConfigError(f"{path}: holds no calibration; {WANTED}")
    check_values(plain, str(path))
    values = {str(key): value for key, value in cast("dict[Any, Any]", plain).items()}
    return {"distortion_model": "opencv", **values} if of_opencv else values
