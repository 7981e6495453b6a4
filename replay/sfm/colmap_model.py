"""COLMAP's models, text and binary: cameras, images with their poses, and points.

The layout is that of https://colmap.github.io/format.html ("Output Format"). COLMAP's pixels begin at the corner of the
image (the first pixel's centre is at 0.5); here centres are integers, so 0.5 is taken off. Its poses are world to
camera, and its camera axes are OpenCV's.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.files import decode_text, numeric_order, read_regular
from semantic_mapper.geometry import invert_pose, pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.types import CameraIntrinsics, Float64, Int64

MAX_BYTES = 1 << 31  # of one file of a model
# Camera models by their number: name, and how many parameters. What is not here has no pinhole image.
MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
    18: ("SKEWED_PINHOLE", 5),
    19: ("BROWN_CONRADY", 8),
}
_NAMES = ("cameras", "images", "points3D")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """One registered image.

    Args:
        name: As the model has it, a path below the folder of images.
        camera_id: Of its camera.
        T_world_camera: (4, 4).
        xy: (N, 2) its features in pixels.
        point_ids: (N,) of their points; -1 = none.
    """

    name: str
    camera_id: int
    T_world_camera: Float64
    xy: Float64
    point_ids: Int64


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """A model.

    Args:
        cameras: By their ids; with distortion as OpenCV has it.
        images: In the order of their names, by the numbers in these.
        points: (3,) of each point by its id.
        errors_px: Mean reprojection error of each point, by its id.
        left_out: Images that are left out, and why.
        damaged: What is missing of cameras, features and points, and why.
    """

    cameras: dict[int, CameraIntrinsics]
    images: tuple[ColmapImage, ...]
    points: dict[int, Float64]
    errors_px: dict[int, float]
    left_out: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()


def find_models(folder: Path) -> list[Path]:
    """Folders of models: this one, or else those in ``sparse`` or ``colmap/sparse`` below it, by their numbers."""
    for place in (folder, folder / "sparse", folder / "colmap" / "sparse"):
        below = sorted(place.iterdir(), key=lambda path: numeric_order(path.name)) if place.is_dir() else []
        found = (
            [path for path in (place, *below) if _is_model(path)] if place != folder else [folder] * _is_model(folder)
        )
        if found:
            return found
    return []


def _is_model(place: Path) -> bool:
    return any(all((place / f"{name}.{kind}").is_file() for name in _NAMES[:2]) for kind in ("bin", "txt"))


def read_model(folder: Path) -> ColmapModel:
    """Read the model in a folder; binary files come before text.

    Raises:
        ImportSourceError: a file is missing, images.bin is cut off, or no image has a pose and a camera with a lens of
            OpenCV's models.
    """
    binary = all((folder / f"{name}.bin").exists() for name in _NAMES[:2])
    kind = "bin" if binary else "txt"
    files = [folder / f"{name}.{kind}" for name in _NAMES]
    for file in files[:2]:
        if not file.exists():
            raise ImportSourceError(f"{file}: missing; a model has cameras, images and points3D, .bin or .txt")
    cameras: dict[int, CameraIntrinsics] = {}
    broken: dict[int, str] = {}
    damaged: list[str] = []
    for camera in _cameras_bin(files[0], damaged) if binary else _cameras_txt(files[0], damaged):
        try:
            cameras[camera.number] = intrinsics_of(
                camera.model, camera.width, camera.height, camera.params, camera.where
            )
        except ImportSourceError as error:
            broken[camera.number] = str(error)
    images: list[ColmapImage] = []
    left_out: list[str] = []
    for row in _images_bin(files[1]) if binary else _images_txt(files[1], left_out, damaged):
        try:
            if row.camera_id not in cameras:
                missing = f"{files[1]}: image '{row.name}' has camera {row.camera_id}, which is missing"
                raise ImportSourceError(broken.get(row.camera_id, missing))
            images.append(_image(row, files[1]))
        except ImportSourceError as error:
            left_out.append(str(error))
    if left_out and not images:
        raise ImportSourceError([*damaged, *left_out][0])
    images.sort(key=lambda image: numeric_order(image.name))
    points, errors = {}, {}
    not_finite = 0
    try:
        rows = () if not files[2].exists() else _points_bin(files[2]) if binary else _points_txt(files[2])
        for number, xyz, error in rows:
            if np.isfinite(xyz).all():
                points[number], errors[number] = xyz, error
            else:
                not_finite += 1
    except ImportSourceError as error:  # poses need no points
        damaged.append(f"points, but for the first {len(points)}, left out: {error}")
    if not_finite:
        damaged.append(f"{files[2]}: {counted(not_finite, 'point')} without a finite position left out")
    return ColmapModel(cameras, tuple(images), points, errors, tuple(left_out), tuple(damaged))


def intrinsics_of(model: str, width: int, height: int, params: list[float], where: str) -> CameraIntrinsics:
    """A camera of COLMAP's as OpenCV's model.

    Raises:
        ImportSourceError: a lens that neither OpenCV's pinhole nor its fisheye model has, or impossible values.
    """
    advice = (
        f"{where}: the lens model '{model}' is not read; undistort the images (`colmap image_undistorter`) and "
        "import the model that comes out"
    )
    wanted = dict(MODELS.values()).get(model)
    if wanted is None or wanted != len(params) or model == "EQUIRECTANGULAR":
        raise ImportSourceError(f"{advice} ({len(params)} parameters)")
    one_focal = model.startswith(("SIMPLE", "RADIAL", "BROWN"))
    fx, fy, cx, cy, *lens = (params[0], *params) if one_focal else params
    if model in ("FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM", "SKEWED_PINHOLE") and not lens[0]:
        model, lens = "PINHOLE", []
    if model == "BROWN_CONRADY":  # k1 k2 k3 p1 p2
        model, lens = "OPENCV", [*lens[:2], *lens[3:], lens[2]]
    if model == "THIN_PRISM_FISHEYE":  # k1 k2 p1 p2 k3 k4 sx1 sy1
        k1, k2, p1, p2, k3, k4, *prism = lens
        if not any((p1, p2, *prism)):
            model, lens = "OPENCV_FISHEYE", [k1, k2, k3, k4]
    fisheye = model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")
    if not fisheye and model not in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"):
        raise ImportSourceError(advice)
    try:
        return lens_intrinsics("fisheye" if fisheye else "opencv", lens, (fx, fy, cx - 0.5, cy - 0.5), (width, height))
    except (ConfigError, FrameError) as error:
        raise ImportSourceError(f"{where}: {error}") from error


class _Bytes:
    """Numbers of a binary file, in order."""

    def __init__(self, file: Path) -> None:
        self._data, self._at, self.file = _read(file), 0, file

    def numbers(self, form: str) -> tuple[float, ...]:
        """Numbers as ``struct`` has them, little endian.

        Raises:
            ImportSourceError: the file ends before.
        """
        size = struct.calcsize("<" + form)
        if self._at + size > len(self._data):
            raise self._cut()
        self._at += size
        return struct.unpack_from("<" + form, self._data, self._at - size)

    def count(self) -> int:
        """A number of things that follow."""
        return int(self.numbers("Q")[0])

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        """Records."""
        size = dtype.itemsize * count
        if count < 0 or self._at + size > len(self._data):
            raise self._cut()
        self._at += size
        return np.frombuffer(self._data, dtype, count, self._at - size)

    def text(self) -> str:
        """Up to a zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise self._cut()
        found, self._at = self._data[self._at : end], end + 1
        return found.decode("utf-8", "replace")

    def _cut(self) -> ImportSourceError:
        return ImportSourceError(f"{self.file}: is cut off, or no file of a COLMAP model; export the model again")


