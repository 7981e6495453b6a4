"""What all importers share: options and report, the shape of a recording, and reading of its images."""

import io
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import Config
from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import CodecError, ConfigError, FrameError, ImportSourceError, LabelError
from semantic_mapper.files import read_regular
from semantic_mapper.geometry import check_pose, nearest_pixels
from semantic_mapper.labels import LabelSet
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import decode_image_file, depth_from_uint16
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

PICTURES = (".jpg", ".jpeg", ".png")
DEPTHS = (".png", ".npy", ".npz")
CAMERA_ID = "camera"  # in the log, of recordings of one camera
MATCH_NS = 20_000_000  # TUM and ROS bags: largest time between a colour image, its depth image and its pose
MEGAPIXELS = 1.3
MAX_FILE_BYTES = 1 << 28  # of one image, or one list of poses


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """How to read a recording."""

    every: int = 1  # only every this many-th frame of the recording, the first one among them
    max_frames: int | None = None  # stop after this many frames; None = all
    # turn every image clockwise by this many quarters of a full turn: for a camera mounted on its side
    quarters: int = 0
    megapixels: float = MEGAPIXELS  # larger pictures are made smaller, to about this; 0 = none is
    # ROS bags: topics by role ("image", "depth", "info", "depth_info", "pose"), if several fit. Any: depth "none".
    topics: Mapping[str, str] = field(default_factory=dict[str, str])
    renames: Mapping[str, str] = field(default_factory=dict[str, str])  # new names of classes, by their present ones
    world: str = ""  # ROS bags: frame of tf in which poses are; empty = map, world or odom
    body: str = ""  # ROS bags: frame whose pose the topic of poses tells; empty = as its messages say
    # metres per unit of poses whose unit is their own (transforms, colmap, opensfm); None = not known
    scale: float | None = None

    @property
    def without_depth(self) -> bool:
        """Whether depth images are left out."""
        return self.topics.get("depth") == "none"


class RenameConfig(Config, frozen=True):
    """A file of class names."""

    classes: dict[str, str]  # new name of each class to rename, by the recording's name for it


@dataclass(frozen=True, slots=True)
class Skipped:
    """Something that was left out."""

    file: Path  # that is at fault
    reason: str  # what is wrong with it, and how to fix it
    frame: int  # number of the frame in the recording
    label_only: bool = False  # the frame is in the log, but without its label image


@dataclass(frozen=True, slots=True)
class DepthScale:
    """What the numbers of a recording's depth images mean."""

    units_per_m: float
    given_in: Path | None = None  # the file that gives it; None: assumed, since the recording does not say
    convention: str = ""  # whose convention was assumed, for people
    float_units_per_m: float = 1.0  # of numbers with a point (NumPy's files)

    def __str__(self) -> str:
        """For people."""
        if self.given_in is not None:
            return f"{self.units_per_m:g} units per metre, given in {self.given_in}"
        return f"{self.units_per_m:g} units per metre, assumed: {self.convention}"


@dataclass(slots=True)
class ImportReport:
    """What an import did."""

    format: str  # of the recording
    depth_scale: DepthScale  # how its depth images were read
    info: StreamInfo  # what stands in the log's head
    frames: int = 0  # in the log
    labelled: int = 0  # of these, with a label image that no weights have rendered
    with_depth: int = 0  # of these, with a depth image of a sensor
    median_depth_m: float = 0.0  # of the measurements in the first of them, to judge the scale by; 0 without any
    skipped: list[Skipped] = field(default_factory=list[Skipped])  # frames and label images that were left out
    notices: list[str] = field(default_factory=list[str])  # sentences on what had to be assumed of the recording
    bytes: int = 0  # size of the log

    def count(self, frame: PosedFrame) -> None:
        """Count a frame that is in the log."""
        self.frames += 1
        self.labelled += frame.label is not None and not frame.label_is_pseudo
        if frame.depth_m is not None and frame.depth_sigma_m is None:
            self.with_depth += 1
            if not self.median_depth_m and (frame.depth_m > 0).any():
                self.median_depth_m = float(np.median(frame.depth_m[frame.depth_m > 0]))


class BadFrameError(ImportSourceError):
    """One frame of a recording cannot be imported."""

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file}: {reason}")
        self.file = file
        self.reason = reason


