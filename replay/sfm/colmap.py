"""COLMAP in a process of its own: what it gets and what it gives, and its models.

A crash of its native code, or Ctrl-C, ends that process alone (``colmap_process``). Here pixel centres are integers;
COLMAP's pixels begin at the corner of the image, so 0.5 is taken off.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import msgspec
import numpy as np

from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, DependencyError, FrameError, ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import CameraIntrinsics, Float64, Int64

REQUEST, RESULT, FEATURES = "request.json", "result.json", "features"  # in the folder of a mapping
MIN_MODEL_IMAGES = 5
LINK_MATCHES = 20  # of two frames that show one place
FLAT = 0.93  # of the matches that one homography explains: nothing but a turn, or one plane
TURNED = 0.8  # of the matches that a turn explains: nothing but that
UNKNOWN_FOCAL = 0.3  # standard deviation of a focal length that usual lenses tell better than the film: it is assumed
_LARGE = 1280  # pixels of the longer side from which on COLMAP's limits hold
_LEAST_PRECISION = 0.25  # least factor of them


class Camera(msgspec.Struct, frozen=True):
    """The camera of all frames of a mapping, in COLMAP's convention."""

    width: int
    height: int
    fixed: tuple[float, float, float, float] | None  # fx, fy, cx, cy of a calibrated camera, which stay
    focal_priors: tuple[float, ...]  # to begin with, in this order, until most frames find their place
    # The first of these is known about, and held until all frames have their place: rows of pictures over flat ground
    # fit a wrong one as well.
    about: bool = False

    @property
    def size(self) -> int:
        """Of the longer side, in pixels."""
        return max(self.width, self.height)

    @property
    def precision(self) -> float:
        """Factor of COLMAP's limits in pixels, which are for large photographs."""
        return min(1.0, max(_LEAST_PRECISION, self.size / _LARGE))


class Model(msgspec.Struct, frozen=True):
    """One model that an attempt has given."""

    folder: str  # with COLMAP's binary files
    images: int  # registered
    error_px: float  # mean reprojection error
    focal_px: float  # found or given


class Attempt(msgspec.Struct, frozen=True):
    """What came of one focal length."""

    focal_prior_px: float  # to begin with
    models: list[Model]  # the largest first
    ahead: bool = False  # begun with two frames that may lie straight ahead of each other


class Pair(msgspec.Struct, frozen=True):
    """Two frames, by their places in the sequence, with matches that agree with one geometry."""

    first: int
    second: int
    matches: int
    flat: float  # fraction that one homography explains: 1 for a camera that only turns, or one plane
    turn: float = 0.0  # fraction that a turn on the spot explains


class FocalCheck(msgspec.Struct, frozen=True):
    """What the pictures say of a given focal length."""

    factor: float  # by which it has to be multiplied to fit them best
    sigmas: float  # how sure that is: the difference over its own standard deviation


class Outcome(msgspec.Struct, frozen=True):
    """All that a mapping gives."""

    attempts: list[Attempt]  # in the order of trial
    pairs: list[Pair]  # of frames near each other
    focal: FocalCheck | None = None  # of the largest model of a calibrated camera
    # Standard deviation of a focal length that was found, as a fraction of it: noise of the features alone. Above
    # ``UNKNOWN_FOCAL`` the model has the one that the attempt began with.
    focal_sigma: float | None = None

    @property
    def best(self) -> Attempt:
        """The one with the largest model, of equal ones that with the smallest error."""
        return max(self.attempts, key=lambda a: (a.models[0].images, -a.models[0].error_px) if a.models else (0, 0.0))


def turn_fraction(pairs: Sequence[Pair], *, flat: bool = False) -> float:
    """Of the pairs some steps apart, those that a turn on the spot (``flat``: or that, or one plane) explains."""
    apart = [p for p in pairs if p.second - p.first >= 2 and p.matches >= LINK_MATCHES]
    turned = float(np.mean([p.turn >= TURNED for p in apart])) if apart else 0.0
    return max(turned, float(np.mean([p.flat >= FLAT for p in apart]))) if flat and apart else turned


def require_colmap() -> None:
    """Raises ``DependencyError`` where pycolmap is not installed."""
    if find_spec("pycolmap") is None:
        raise DependencyError(
            "poses of films and models of COLMAP need pycolmap, which has no packages for Linux on ARM: import on an "
            "x86-64 machine, and copy the log"
        )


