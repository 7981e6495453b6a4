"""What recordings hold next to their images: numbered files, rows of numbers, lists, and JSON of other programs."""

import json
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.files import decode_text
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import BadFrameError, check_frame_pose, read_bytes
from semantic_mapper.types import MAX_STAMP_NS, Float64

MAX_JSON_BYTES = 1 << 30  # hours of frames
MAX_NORM_ERROR = 0.1  # of a unit quaternion: files have few digits, and are normalised; more is no rotation
LEAST_PERIOD_NS = 100_000  # no camera is quicker: then stamps are in another unit
_NUMBER_LENGTH = 100  # letters

StructT = TypeVar("StructT", bound=msgspec.Struct)
ItemT = TypeVar("ItemT")
MadeT = TypeVar("MadeT")


def numbered_files(folder: Path, suffixes: tuple[str, ...], notices: list[str]) -> dict[int, Path]:
    """Files named by a number ("000017.jpg", "17.png", "frame-000017.color.jpg") by that number, in its order.

    Of several numbers the first one counts, unless the last one tells more files apart ("cam0_000017.png"). ``notices``
    gets a sentence on files that are left out. A folder that is missing has none.
    """
    found: dict[int, Path] = {}
    left_out: list[str] = []
    files = [file for file in folder.iterdir() if file.name.lower().endswith(suffixes)] if folder.is_dir() else []
    numbers = {file: [int(n) for n in re.findall(r"\d{1,18}", file.stem)] for file in sorted(files)}
    which = max((0, -1), key=lambda place: len({of[place] for of in numbers.values() if of}))
    for file, of in numbers.items():
        if not of or of[which] in found:
            left_out.append(file.name)
        else:
            found[of[which]] = file
    notices += left_out_notice("file", left_out, f"in {folder}, without a number, or with that of another file")
    return dict(sorted(found.items()))


def left_out_notice(kind: str, left_out: Sequence[str], why: str = "") -> list[str]:
    """A sentence on things that are left out, with the first of them; empty without any."""
    what = f"{counted(len(left_out), kind)} left out{', ' + why if why else ''}"
    return [f"{what}; the first: {left_out[0]}"] if left_out else []


def keep_good(
    make: Callable[[ItemT], MadeT], items: Iterable[ItemT], kind: str, notices: list[str], why: str = ""
) -> list[MadeT]:
    """What is made of each item; ``notices`` gets a sentence on those that cannot be used, as ``left_out_notice``."""
    made: list[MadeT] = []
    left_out: list[str] = []
    for item in items:
        try:
            made.append(make(item))
        except ImportSourceError as error:
            left_out.append(str(error))
    notices += left_out_notice(kind, left_out, why)
    return made


def without_picture(kind: str, numbers: Iterable[int], pictures: Iterable[int], where: Path) -> list[str]:
    """A sentence on poses or the like whose picture is missing; empty where all are there."""
    missing = [f"number {number}" for number in sorted({*numbers} - {*pictures})]
    return left_out_notice(kind, missing, f"without a picture in {where}")