_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("feature", "<i4")])


@dataclass(frozen=True, slots=True)
class _CameraRow:
    number: int
    model: str
    width: int
    height: int
    params: list[float]
    where: str


@dataclass(frozen=True, slots=True, eq=False)
class _ImageRow:
    name: str
    camera_id: int
    pose: list[float]  # QW QX QY QZ TX TY TZ
    xy: Float64
    point_ids: Int64


def _cameras_bin(file: Path, damaged: list[str]) -> Iterator[_CameraRow]:
    """Up to the first camera of a model that is not known: how long it is, is not known, either."""
    data = _Bytes(file)
    for _ in range(data.count()):
        number, model, width, height = (int(n) for n in data.numbers("iiQQ"))
        if model not in MODELS:
            damaged.append(
                f"{file}: camera {number} has model {model}, which is not known; it and the cameras behind it are left "
                "out. Undistort the images (`colmap image_undistorter`) and import the model that comes out"
            )
            return
        name, count = MODELS[model]
        params = list(data.numbers(f"{count}d"))
        yield _CameraRow(number, name, width, height, params, f"{file}, camera {number}")


def _images_bin(file: Path) -> Iterator[_ImageRow]:
    data = _Bytes(file)
    for _ in range(data.count()):
        _, *pose, camera = data.numbers("i7di")
        name = data.text()
        rows = data.array(_FEATURE, data.count())
        xy = np.stack((rows["x"], rows["y"]), axis=1) - 0.5
        yield _ImageRow(name, int(camera), pose, xy, rows["point"].astype(np.int64))


