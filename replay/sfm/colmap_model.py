"""COLMAP's models, text and binary: cameras, images with their poses, and points.

The layout is that of https://colmap.github.io/format.html ("Output Format"). COLMAP's pixels begin at the corner of the
image (the first pixel's centre is at 0.5); here centres are integers, so 0.5 is taken off. Its poses are world to
camera, and its camera axes are OpenCV's.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.files import numeric_order, read_regular
from semantic_mapper.geometry import invert_pose, pose_matrix
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
        left_out: Images whose camera cannot be used, and why.
    """

    cameras: dict[int, CameraIntrinsics]
    images: tuple[ColmapImage, ...]
    points: dict[int, Float64]
    errors_px: dict[int, float]
    left_out: tuple[str, ...] = ()


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
        ImportSourceError: a file is missing, cut off or of another form, or no image has a camera with a lens of
            OpenCV's models.
    """
    binary = all((folder / f"{name}.bin").exists() for name in _NAMES[:2])
    cameras_file, images_file, points_file = (folder / f"{name}.{'bin' if binary else 'txt'}" for name in _NAMES)
    lenses = _cameras_bin(cameras_file) if binary else _cameras_txt(cameras_file)
    rows = _images_bin(images_file) if binary else _images_txt(images_file)
    cameras: dict[int, CameraIntrinsics] = {}
    broken: dict[int, str] = {}
    for number, model, width, height, params in lenses:
        try:
            cameras[number] = intrinsics_of(model, width, height, params, f"{cameras_file}, camera {number}")
        except ImportSourceError as error:
            broken[number] = str(error)
    images: list[ColmapImage] = []
    left_out: list[str] = []
    for name, camera_id, (w, x, y, z, *t), features in rows:
        where = f"{images_file}, image '{name}'"
        if not abs(np.linalg.norm((w, x, y, z)) - 1) < 0.1 or not np.isfinite(t).all():
            raise ImportSourceError(f"{where}: its pose is no unit quaternion QW QX QY QZ and position TX TY TZ")
        if camera_id not in cameras:
            left_out.append(broken.get(camera_id, f"{where} has camera {camera_id}, which is missing"))
            continue
        T_camera_world = pose_matrix(np.array(t), np.array((x, y, z, w)))
        xy, points = features[:, :2] - 0.5, features[:, 2].astype(np.int64)
        images.append(ColmapImage(name, camera_id, invert_pose(T_camera_world), xy, points))
    if left_out and not images:
        raise ImportSourceError(left_out[0])
    images.sort(key=lambda image: numeric_order(image.name))
    points = {}
    if points_file.exists():
        found = _points_bin(points_file) if binary else _points_txt(points_file)
        points = {number: (xyz, error) for number, xyz, error in found if np.isfinite(xyz).all()}
    xyz_by_id = {number: xyz for number, (xyz, _) in points.items()}
    errors = {number: error for number, (_, error) in points.items()}
    return ColmapModel(cameras, tuple(images), xyz_by_id, errors, tuple(left_out))


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


# A camera: id, model, width, height, parameters. An image: name, id of its camera, QW QX QY QZ TX TY TZ, and a row
# (x, y, id of the point) for each feature.
_Camera = tuple[int, str, int, int, list[float]]
_Image = tuple[str, int, list[float], Float64]


class _Bytes:
    """Numbers of a binary file, in order, little endian; raises ImportSourceError where the file ends before."""

    def __init__(self, file: Path) -> None:
        self._data, self._at, self.file = _read(file), 0, file

    def numbers(self, form: str) -> tuple[float, ...]:
        """Numbers as ``struct`` has them."""
        return struct.unpack("<" + form, self._take(struct.calcsize("<" + form)))

    def count(self) -> int:
        """A number of things that follow."""
        return int(self.numbers("Q")[0])

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        """Records."""
        return np.frombuffer(self._take(dtype.itemsize * count), dtype)

    def text(self) -> str:
        """Up to a zero byte."""
        end = self._data.find(b"\0", self._at)
        return self._take(max(end, self._at) + 1 - self._at)[:-1].decode("utf-8", "replace")

    def _take(self, size: int) -> bytes:
        self._at += size
        if self._at > len(self._data):
            raise ImportSourceError(f"{self.file}: is cut off, or no file of a COLMAP model; export the model again")
        return self._data[self._at - size : self._at]


_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("feature", "<i4")])


def _cameras_bin(file: Path) -> Iterator[_Camera]:
    data = _Bytes(file)
    for _ in range(data.count()):
        number, model, width, height = (int(n) for n in data.numbers("iiQQ"))
        if model not in MODELS:  # how long it is, is not known
            raise ImportSourceError(
                f"{file}: camera {number} has model {model}, which is not known. Undistort the images (`colmap "
                "image_undistorter`) and import the model that comes out"
            )
        name, count = MODELS[model]
        yield number, name, width, height, list(data.numbers(f"{count}d"))


def _images_bin(file: Path) -> Iterator[_Image]:
    data = _Bytes(file)
    for _ in range(data.count()):
        _, *pose, camera = data.numbers("i7di")
        name = data.text()
        rows = data.array(_FEATURE, data.count())
        yield name, int(camera), pose, np.stack((rows["x"], rows["y"], rows["point"]), axis=1)


def _points_bin(file: Path) -> Iterator[tuple[int, Float64, float]]:
    data = _Bytes(file)
    for _ in range(data.count()):
        number, x, y, z, _, _, _, error = data.numbers("Qddd3Bd")
        data.array(_TRACK, data.count())
        yield int(number), np.array((x, y, z)), float(error)


def _cameras_txt(file: Path) -> Iterator[_Camera]:
    for line, words in _lines(file):
        with _explained(file, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            number, width, height = (int(word) for word in (words[0], *words[2:4]))
            params = [float(word) for word in words[4:]]
        yield number, words[1], width, height, params


def _images_txt(file: Path) -> Iterator[_Image]:
    """Two lines an image; the second one, its features, may be empty."""
    rows = iter(_lines(file, empty=True))
    for line, words in rows:
        if not words:
            continue
        _, features = next(rows, (0, []))
        with _explained(file, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID ..."):
            pose, camera, name = [float(word) for word in words[1:8]], int(words[8]), " ".join(words[9:])
            found = np.array(features, np.float64).reshape(-1, 3)
        yield name, camera, pose, found


def _points_txt(file: Path) -> Iterator[tuple[int, Float64, float]]:
    for line, words in _lines(file):
        with _explained(file, line, "POINT3D_ID X Y Z R G B ERROR TRACK[]"):
            point = int(words[0]), np.array(words[1:4], np.float64).reshape(3), float(words[7])
        yield point


@contextmanager
def _explained(file: Path, line: int, form: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError) as error:
        raise ImportSourceError(f"{file}, line {line}: expected {form} ({error}); export the model again") from error


def _lines(file: Path, *, empty: bool = False) -> Iterator[tuple[int, list[str]]]:
    text = _read(file).decode("utf-8-sig", "replace")  # names of pictures may be in another character set
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#") and (empty or line.strip()):
            yield number, line.split()


def _read(file: Path) -> bytes:
    try:
        return read_regular(file, MAX_BYTES)
    except OSError as error:
        raise ImportSourceError(
            f"{file}: cannot be read ({error.strerror or error}); a model has cameras, images, points3D, .bin or .txt"
        ) from error
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error