def inside(folder: Path, name: str) -> Path:
    """A file that a recording names. Links of the user's own are followed.

    Raises ImportSourceError: the name leads out of the folder.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise ImportSourceError(
            f"{folder}: names '{name[:80]}', which lies outside of it; move the file into the folder, or link it there"
        )
    if "\\" in name and not (folder / name).exists():  # as Windows' programs part folders
        return inside(folder, name.replace("\\", "/"))
    return folder / name


def read_lines(file: Path) -> list[tuple[int, str]]:
    """Lines of a text file that are not empty and no comment, with their numbers from 1.

    Raises ImportSourceError: missing, or not text.
    """
    try:
        lines = decode_text(read_bytes(file)).splitlines()
    except UnicodeDecodeError as error:
        raise ImportSourceError(f"{file}: is not a text file: {error}") from error
    return [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]


def read_rows(file: Path, count: int) -> list[tuple[int, str]]:
    """Rows of a file whose i-th row belongs to the i-th of ``count`` images, with their lines.

    A header does not count. An empty line or a comment between the rows is a row without text, unless there are as many
    rows without these as images. Raises ImportSourceError: missing, or not text.
    """
    rows = read_lines(file)
    if len(rows) > count and not any(map(_is_number, split_row(rows[0][1]))):
        rows = rows[1:]
    if len(rows) == count or not rows:
        return rows
    between = rows[-1][0] - rows[0][0] + 1 - len(rows)
    if 2 * between >= len(rows):  # each second line is empty
        return rows
    texts = dict(rows)
    return [(line, texts.get(line, "")) for line in range(rows[0][0], rows[-1][0] + 1)]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def split_row(text: str) -> list[str]:
    """Words of a row: between spaces, tabs, commas or semicolons, in brackets or without."""
    return re.split(r"\s*[,;]\s*|\s+", text.strip().strip("[]()").strip(" ,;"))


def read_numbers(text: str) -> list[float]:
    """Numbers of a row. Raises ValueError: a word is no number, or there are no words."""
    if not text.strip():
        raise ValueError("is empty or a comment")
    return [float(word) for word in split_row(text)]


def read_matrix(file: Path) -> Float64:
    """A 4x4 (or 3x3, then padded) matrix as text. Raises BadFrameError: missing, or not such a matrix."""
    try:
        numbers = [number for _, line in read_lines(file) for number in read_numbers(line)]
    except ValueError as error:
        raise BadFrameError(file, f"holds something that is no number: {error}") from error
    if len(numbers) not in (9, 16):
        raise BadFrameError(file, f"expected the 16 numbers of a 4x4 matrix, got {len(numbers)}")
    side = 3 if len(numbers) == 9 else 4
    matrix = np.eye(4)
    matrix[:side, :side] = np.array(numbers, np.float64).reshape(side, side)
    return matrix


def read_pose_rows(file: Path, pictures: Collection[int]) -> dict[int, Float64 | BadFrameError]:
    """Poses (4, 4) of numbered pictures, or why one is missing, by a file whose i-th row, 16 numbers, is of picture i.

    Raises ImportSourceError: missing, not text, or without a row.
    """
    rows = read_rows(file, max(pictures, default=-1) + 1)
    if not rows:
        raise ImportSourceError(f"{file}: holds no pose")
    why = f"has {len(rows)} rows, and row i belongs to image i, from 0: no pose for image"
    found: dict[int, Float64 | BadFrameError] = {n: BadFrameError(file, f"{why} {n}") for n in pictures}
    for number, (line, text) in enumerate(rows):
        try:
            values = np.array(read_numbers(text), np.float64)
            if values.size != 16:
                raise ValueError(f"expected 16 numbers (4x4, row by row), got {values.size}")
            found[number] = check_frame_pose(values.reshape(4, 4), file, line)
        except BadFrameError as error:
            found[number] = error
        except ValueError as error:
            found[number] = BadFrameError(file, f"line {line}: {error}")
    return found


def seconds_to_ns(text: str) -> int:
    """Seconds as text -> nanoseconds, exactly (a float would lose them), in any form of a number.

    Raises ValueError: no number, or too large for a stamp.
    """
    with suppress(InvalidOperation):  # of what is no number, and of NaN when it is compared
        seconds = Decimal(text.strip() if len(text) <= _NUMBER_LENGTH else "NaN")
        if 0 <= seconds < MAX_STAMP_NS // 1_000_000_000:
            return int(seconds.scaleb(9))
    raise ValueError(
        f"'{text[:40]}' is not a time in seconds (0 to {MAX_STAMP_NS // 1_000_000_000}); divide nanoseconds by 1e9"
    )


def read_stamps(file: Path, count: int, hz: float, notices: list[str]) -> Sequence[int | BadFrameError]:
    """Stamps (ns) of ``count`` images, or why one has none, by a file whose i-th row belongs to image i.

    Rows hold nanoseconds, or all of them seconds (with a point), or date and time. Without the file stamps are made up
    at ``hz``. Raises ImportSourceError: fewer rows than images, or times that cannot be in nanoseconds.
    """
    if not file.exists():
        notices.append(f"no {file}: stamps are made up at {hz:g} frames a second")
        return [round(number * 1e9 / hz) for number in range(count)]
    rows = [(line, text.strip()) for line, text in read_rows(file, count)]
    if len(rows) < count:
        raise ImportSourceError(f"{file}: needs a stamp for each of {count} frames, has {len(rows)} rows")
    forms = ((r":", _date_to_ns), (r"\.|\d[eE]", seconds_to_ns), (r"", _whole_ns))
    to_ns = next(to_ns for form, to_ns in forms if any(re.search(form, text) for _, text in rows))
    stamps: list[int | BadFrameError] = []
    for line, text in rows[:count]:
        try:
            stamps.append(to_ns(text))
        except ValueError as error:
            stamps.append(BadFrameError(file, f"line {line}: {error}"))
    good = [stamp for stamp in stamps if not isinstance(stamp, BadFrameError)]
    if len(good) > 1 and 0 < np.median(np.diff(good)) < LEAST_PERIOD_NS:
        raise ImportSourceError(
            f"{file}: frames are {np.median(np.diff(good)):g} ns apart; whole numbers are nanoseconds: write seconds "
            "with a point (1.0), or convert milliseconds"
        )
    return stamps


def _date_to_ns(text: str) -> int:
    """Of 2013-05-28 08:46:02.904547200, say."""
    return int(np.datetime64(text.replace(" ", "T") or "none", "ns").astype(np.int64))


def _whole_ns(text: str) -> int:
    if not text.isdecimal() or int(text) > MAX_STAMP_NS:
        raise ValueError(f"'{text[:40]}' is not a time from 0 to {MAX_STAMP_NS} ns; write capture times")
    return int(text)


def read_plain_json(file: Path, kind: type[Any] = dict) -> Any:
    """JSON of another program, as plain data: a ``dict`` or ``list``. NaN, which Python's programs write, becomes None.

    Raises ImportSourceError: missing, no JSON, or too large.
    """
    try:
        plain = json.loads(decode_text(read_bytes(file, MAX_JSON_BYTES)), parse_constant=lambda _: None)
    except (ValueError, RecursionError) as error:
        raise ImportSourceError(f"{file}: not valid JSON: {error}") from error
    if not isinstance(plain, kind):
        raise ImportSourceError(f"{file}: holds no JSON {'list' if kind is list else 'object'}")
    return plain


def convert_known(plain: Any, kind: type[StructT], where: object) -> StructT:
    """Plain data -> struct; keys that the struct does not have are left out.

    Raises ImportSourceError: a key is missing or of another type.
    """
    try:
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError as error:
        raise ImportSourceError(f"{where}: {error}") from error


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


def unknown_notice(
    file: Path, tables: Iterable[Mapping[str, Any]], kind: type[msgspec.Struct], known: Sequence[str] = ()
) -> list[str]:
    """A sentence on keys that nothing here reads although they change what other numbers mean; empty without any.

    The tables are of one kind, such as the frames of a recording; ``known`` are keys that are known to change nothing.
    """
    read = {*(item.encode_name for item in msgspec.structs.fields(kind)), *known}
    found: set[str] = set()
    for table in tables:
        found.update(key for key in table.keys() - read - found if _tells(key, table[key]))
    if not found:
        return []
    names = ", ".join(f"'{key[:40]}'" for key in sorted(found)[:8])
    return [f"{file}: not read: {names}; what it says of lens, axes, unit or time is lost"]


def _tells(key: str, value: Any) -> bool:
    """Whether a key, by its name and its value, changes what other numbers mean."""
    if _TELLING.search(key) is not None and not _is_neutral(key, value):
        return True
    return isinstance(value, Mapping) and any(_tells(*item) for item in cast("Mapping[str, Any]", value).items())


def refuse_keys(table: Mapping[str, Any], names: re.Pattern[str], where: object) -> None:
    """Refuse keys that nothing here reads and that change what other numbers mean.

    Raises ImportSourceError: one of them is there and not neutral.
    """
    for key, value in table.items():
        if names.fullmatch(key) and not _is_neutral(key, value):
            raise ImportSourceError(
                f"{where}: '{key[:40]}' is not read; undistort the images first, or convert the poses, and leave it out"
            )


def _is_neutral(key: str, value: Any) -> bool:
    """Whether a value says that nothing is changed."""
    if isinstance(value, str):
        return value.strip().lower() in _NEUTRAL_WORDS and not _AXES.search(key)
    if isinstance(value, Mapping):
        return all(_is_neutral(key, item) for item in cast("Mapping[str, Any]", value).values())
    if isinstance(value, list):
        identity = value in (np.eye(3).tolist(), np.eye(4).tolist())
        return identity or all(_is_neutral(key, item) for item in cast("list[Any]", value))
    is_factor = re.search("scale|aspect|unit", key, re.IGNORECASE) is not None
    return value is None or value == (1 if is_factor else 0)