def _points_bin(file: Path) -> Iterator[tuple[int, Float64, float]]:
    data = _Bytes(file)
    for _ in range(data.count()):
        number, x, y, z, _, _, _, error = data.numbers("Qddd3Bd")
        data.array(_TRACK, data.count())
        yield int(number), np.array((x, y, z)), float(error)


def _cameras_txt(file: Path, damaged: list[str]) -> Iterator[_CameraRow]:
    for line, words in _lines(file):
        try:
            number, width, height, *params = _numbers([words[0], *words[2:]])
            row = _CameraRow(int(number), words[1].strip(",;"), int(width), int(height), params, f"{file}, line {line}")
        except (ValueError, IndexError, OverflowError) as error:
            damaged.append(str(_bad_line(file, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", error)))
            continue
        yield row


def _images_txt(file: Path, left_out: list[str], damaged: list[str]) -> Iterator[_ImageRow]:
    """Two lines an image; the second one, its features, may be empty. Sentences on poses that cannot be read go into
    ``left_out``, on features into ``damaged``."""
    rows = iter(_lines(file, empty=True))
    for line, words in rows:
        if not words:
            continue
        try:
            *pose, camera = _numbers(words[1:9])
            camera, name = int(camera), " ".join(words[9:])
            if len(pose) != 7 or not name:
                raise ValueError("too few values")
        except (ValueError, OverflowError) as error:
            form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            left_out.append(str(_bad_line(file, line, form, error)))
            next(rows, None)  # its features
            continue
        line, words = next(rows, (line + 1, []))
        try:
            features = np.array(_numbers(words)).reshape(-1, 3)
            if not np.isfinite(features).all():
                raise ValueError("not finite")
        except ValueError as error:  # its pose is good
            bad = _bad_line(file, line, "X Y POINT3D_ID ...", error)
            damaged.append(f"{bad}; image '{name}' is without its features")
            features = np.empty((0, 3))
        points = features[:, 2].astype(np.int64)
        yield _ImageRow(name, camera, pose, features[:, :2] - 0.5, points)


def _points_txt(file: Path) -> Iterator[tuple[int, Float64, float]]:
    for line, words in _lines(file):
        try:
            yield int(words[0].strip(",;")), np.array(_numbers(words[1:4])).reshape(3), _numbers(words[7:8])[0]
        except (ValueError, IndexError) as error:
            raise _bad_line(file, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]", error) from error


def _image(row: _ImageRow, file: Path) -> ColmapImage:
    w, x, y, z, *t = row.pose
    if not np.isfinite(row.pose).all() or not abs(np.linalg.norm((w, x, y, z)) - 1) < 0.1:
        raise ImportSourceError(
            f"{file}, image '{row.name}': its pose is no unit quaternion QW QX QY QZ and position TX TY TZ"
        )
    T_camera_world = pose_matrix(np.array(t), np.array((x, y, z, w)))
    return ColmapImage(row.name, row.camera_id, invert_pose(T_camera_world), row.xy, row.point_ids)


def _lines(file: Path, *, empty: bool = False) -> Iterator[tuple[int, list[str]]]:
    data = _read(file)
    try:
        text = decode_text(data)
    except UnicodeDecodeError:  # names of pictures in another character set
        text = data.decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#") and (empty or line.strip()):
            yield number, line.split()


def _read(file: Path) -> bytes:
    try:
        return read_regular(file, MAX_BYTES)
    except OSError as error:
        raise ImportSourceError(f"{file}: cannot be read ({error.strerror or error})") from error
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error


def _numbers(words: list[str]) -> list[float]:
    """Numbers with a point or a decimal comma, between spaces, also with a comma or a semicolon behind each."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return [float(word.strip(",;").replace(",", ".")) for word in words]


def _bad_line(file: Path, line: int, form: str, error: Exception) -> ImportSourceError:
    return ImportSourceError(f"{file}, line {line}: expected {form} ({error})")
