"""The frames of a film, or the pictures of a folder, in their order, with times; which of them are worth a look: sharp
ones, a step of motion apart; their features; and what a log keeps of its film."""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.files import numeric_order
from semantic_mapper.replay.log.reader import LogAttachment
from semantic_mapper.replay.sfm.between import track
from semantic_mapper.replay.sfm.gps import GpsPosition, read_exif, read_position
from semantic_mapper.types import Bool, Float32, Float64, Int64, UInt8

FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
MAX_SIDE_PX = 1280  # larger frames are made smaller: a map needs no more, and memory stays bounded
PICTURE_HZ = 2.0  # at which the pictures of a folder count as taken
MAX_FAILED = 1000  # reads one after the other: films may announce any number of frames
DEFAULT_HZ = 30.0  # of a film that tells neither times nor a rate
_TURNS = (None, cv2.ROTATE_90_CLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_COUNTERCLOCKWISE)
# EXIF's directory of the camera; its FocalLengthIn35mmFilm; the diagonal of such a picture in mm
_CAMERA, _FOCAL_35MM, _DIAGONAL_35MM = 0x8769, 0xA405, 43.27


@dataclass(frozen=True, slots=True, eq=False)
class FilmFrame:
    """One decoded frame."""

    index: int  # counts from 0 over all frames of the film, good and bad
    stamp_ns: int  # time within the film; rises
    bgr: UInt8  # (H, W, 3), upright as the film's rotation mark says, at most ``MAX_SIDE_PX`` wide and high