def read_bytes(file: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All of one file of a recording.

    Raises BadFrameError: missing, no regular file (a pipe may never end), or larger than ``limit`` bytes.
    """
    try:
        return read_regular(file, limit)
    except ConfigError as error:
        raise BadFrameError(file, str(error).removeprefix(f"{file}: ")) from error
    except OSError as error:
        raise BadFrameError(file, f"cannot be read ({error.strerror or error})") from error


def read_rgb(file: Path) -> tuple[UInt8, EncodedImage]:
    """Colour image (H, W, 3) and the file's bytes, which the log keeps as they are.

    Raises BadFrameError: missing, damaged, cut off, or neither PNG nor JPEG.
    """
    data = read_bytes(file)
    try:
        rgb, encoding = decode_image_file(data)
    except CodecError as error:
        raise BadFrameError(file, f"{error}; export the image again") from error
    return rgb, EncodedImage(encoding, data)


def camera_of(
    where: object, k: Iterable[float], size: tuple[float, float], model: str = "", coefficients: Sequence[float] = ()
) -> CameraIntrinsics:
    """Intrinsics by fx fy cx cy, (width, height) and a lens, see ``lens_intrinsics``.

    Raises ImportSourceError: they cannot be; ``where`` they stand.
    """
    try:
        fx, fy, cx, cy = map(float, k)
        return lens_intrinsics(model, coefficients, (fx, fy, cx, cy), (int(size[0]), int(size[1])))
    except (ValueError, OverflowError) as error:  # ConfigError and FrameError, too
        raise ImportSourceError(f"{where}: {error}") from error


def first_size(pictures: Iterable[Path], where: Path) -> tuple[int, int]:
    """(width, height) of the first picture that can be read. Raises ImportSourceError: none can."""
    for picture in pictures:
        try:
            rgb, _ = read_rgb(picture)
        except BadFrameError:  # reported when its turn comes
            continue
        return rgb.shape[1], rgb.shape[0]
    raise ImportSourceError(f"{where}: no image that can be read, which would tell width and height")


def read_depth(file: Path, scale: DepthScale) -> Float32:
    """Depth image (H, W) in metres, of a 16-bit PNG, or of NumPy's file of one matrix.

    Raises BadFrameError: missing, damaged, or not 16-bit.
    """
    if file.suffix.lower() == ".png":
        return metres(read_plane(file, "uint16", None, "depth"), scale.units_per_m)
    values = _read_numpy(file)
    return metres(values, scale.units_per_m if values.dtype.kind in "iu" else scale.float_units_per_m)


def metres(values: NDArray[np.generic], units_per_m: float) -> Float32:
    """Depth (H, W) in metres, float32: 0 for what is no measurement (NaN, infinity, negative)."""
    if values.dtype == np.uint16:
        return depth_from_uint16(values.astype(np.uint16, copy=False), units_per_m)
    depth_m = (values.astype(np.float64) / units_per_m).astype(np.float32)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0
    return depth_m


def depth_of_points(points: Float64, intrinsics: CameraIntrinsics, reach: tuple[int, int] = (0, 0)) -> Float32:
    """Depth (H, W) in metres that points (N, 3) of the camera's frame give it, 0 where none falls; the nearest wins.

    Each also fills its neighbours within ``reach`` columns and rows.
    """
    (across, up), k = reach, intrinsics
    size = (k.width + 2 * across, k.height + 2 * up)
    around = CameraIntrinsics(k.fx, k.fy, k.cx + across, k.cy + up, *size)
    inside, rows, columns = nearest_pixels(points, around)
    depth = np.full(size[::-1], np.inf, np.float32)
    np.minimum.at(depth, (rows[inside], columns[inside]), points[inside, 2].astype(np.float32))
    depth = np.asarray(cv2.erode(depth, np.ones((2 * up + 1, 2 * across + 1), np.uint8)))
    depth = depth[up : up + k.height, across : across + k.width]
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def _read_numpy(file: Path) -> NDArray[np.generic]:
    data = read_bytes(file)
    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        arrays = [loaded[name] for name in loaded.files] if isinstance(loaded, np.lib.npyio.NpzFile) else [loaded]
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise BadFrameError(file, f"is no file of NumPy that holds numbers: {error}; save it again") from error
    values = np.squeeze(arrays[0]) if len(arrays) == 1 else np.zeros(0)
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise BadFrameError(file, "a depth image is one matrix of numbers, which this is not; save it alone")
    return values


def read_plane(
    file: Path, kind: Literal["uint8", "uint16", "any"], size: tuple[int, int] | None, what: str
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Single-channel PNG as it is: (H, W) uint8 or uint16.

    ``size`` is (height, width), None = any; ``what`` it shows, for errors. Raises BadFrameError: missing, damaged, of
    another type or size.
    """
    data = read_bytes(file)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise BadFrameError(file, f"the {what} image is damaged or no image at all; export it again")
    wanted = "uint8 or uint16" if kind == "any" else kind
    if image.ndim != 2 or image.dtype.name not in wanted.split(" or "):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise BadFrameError(
            file,
            f"a {what} image has one {wanted} channel, this one has {channels} of {image.dtype.name}; export it so",
        )
    if size is not None and image.shape != size:
        (height, width), (rows, columns) = image.shape, size
        raise BadFrameError(
            file, f"the {what} image is {width}x{height}, the colour image {columns}x{rows}; export it in that size"
        )
    return cast("NDArray[np.uint8] | NDArray[np.uint16]", image)


def check_label(image: UInt8, labels: LabelSet, file: Path) -> UInt8:
    """Refuse a label image (H, W) with ids that are not in ``labels``. Raises BadFrameError: naming them."""
    try:
        labels.to_channels(image, "label image")
    except LabelError as error:
        raise BadFrameError(file, str(error)) from error
    return image


def read_label(file: Path, labels: LabelSet, size: tuple[int, int]) -> UInt8:
    """Label image (H, W) of class ids that are all in ``labels``.

    Raises BadFrameError: missing, damaged, of another type or size, or an id that is not in the set.
    """
    return check_label(read_plane(file, "uint8", size, "label").astype(np.uint8, copy=False), labels, file)


def same_view(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether images of two sizes have one form, so that one can be the other made smaller; their sides are rounded."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= max(*a, *b)


def check_frame_pose(T_world_camera: Float64, file: Path, line: int | None = None) -> Float64:
    """Refuse a pose that is no rigid transform. Raises BadFrameError: with the reason and the line of the file."""
    try:
        check_pose(T_world_camera, f"line {line}" if line is not None else "pose")
    except FrameError as error:
        raise BadFrameError(file, str(error)) from error
    return T_world_camera
