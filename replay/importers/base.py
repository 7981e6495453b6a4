"""What all importers share: the shape of a recording, reading of images and numbers, and the report."""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, cast

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import Config, read_json
from semantic_mapper.errors import CodecError, ConfigError, FrameError, ImportSourceError, LabelError
from semantic_mapper.files import decode_text, read_regular
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.plain_text import counted
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import decode_image_file, depth_from_uint16
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float32, Float64, PosedFrame, UInt8


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """How to read a recording.

    Args:
        camera_id: Name that the camera gets in the log.
        frame_hz: Rate from which stamps are made where the recording has none; None = what the format has (folder 6,
            scannet 30).
        every: Only every this many-th frame of the recording, the first one among them.
        max_frames: Stop after this many frames; None = all.
        quarters: Turn every image clockwise by this many quarters of a full turn: for a camera mounted on its side.
        match_s: TUM and ROS bags: largest time between a colour image, its depth image and its pose.
        topics: ROS bags: topics by role ("image", "depth", "info", "depth_info", "pose"), where several fit. Depth
            "none", of every format: without.
        world: ROS bags: frame of tf in which poses are; empty = map, world or odom.
        body: ROS bags: frame whose pose the topic of poses tells; empty = as its messages say.
        scale: Metres per unit of poses whose unit is their own (transforms, colmap, opensfm); None = not known.
    """

    camera_id: str = "camera"
    frame_hz: float | None = None
    every: int = 1
    max_frames: int | None = None
    quarters: int = 0
    match_s: float = 0.02
    topics: Mapping[str, str] = field(default_factory=dict[str, str])
    world: str = ""
    body: str = ""
    scale: float | None = None

    @property
    def without_depth(self) -> bool:
        """Whether depth images are left out."""
        return self.topics.get("depth") == "none"


PICTURES = (".jpg", ".jpeg", ".png")
NUMPY = (".npy", ".npz")
DEPTHS = (".png", *NUMPY)
MAX_FILE_BYTES = 1 << 28  # of one image, or one list of poses


class RenameConfig(Config, frozen=True):
    """A file of class names."""

    classes: dict[str, str]  # new name of each class to rename, by the recording's name for it


@dataclass(frozen=True, slots=True)
class Skipped:
    """Something that was left out.

    Args:
        file: The file that is at fault.
        reason: What is wrong with it, and how to fix it.
        frame: Number of the frame in the recording.
        label_only: The frame is in the log, but without its label image.
    """

    file: Path
    reason: str
    frame: int
    label_only: bool = False