def run_colmap(subject: Path, arguments: Sequence[Path], on_line: Callable[[str], None] = lambda _: None) -> None:
    """Run ``colmap_process``; ``on_line`` gets each line of its progress.

    Raises ImportSourceError: it fails; says why, and names the subject. DependencyError: pycolmap is not installed.
    """
    require_colmap()
    command = [sys.executable, "-I", "-m", "semantic_mapper.replay.sfm.colmap_process", *map(str, arguments)]
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors) as process,
    ):
        try:
            assert process.stdout is not None
            for line in process.stdout:
                on_line(line.decode())
            code = process.wait()
        finally:
            process.kill()  # after Ctrl-C; one that has ended does not mind
        errors.seek(0)
        said = errors.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
    if code:
        raise ImportSourceError(f"{subject}: pycolmap ended with exit code {code}: {said[-1]}")


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """One registered image."""

    name: str  # as the model has it, a path below the folder of images
    camera_id: int
    T_world_camera: Float64  # (4, 4)
    xy: Float64  # (N, 2) pixels of the points that it sees
    points: Int64  # (N,) their rows in the model


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """A model."""

    cameras: dict[int, CameraIntrinsics]  # by their ids; with distortion as OpenCV has it
    images: tuple[ColmapImage, ...]  # in the order of their names, by the numbers in these
    xyz: Float64  # (P, 3) points
    errors_px: Float64  # (P,) mean reprojection error of each
    left_out: tuple[str, ...] = ()  # images whose camera cannot be used, and why


def find_models(folder: Path) -> list[Path]:
    """Folders of models: this one, or else those in ``sparse`` or ``colmap/sparse`` below it, by their numbers."""

    def is_model(place: Path) -> bool:
        return any(
            all((place / f"{name}.{kind}").is_file() for name in ("cameras", "images")) for kind in ("bin", "txt")
        )

    if is_model(folder):
        return [folder]
    for place in (folder / "sparse", folder / "colmap" / "sparse"):
        below = sorted(place.iterdir(), key=lambda path: numeric_order(path.name)) if place.is_dir() else []
        if found := [path for path in (place, *below) if is_model(path)]:
            return found
    return []


def read_model(folder: Path) -> ColmapModel:
    """Read the model in a folder, text or binary.

    Raises ImportSourceError: a file is missing or damaged, or no image has a camera with a lens of OpenCV's models.
    DependencyError: pycolmap is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-colmap-") as scratch:
        file = Path(scratch) / "model.npz"
        run_colmap(folder, (folder, file))
        with np.load(file) as stored:
            model = {name: stored[name] for name in stored.files}
    cameras: dict[int, CameraIntrinsics] = {}
    unusable: dict[int, str] = {}
    lenses = msgspec.json.decode(str(model["cameras"]), type=list[tuple[int, str, int, int, list[float]]])
    for number, kind, width, height, params in lenses:
        try:
            cameras[number] = intrinsics_of(kind, width, height, params, f"{folder}, camera {number}")
        except ImportSourceError as error:
            unusable[number] = str(error)
    if not np.isfinite(model["poses"]).all():
        raise ImportSourceError(f"{folder}: the pose of an image is not a number; export the model again")
    ends = np.cumsum(model["counts"])[:-1]
    xy, points = np.split(model["xy"] - 0.5, ends), np.split(model["points"], ends)
    rows = zip(
        model["names"].tolist(), model["camera_ids"].tolist(), invert_pose(model["poses"]), xy, points, strict=True
    )
    found = [ColmapImage(*row) for row in rows] if len(model["names"]) else []
    images = sorted((i for i in found if i.camera_id in cameras), key=lambda image: numeric_order(image.name))
    left_out = tuple(unusable[image.camera_id] for image in found if image.camera_id in unusable)
    if left_out and not images:
        raise ImportSourceError(left_out[0])
    return ColmapModel(cameras, tuple(images), model["xyz"], model["errors_px"], left_out)


def intrinsics_of(model: str, width: int, height: int, params: list[float], where: str) -> CameraIntrinsics:
    """A camera of COLMAP's as OpenCV's model.

    Raises ImportSourceError: a lens that neither OpenCV's pinhole nor its fisheye model has, or impossible values.
    """
    one_focal = model.startswith(("SIMPLE", "RADIAL", "BROWN"))
    fx, fy, cx, cy, *lens = (params[0], *params) if one_focal else (*params, *[0.0] * (4 - len(params)))
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
        raise ImportSourceError(
            f"{where}: the lens model '{model}' is not read; undistort the images (`colmap image_undistorter`) and "
            "import the model that comes out"
        )
    try:
        return lens_intrinsics("fisheye" if fisheye else "opencv", lens, (fx, fy, cx - 0.5, cy - 0.5), (width, height))
    except (ConfigError, FrameError) as error:
        raise ImportSourceError(f"{where}: {error}") from error