class Film:
    """A film, or a folder of pictures by the numbers in their names; may be read several times, with the same result.

    Frames are turned clockwise by ``quarters``, on top of what the film's own rotation mark says. Raises
    ImportSourceError: missing, no film that OpenCV can decode, or no pictures.
    """

    def __init__(self, path: Path, quarters: int = 0) -> None:
        self.path = path
        self.odd_pictures: dict[Path, str] = {}  # of a folder: those that cannot be read or have another size, and why
        self.count = 0  # about how many frames there are; films may tell a wrong number
        self.unread = 0  # of a film that was read to its end: announced frames that cannot be decoded, or are not there
        self.hz = PICTURE_HZ
        self._turn = _TURNS[quarters % 4]
        self._pictures = pictures_of(path) if path.is_dir() else []
        if path.is_dir() and not self._pictures:
            raise ImportSourceError(f"{path}: no pictures in it ({', '.join(PICTURE_SUFFIXES)})")
        if not path.exists():
            raise ImportSourceError(f"{path}: no such film or folder of pictures")
        first = next(self._decoded(), None)
        if first is None:
            raise ImportSourceError(f"{path}: holds no frame that can be decoded; copy or convert it again")
        index, _, bgr = first
        self.full_height, self.full_width = bgr.shape[:2]  # before they are made smaller
        ratio = min(1.0, MAX_SIDE_PX / max(bgr.shape[:2]))
        self.width, self.height = (max(1, round(side * ratio)) for side in (self.full_width, self.full_height))
        focal_px = focal_of_exif(self._pictures[index], bgr.shape[:2]) if self._pictures else None
        self.focal_px = None if focal_px is None else ratio * focal_px

    def position(self, index: int) -> GpsPosition | None:
        """Where a picture of a folder was taken by its EXIF data; None of a film, or where that tells nothing."""
        return read_position(self._pictures[index]) if self._pictures else None

    def __iter__(self) -> Iterator[FilmFrame]:
        """All frames from the first one; pictures that cannot be used are left out (``odd_pictures``)."""
        for index, stamp_ns, bgr in self._decoded():
            if self._pictures and bgr.shape[:2] != (self.full_height, self.full_width):
                size = f"is {bgr.shape[1]}x{bgr.shape[0]}, the first picture {self.full_width}x{self.full_height}"
                self.odd_pictures[self._pictures[index]] = size
                continue
            if bgr.shape[:2] != (self.height, self.width):
                bgr = cv2.resize(bgr, (self.width, self.height), interpolation=cv2.INTER_AREA)
            yield FilmFrame(index, stamp_ns, np.asarray(bgr, np.uint8))

    def _decoded(self) -> Iterator[tuple[int, int, UInt8]]:
        """Number, time in ns, and picture of each frame that can be decoded, in full size, upright."""
        for index, stamp_ns, bgr in self._decoded_pictures() if self._pictures else self._decoded_film():
            yield index, stamp_ns, np.asarray(bgr if self._turn is None else cv2.rotate(bgr, self._turn), np.uint8)

    def _decoded_pictures(self) -> Iterator[tuple[int, int, np.ndarray]]:
        self.count = len(self._pictures)
        for index, file in enumerate(self._pictures):
            bgr = cv2.imread(str(file), cv2.IMREAD_COLOR)  # turns it as its EXIF data says
            if bgr is None:
                self.odd_pictures[file] = "is damaged, or no picture that OpenCV can read"
            else:
                yield index, round(index * 1e9 / PICTURE_HZ), bgr

    def _decoded_film(self) -> Iterator[tuple[int, int, np.ndarray]]:
        last_ns, read, failed = -1, 0, 0
        capture = cv2.VideoCapture(str(self.path))
        try:
            if not capture.isOpened():
                raise ImportSourceError(
                    f"{self.path}: is no film that OpenCV can decode; is it complete? convert it to H.264 in mp4"
                )
            hz = capture.get(cv2.CAP_PROP_FPS)
            self.hz = hz if 0.01 < hz < 1000 else DEFAULT_HZ
            self.count = max(1, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
            for index in itertools.count():
                good, bgr = capture.read()
                if not good or bgr is None:
                    failed += 1
                    if index + 1 >= self.count or failed == MAX_FAILED:
                        self.unread = max(0, self.count - read)
                        return
                    continue  # behind a damaged frame may be good ones
                read, failed = read + 1, 0
                stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                if stamp_ns <= last_ns:  # containers without times
                    stamp_ns = last_ns + round(1e9 / self.hz)
                last_ns = stamp_ns
                yield index, stamp_ns, bgr
        finally:
            capture.release()


def pictures_of(folder: Path) -> list[Path]:
    """Pictures of a folder, or of its only sub-folder that has some, as people order them: 9 comes before 10.

    Raises ImportSourceError: they are of several kinds, as colour and depth are, which no film is.
    """
    files = _pictures_in(folder)
    if not files:
        below = [found for place in folder.iterdir() if place.is_dir() and (found := _pictures_in(place))]
        files = below[0] if len(below) == 1 else []
    numbers: dict[str, set[str]] = {}
    for file in files:
        numbers.setdefault(re.sub(r"\d+", "N", file.name), set()).add(re.sub(r"\D+", " ", file.stem).strip())
    for kind, of_kind in numbers.items():
        other = next((o for o, its in numbers.items() if o != kind and 2 * len(its & of_kind) > len(of_kind)), None)
        if other is not None:
            raise ImportSourceError(
                f"{files[0].parent}: holds two pictures of each number ({kind}, {other}), so it is no film, and no "
                "recording of a known format; write colour and depth as a sequence folder (docs/layouts.md), or "
                "give the pictures of the film a folder of their own"
            )
    return files


def _pictures_in(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES and file.is_file()]
    return sorted(files, key=lambda file: numeric_order(file.name))


def focal_of_exif(file: Path, sides_px: tuple[int, ...]) -> float | None:
    """Focal length in pixels by the EXIF data of a picture with these sides; None where it does not tell one."""
    focal_mm = read_exif(file, _CAMERA).get(_FOCAL_35MM, 0)
    if not isinstance(focal_mm, int | float) or not 5 <= focal_mm <= 1000:
        return None
    return float(focal_mm) * float(np.hypot(sides_px[0], sides_px[1])) / _DIAGONAL_35MM


LOOK_WIDTH = 320  # frames are looked at in this size
STEP = 0.04  # motion between two picked frames, of the image's width
LEAST_MOTION = 0.005  # ... below which two frames are one
EDGES = 0.75  # weight of what moves fast: straight ahead most of the picture hardly moves, and its edges pass by
MAX_PICKS = 400  # longer ways get longer steps
BLURRED = 0.5  # of the sharpness of the frames around: less is a blurred frame
AROUND_NS = 700_000_000  # either side
DARK, FLAT = 14.0, 5.0  # grey levels: mean and standard deviation of a frame that shows nothing
_CORNERS, _LEAST_TRACKED = 150, 12


@dataclass(frozen=True, slots=True, eq=False)
class FilmLook:
    """What the first pass over a film has found, a value for each of its N frames."""

    index: Int64  # (N,) number of the frame in the film
    stamp_ns: Int64  # (N,) rising
    motion: Float64  # (N,) since the frame before, of the image's width: median of what is followed; NaN = nothing is
    # (N,) the same of what moves most: 85th percentile. Without rotation, a camera moving sideways has about 1.25 times
    # the median, one moving straight ahead 2 to 3 times.
    fast: Float64
    sharpness: Float64  # (N,) RMS of the Laplacian over the contrast, to be compared with frames nearby only
    dark: Bool  # (N,) whether it shows nothing: black, covered, or one colour

    @property
    def blurred(self) -> Bool:
        """(N,) much less sharp than the frames around it."""
        found = np.zeros(len(self.index), np.bool_)
        for i, stamp in enumerate(self.stamp_ns):
            low, high = np.searchsorted(self.stamp_ns, (stamp - AROUND_NS, stamp + AROUND_NS))
            low, high = min(low, max(0, i - 2)), max(high, min(len(self.index), i + 3))  # slow films, too
            found[i] = self.sharpness[i] < BLURRED * np.median(self.sharpness[low:high])
        return found & ~self.dark

    @property
    def way(self) -> Float64:
        """(N,) motion since the first frame; one that could not be followed counts as a whole step."""
        return np.cumsum(np.nan_to_num(np.maximum(self.motion, EDGES * self.fast), nan=STEP))


def look_through(film: Film, on_frame: Callable[[int], None]) -> FilmLook:
    """Read a film once; ``on_frame`` gets the number of frames read."""
    rows: list[tuple[int, int, float, float, float, bool]] = []
    last: UInt8 | None = None
    height = max(1, round(LOOK_WIDTH * film.height / film.width))
    for frame in film:
        gray = np.asarray(cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        small = np.asarray(cv2.resize(gray, (LOOK_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
        dark = bool(small.mean() < DARK and small.std() < 2 * FLAT) or bool(small.std() < FLAT)
        motion, fast = (0.0, 0.0) if last is None else _motion(last, small)
        rows.append((frame.index, frame.stamp_ns, motion, fast, _sharpness(gray), dark))
        last = small
        on_frame(len(rows))
    columns = zip(*rows, strict=True) if rows else ((),) * 6
    kinds: tuple[Any, ...] = (np.int64, np.int64, np.float64, np.float64, np.float64, np.bool_)
    return FilmLook(*(np.array(column, kind) for column, kind in zip(columns, kinds, strict=True)))


def pick_frames(look: FilmLook, step: float = STEP, most: int = MAX_PICKS) -> Int64:
    """Rows of ``look`` for structure from motion: of each step of motion the sharpest frame, at most about ``most``."""
    usable = np.flatnonzero(~look.dark & ~look.blurred)
    if not len(usable):
        return usable
    way = look.way[usable]
    step = max(step, float(way[-1] - way[0]) / most)
    window = np.floor((way - way[0]) / step).astype(np.int64)
    order = np.lexsort((usable, -look.sharpness[usable], window))
    first = np.concatenate(([True], np.diff(window[order]) > 0))
    return np.sort(usable[order[first]])


def _sharpness(gray: UInt8) -> float:
    """RMS of the Laplacian over the contrast: a darker frame is not less sharp."""
    return float(cv2.Laplacian(gray, cv2.CV_32F).std()) / max(float(gray.std()), 1.0)


def _motion(last: UInt8, now: UInt8) -> tuple[float, float]:
    """Median and 85th percentile of the motion of corners, of the width; NaN where they cannot be followed."""
    corners = cv2.goodFeaturesToTrack(last, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _LEAST_TRACKED:
        return float("nan"), float("nan")
    moved, true = track(last, now, corners, window=(15, 15), levels=3)
    if true.sum() < _LEAST_TRACKED:
        return float("nan"), float("nan")
    median, fast = np.percentile(np.linalg.norm(moved - corners, axis=2)[true, 0], (50, 85)) / now.shape[1]
    return float(median), float(fast)


MOST_FEATURES = 2500
_CONTRAST = 0.02  # half of OpenCV's default: walls of rooms have little


def find_features(bgr: UInt8) -> tuple[Float32, UInt8]:
    """SIFT's pixels (N, 2) float32, centres of pixels being integers, and descriptors (N, 128) uint8 (square roots)."""
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES, contrastThreshold=_CONTRAST)
    keypoints, found = sift.detectAndCompute(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), None)
    if found is None or not len(keypoints):
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
    xy = np.array([k.pt for k in keypoints], np.float32)[:MOST_FEATURES]
    rows = np.asarray(found, np.float32)[:MOST_FEATURES]
    rooted = np.sqrt(rows / np.maximum(rows.sum(axis=1, keepdims=True), 1e-9))
    return xy, np.clip(np.round(512 * rooted), 0, 255).astype(np.uint8)


FILM_ATTACHMENT = "film.json"


class FilmNote(msgspec.Struct, frozen=True):
    """How a film became a log."""

    frames: int  # of the film
    left_out: dict[str, int]  # of these, not in the log, by reason
    picked: int  # frames that structure from motion was given
    registered: int  # ... and has registered
    error_px: float  # mean reprojection error
    focal_px: float  # in pixels of the film

    def attachment(self) -> LogAttachment:
        """As it stands in the log."""
        return LogAttachment(FILM_ATTACHMENT, "application/json", msgspec.json.encode(self))


def read_left_out(attachments: Mapping[str, LogAttachment]) -> int:
    """Frames of the film that are not in the log; 0 for a log that was not made of a film."""
    kept = attachments.get(FILM_ATTACHMENT)
    if kept is None:
        return 0
    try:
        return sum(msgspec.json.decode(kept.data, type=FilmNote).left_out.values())
    except msgspec.MsgspecError:  # somebody else's file of this name
        return 0