@dataclass(frozen=True, slots=True)
class DepthScale:
    """What the numbers of a recording's depth images mean.

    Args:
        units_per_m: Units per metre.
        given_in: The file that gives it; None: assumed, since the recording does not say.
        convention: Whose convention was assumed, for people.
        float_units_per_m: Units per metre of numbers with a point (NumPy's files); None = metres, or as whole numbers
            where half of them are above 100.
    """

    units_per_m: float
    given_in: Path | None = None
    convention: str = ""
    float_units_per_m: float | None = None

    def __str__(self) -> str:
        """For people."""
        if self.given_in is not None:
            return f"{self.units_per_m:g} units per metre, given in {self.given_in}"
        return f"{self.units_per_m:g} units per metre, assumed: {self.convention}"


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import did.

    Args:
        frames: In the log.
        labelled: Of these, with a label image.
        with_depth: Of these, with a depth image.
        depth_scale: How their depth images were read.
        median_depth_m: Of the measurements in the first of them, to judge the scale by; 0 without any.
        skipped: Frames and label images that were left out.
        notices: Sentences on what had to be assumed of the whole recording.
        format: Of the recording.
        info: What stands in the log's head.
        bytes: Size of the log.
    """

    frames: int
    labelled: int
    with_depth: int
    depth_scale: DepthScale
    median_depth_m: float
    skipped: tuple[Skipped, ...]
    notices: tuple[str, ...]
    format: str
    info: StreamInfo
    bytes: int


@dataclass(frozen=True, slots=True)
class LoadedFrame:
    """One frame of a recording.

    Args:
        frame: Ready for the log.
        encoded_rgb: Its colour image as the file holds it; None where it had to be changed.
        label_error: Why it has no label image although there is a file; None where all is well.
    """

    frame: PosedFrame
    encoded_rgb: EncodedImage | None
    label_error: Skipped | None = None


class Recording(Protocol):
    """A foreign recording, opened. ``load`` may be called in any order."""

    info: StreamInfo
    depth_scale: DepthScale  # of its depth images
    notices: list[str]

    def __len__(self) -> int:
        """Frames, good and bad."""
        ...

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        ...


class BadFrameError(ImportSourceError):
    """One frame of a recording cannot be imported."""

    def __init__(self, file: Path, reason: str) -> None:
        super().__init__(f"{file}: {reason}")
        self.file = file
        self.reason = reason


def read_bytes(file: Path) -> bytes:
    """All of one file of a recording.

    Raises:
        BadFrameError: no regular file (a pipe may never end), or larger than any image or list of poses.
        OSError: missing, or it cannot be read.
    """
    try:
        return read_regular(file, MAX_FILE_BYTES)
    except ConfigError as error:
        raise BadFrameError(file, str(error).removeprefix(f"{file}: ")) from error


def read_rgb(file: Path) -> tuple[UInt8, EncodedImage]:
    """Colour image (H, W, 3) and the file's bytes, which the log keeps as they are.

    Raises:
        BadFrameError: missing, damaged, cut off, or neither PNG nor JPEG.
    """
    try:
        data = read_bytes(file)
        rgb, encoding = decode_image_file(data)
    except OSError as error:
        raise BadFrameError(file, f"cannot be read ({error.strerror or error})") from error
    except CodecError as error:
        raise BadFrameError(file, f"{error}; export the image again") from error
    return rgb, EncodedImage(encoding, data)


def first_size(pictures: Iterable[Path]) -> tuple[int, int] | None:
    """(width, height) of the first picture that can be read, for files that do not tell it; None = none can."""
    for picture in pictures:
        try:
            rgb, _ = read_rgb(picture)
        except BadFrameError:  # reported when its turn comes
            continue
        return rgb.shape[1], rgb.shape[0]
    return None


def read_depth(file: Path, scale: DepthScale, size: tuple[int, int] | None) -> Float32:
    """Depth image (H, W) in metres.

    Args:
        file: 16-bit PNG, or NumPy's file of one matrix.
        scale: Of its numbers.
        size: (height, width) that it must have; None = any.

    Raises:
        BadFrameError: missing, damaged, not 16-bit, or of another size.
    """
    if file.suffix.lower() not in NUMPY:
        return depth_from_uint16(read_plane(file, "uint16", size, "depth").astype(np.uint16), scale.units_per_m)
    values = _read_numpy(file)
    if size is not None and values.shape != size:
        raise _wrong_size(file, "depth", (values.shape[0], values.shape[1]), size)
    units = scale.units_per_m if values.dtype.kind in "iu" else scale.float_units_per_m
    if units is None:
        measured = metres(values)
        far = (measured > 0).any() and np.median(measured[measured > 0]) > _MOST_METRES
        units = scale.units_per_m if far else 1.0
    return metres(values.astype(np.float64) / units)


_MOST_METRES = 100.0  # depth with a larger median is in the unit of whole numbers


def metres(values: NDArray[np.generic]) -> Float32:
    """Depth (H, W) in metres, float32: 0 for what is no measurement (NaN, infinity, negative)."""
    depth_m = values.astype(np.float32)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0
    return depth_m


def numpy_notice(files: Iterable[Path], scale: DepthScale) -> list[str]:
    """A sentence on the unit of depth in NumPy's files, where nothing tells it; empty without such files."""
    if scale.float_units_per_m is not None or not any(file.suffix.lower() in NUMPY for file in files):
        return []
    return [
        "depth with a point in NumPy's files is taken as metres, or in the unit of whole numbers "
        f"({scale.units_per_m:g} per metre) where half of an image is above {_MOST_METRES:g}"
    ]


def _read_numpy(file: Path) -> NDArray[np.generic]:
    try:
        loaded = np.load(io.BytesIO(read_bytes(file)), allow_pickle=False)
        arrays = [loaded[name] for name in loaded.files] if isinstance(loaded, np.lib.npyio.NpzFile) else [loaded]
    except OSError as error:
        raise BadFrameError(file, f"the depth image cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise BadFrameError(file, f"is no file of NumPy that holds numbers: {error}; save it again") from error
    if len(arrays) != 1:
        raise BadFrameError(file, f"holds {len(arrays)} arrays; save the depth image alone")
    values = np.asarray(arrays[0])
    if values.ndim == 3 and 1 in (values.shape[0], values.shape[2]):
        values = values.squeeze(0 if values.shape[0] == 1 else 2)
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise BadFrameError(file, f"a depth image is a matrix of numbers, this is {values.dtype} {values.shape}")
    return values


def read_depth_if_there(file: Path | None, scale: DepthScale, size: tuple[int, int]) -> Float32 | None:
    """Depth image (H, W) in metres; None where there is no such file, as of a frame without depth.

    Raises:
        BadFrameError: the file is there, and is damaged, not 16-bit, or of another size.
    """
    return read_depth(file, scale, size) if file is not None and file.exists() else None


def read_plane(
    file: Path, kind: Literal["uint8", "uint16", "any"], size: tuple[int, int] | None, what: str
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Single-channel PNG as it is: (H, W) uint8 or uint16.

    Args:
        file: To read.
        kind: "uint8", "uint16", or "any" of the two.
        size: (height, width) that it must have; None = any.
        what: It shows, for errors.

    Raises:
        BadFrameError: missing, damaged, of another type or size.
    """
    try:
        data = read_bytes(file)
    except OSError as error:
        raise BadFrameError(file, f"the {what} image cannot be read ({error.strerror or error})") from error
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error as error:
        raise BadFrameError(file, f"the {what} image is damaged: {error}") from error
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
        raise _wrong_size(file, what, (image.shape[0], image.shape[1]), size)
    return cast("NDArray[np.uint8] | NDArray[np.uint16]", image)


def _wrong_size(file: Path, what: str, size: tuple[int, int], wanted: tuple[int, int]) -> BadFrameError:
    way_out = "register it to the colour image, or import without it (--topic depth=none)"
    return BadFrameError(
        file,
        f"the {what} image is {size[1]}x{size[0]}, the colour image {wanted[1]}x{wanted[0]}; "
        + (way_out if what == "depth" else "export it in that size"),
    )


def same_view(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether images of two sizes have one form, so that one can be the other made smaller; their sides are rounded."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= max(*a, *b)


def read_label(file: Path, labels: LabelSet, size: tuple[int, int]) -> UInt8:
    """Label image (H, W) of class ids that are all in ``labels``.

    Raises:
        BadFrameError: missing, damaged, of another type or size, or an id that is not in the set.
    """
    image = read_plane(file, "uint8", size, "label").astype(np.uint8, copy=False)
    try:
        labels.to_channels(image, "label image")
    except LabelError as error:
        raise BadFrameError(file, str(error)) from error
    return image


def check_frame_pose(T_world_camera: Float64, file: Path, line: int | None = None) -> Float64:
    """Refuse a pose that is no rigid transform.

    Raises:
        BadFrameError: with the reason and the line of the file.
    """
    try:
        check_pose(T_world_camera, f"line {line}" if line is not None else "pose")
    except FrameError as error:
        raise BadFrameError(file, str(error)) from error
    return T_world_camera


def read_matrix(file: Path) -> Float64:
    """A 4x4 (or 3x3, then padded) matrix as text.

    Raises:
        ImportSourceError: missing, or not such a matrix.
    """
    try:
        numbers = [number for _, line in read_lines(file) for number in read_numbers(line)]
    except ValueError as error:
        raise ImportSourceError(f"{file}: holds something that is no number: {error}") from error
    if len(numbers) not in (9, 16):
        raise ImportSourceError(f"{file}: expected the 16 numbers of a 4x4 matrix, got {len(numbers)}")
    side = 3 if len(numbers) == 9 else 4
    matrix = np.eye(4)
    matrix[:side, :side] = np.array(numbers, np.float64).reshape(side, side)
    return matrix


def numbered_files(folder: Path, suffixes: tuple[str, ...], notices: list[str]) -> dict[int, Path]:
    """Files named by a number ("000017.jpg", "17.png", "frame-000017.color.jpg") by that number, in its order.

    Of several numbers the first one counts, unless the last one tells more files apart ("cam0_000017.png").

    Args:
        folder: Of the files; none are found where it is missing.
        suffixes: What their names end with, in small letters.
        notices: Gets a sentence on files that are left out.
    """
    found: dict[int, Path] = {}
    left_out: list[str] = []
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes] if folder.is_dir() else []
    numbers = {file: [int(n) for n in re.findall(r"\d{1,18}", file.stem)] for file in sorted(files)}
    which = max((0, -1), key=lambda place: len({of[place] for of in numbers.values() if of}))
    for file, of in numbers.items():
        if not of or of[which] in found:
            left_out.append(file.name)
        else:
            found[of[which]] = file
    if left_out:
        notices.append(
            f"{folder}: {counted(len(left_out), 'file')} without a number, or with that of another file, left out; the "
            f"first: {left_out[0]}"
        )
    return dict(sorted(found.items()))


def depth_files(folder: Path, options: ImportOptions, scale: DepthScale, notices: list[str]) -> dict[int, Path]:
    """Depth images of a folder by their numbers; none where depth is left out.

    Args:
        folder: Of the images.
        options: Of the import.
        scale: Of the images.
        notices: Gets sentences on files that are left out, and on a unit that is assumed.
    """
    found = {} if options.without_depth else numbered_files(folder, DEPTHS, notices)
    notices += numpy_notice(found.values(), scale)
    return found


def split_row(text: str) -> list[str]:
    """Words of a row: between spaces, tabs, commas or semicolons, in brackets or without. A comma may be a decimal one
    where semicolons, or spaces, part the words."""
    text = text.strip().strip("[]()")
    if ";" in text:
        return [word.strip().replace(",", ".") for word in text.strip().strip(";").split(";")]
    words = text.split()
    if len(words) > 1 and any("," in word for word in words) and all(re.fullmatch(_DECIMAL_COMMA, w) for w in words):
        return [word.replace(",", ".") for word in words]
    return re.split(r"\s*,\s*|\s+", text.strip().strip(","))


_DECIMAL_COMMA = r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?"


def read_numbers(text: str) -> list[float]:
    """Numbers of a row.

    Raises:
        ValueError: a word is no number, or there are no words.
    """
    if not text.strip():
        raise ValueError("is empty or a comment")
    return [float(word) for word in split_row(text)]


def read_lines(file: Path) -> list[tuple[int, str]]:
    """Lines of a text file that are not empty and no comment, with their numbers from 1.

    Raises:
        ImportSourceError: missing, or not text.
    """
    try:
        lines = decode_text(read_bytes(file)).splitlines()
    except OSError as error:
        raise ImportSourceError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise ImportSourceError(f"{file}: is not a text file: {error}") from error
    return [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]


def read_rows(file: Path, count: int, notices: list[str]) -> list[tuple[int, str]]:
    """Rows of a file whose i-th row belongs to the i-th of ``count`` images, with their lines; the text of a row that
    is empty or a comment is "": it counts as one, unless there are as many rows without these as images.

    Args:
        file: To read.
        count: Of the images.
        notices: Gets a sentence on what was passed over.

    Raises:
        ImportSourceError: missing, or not text.
    """
    rows = read_lines(file)
    if len(rows) > count and rows and not any(map(_is_number, split_row(rows[0][1]))):
        notices.append(f"{file}: line {rows[0][0]} is a header")
        rows = rows[1:]
    between = (rows[-1][0] - rows[0][0] + 1 - len(rows)) if rows else 0
    if not between:
        return rows
    if len(rows) == count or 2 * between >= len(rows):
        notices.append(f"{file}: {counted(between, 'line')} passed over, empty or a comment")
        return rows
    texts = dict(rows)
    return [(line, texts.get(line, "")) for line in range(rows[0][0], rows[-1][0] + 1)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def without_picture(kind: str, numbers: Iterable[int], pictures: Iterable[int], where: Path) -> list[str]:
    """A sentence on poses or the like whose picture is missing; empty where all are there."""
    missing = sorted({*numbers} - {*pictures})
    if not missing:
        return []
    return [f"{counted(len(missing), kind)} without a picture in {where}; the first: number {missing[0]}"]


def image_size_must_be(rgb: UInt8, intrinsics: CameraIntrinsics, file: Path) -> None:
    """Refuse an image of another size than its camera makes.

    Raises:
        BadFrameError: naming both sizes.
    """
    if rgb.shape[:2] != (intrinsics.height, intrinsics.width):
        raise BadFrameError(
            file,
            f"the image is {rgb.shape[1]}x{rgb.shape[0]}, the camera's intrinsics say "
            f"{intrinsics.width}x{intrinsics.height}; resize it or fix the intrinsics",
        )


def seconds_to_ns(text: str) -> int:
    """Seconds as text -> nanoseconds, exactly (a float would lose them), in any form of a number.

    Raises:
        ValueError: no number, or too large for a stamp.
    """
    try:
        seconds = Decimal(text.strip()) if len(text) <= _NUMBER_LENGTH else None
    except InvalidOperation:
        seconds = None
    if seconds is None or not seconds.is_finite() or seconds < 0:
        raise ValueError(f"'{text[:40]}' is not a time in seconds")
    if seconds >= MAX_STAMP_NS // 1_000_000_000:
        raise ValueError(
            f"'{text[:40]}' is not a time in seconds (0 to {MAX_STAMP_NS // 1_000_000_000}); divide nanoseconds by 1e9"
        )
    return int(seconds.scaleb(9))


_NUMBER_LENGTH = 100  # letters


def inside(folder: Path, name: str) -> Path:
    """A file that a recording names. Links of the user's own are followed.

    Raises:
        ImportSourceError: the name leads out of the folder.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise ImportSourceError(
            f"{folder}: names '{name[:80]}', which lies outside of it; move the file into the folder, or link it there"
        )
    if "\\" in name and not (folder / name).exists():  # as Windows' programs part folders
        return inside(folder, name.replace("\\", "/"))
    return folder / name


StructT = TypeVar("StructT", bound=msgspec.Struct)
# Words and short names of keys that say what numbers mean: lens, axes, units, time.
_TELLING = re.compile(
    r"fish|lens|dist|coeff|radial|tangential|polynom|^xi$|^alpha$|^[KD]$|matrix|intrinsic|extrinsic|^pp[xy]$|sensor|pixel"
    r"|resiz|^factor$|w2c|c2w|pose_|_type$|_format$|invert|world_|^t0$|epoch|^dt$|rate$|period|readout|^fl$|equirect|latlong|ortho|panoram|spheric|^model$|principal|camera_?(model|type)|projection|^[kpsbdc]_?\d+$|ftheta|focal|fov|skew|aspect|crop|roi|binning|shutter"
    r"|ax[ei]s|convention|coordinate|handed|orient|rotat|flip|mirror|^up$|from_|unit|scale|metric|millimet|inch|feet|depth"
    r"|time|stamp|clock|fps|offset|delay|latency",
    re.IGNORECASE,
)
_AXES = re.compile(r"ax[ei]s|convention|coordinate|handed", re.IGNORECASE)
_NEUTRAL_WORDS = ("", "none", "identity", "pinhole", "perspective", "m", "meter", "meters", "metre", "metres")


def read_plain_json(file: Path, limit: int, kind: type[Any] = dict) -> Any:
    """JSON of another program, as plain data: a ``dict`` or ``list``. NaN becomes None.

    Raises:
        ImportSourceError: missing, no JSON, or larger than ``limit`` bytes.
    """
    try:
        return read_json(file, kind, limit)
    except ConfigError as error:
        if type(error.__cause__) is not msgspec.DecodeError:
            raise ImportSourceError(str(error)) from error
        refused = ImportSourceError(str(error))
    try:  # Python's programs write NaN, which is no JSON
        plain = json.loads(decode_text(read_regular(file, limit)), parse_constant=lambda _: None)
    except (ConfigError, OSError, ValueError, RecursionError) as error:
        raise refused from error
    if not isinstance(plain, kind):
        raise refused
    return plain


def convert_known(plain: Mapping[str, Any], kind: type[StructT], where: str) -> StructT:
    """Plain data -> struct; keys that the struct does not have are left out.

    Raises:
        ImportSourceError: a key is missing or of another type.
    """
    try:
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError as error:
        raise ImportSourceError(f"{where}: {error}") from error


def unknown_keys(
    tables: Iterable[Mapping[str, Any]], kind: type[msgspec.Struct], known: Sequence[str] = ()
) -> list[str]:
    """Keys that nothing here reads although, by their names and values, they change what other numbers mean.

    Args:
        tables: Of one kind, such as the frames of a recording.
        kind: What is read of them.
        known: Further keys that are known to change nothing.
    """
    read = {*(item.encode_name for item in msgspec.structs.fields(kind)), *known}
    found: dict[str, None] = {}
    for table in tables:
        for key in table.keys() - read:
            if key not in found and _tells(key, table[key]):
                found[key] = None
    return sorted(found)


def unknown_notice(file: Path, keys: Sequence[str]) -> list[str]:
    """A sentence on keys that are not read; empty where all are."""
    if not keys:
        return []
    names = ", ".join(f"'{key[:40]}'" for key in keys[:8])
    return [
        f"{file}: {names} {'is' if len(keys) == 1 else 'are'} not read; what it says of lens, axes, unit or time is "
        "lost"
    ]


def _tells(key: str, value: Any) -> bool:
    if isinstance(value, Mapping):
        within = cast("Mapping[str, Any]", value)
        return any(
            _tells(name, item) or (_TELLING.search(key) and not _is_neutral(name, item))
            for name, item in within.items()
        )
    return _TELLING.search(key) is not None and not _is_neutral(key, value)


def refuse_keys(table: Mapping[str, Any], names: re.Pattern[str], where: str) -> None:
    """Refuse keys that nothing here reads and that change what other numbers mean.

    Raises:
        ImportSourceError: one of them is there and not neutral.
    """
    for key, value in table.items():
        if names.fullmatch(key) and not _is_neutral(key, value):
            raise ImportSourceError(f"{where}: '{key[:40]}' is not read; undistort the images first, and leave it out")


def _is_neutral(key: str, value: Any) -> bool:
    if value is None or value is False:
        return True
    if isinstance(value, str):
        return value.strip().lower() in _NEUTRAL_WORDS and not _AXES.search(key)
    if isinstance(value, Mapping):
        return all(_is_neutral(key, item) for item in cast("Mapping[str, Any]", value).values())
    if isinstance(value, list):
        rows = cast("list[Any]", value)
        square = [len(row) == len(rows) for row in rows if isinstance(row, list)]
        if rows and len(square) == len(rows) and all(square):
            return all(rows[i][j] == (i == j) for i in range(len(rows)) for j in range(len(rows)))
        return all(_is_neutral(key, item) for item in rows)
    is_factor = re.search("scale|aspect|unit", key, re.IGNORECASE) is not None
    return value == (1 if is_factor else 0) or (isinstance(value, float) and math.isnan(value))
