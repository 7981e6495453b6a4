"""The sequence-folder layout.

``color/NNNNNN.jpg|png``, ``depth/NNNNNN.png`` (uint16), ``label/NNNNNN.png`` (uint8) with ``labels.json``,
``poses.txt`` (a row of 16 numbers a frame, row-major ``T_world_camera``), ``intrinsics.json`` (width height fx fy cx
cy; of images that are not rectified, distortion: OpenCV's coefficients, with ``"fisheye": true`` those of its fisheye
model; unless depth is in millimetres, depth_scale: units per metre;
``"scale": "unknown"`` where poses are not in metres), and, if there is one, ``timestamps.txt`` (a row a
frame: int nanoseconds, or seconds with a point). A frame without a depth image comes without depth.

``export`` also writes ``pseudo_label/NNNNNN.png``, labels that weights have rendered, and ``computed_depth/NNNNNN.png``
with its one-sigma spread in ``depth_sigma/NNNNNN.png``: they come back with that mark, for frames without the other.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from semantic_mapper.config import read_json
from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError, LabelError
from semantic_mapper.labels import MAX_NAME, PROVIDED, LabelSet, make_label_set
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    PICTURES,
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    Skipped,
    check_frame_pose,
    convert_known,
    depth_files,
    first_size,
    image_size_must_be,
    numbered_files,
    read_depth_if_there,
    read_label,
    read_numbers,
    read_plain_json,
    read_rgb,
    read_rows,
    seconds_to_ns,
    unknown_keys,
    unknown_notice,
)
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import MAX_STAMP_NS, CameraIntrinsics, Float64, PosedFrame

PSEUDO_LABEL, COMPUTED_DEPTH, DEPTH_SIGMA = "pseudo_label", "computed_depth", "depth_sigma"  # folders
LEAST_PERIOD_NS = 100_000  # no camera is quicker: then stamps are in another unit
DEFAULT_HZ = 6.0  # of a recording without timestamps.txt
DEPTH_SCALE = DepthScale(1000.0, convention="millimetres; another one belongs into intrinsics.json as depth_scale")


class _Intrinsics(msgspec.Struct):
    fx: float
    fy: float
    cx: float
    cy: float
    width: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None  # None = that of the first image
    height: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None
    distortion: tuple[float, ...] | None = None  # OpenCV's coefficients, by the names that programs give them
    dist_coeffs: tuple[float, ...] | None = None
    distortion_coefficients: tuple[float, ...] | None = None
    coeffs: tuple[float, ...] | None = None
    D: tuple[float, ...] | None = None
    fisheye: bool = False  # of its fisheye model
    camera_model: str | None = None  # the lens, by its name, however the key is called
    distortion_model: str | None = None
    lens_model: str | None = None
    model: str | None = None
    depth_scale: Annotated[float, Meta(gt=0, le=1e6)] | None = None  # units per metre; None = the format's convention
    scale: str = ""  # "unknown" where poses are not in metres


class _Labels(msgspec.Struct):
    classes: dict[str, str]
    id_space: str = ""
    colors: dict[str, tuple[int, int, int]] = msgspec.field(default_factory=dict)
    # The id that means unknown; null = none of those in the images. Missing: 0, as most data sets have it.
    ignore: Annotated[int, Meta(ge=0, le=255)] | msgspec.UnsetType | None = msgspec.UNSET


class FolderRecording:
    """A sequence folder, opened.

    Args:
        folder: Of the recording.
        options: See ``ImportOptions``.

    Raises:
        ImportSourceError: a file that concerns all frames is missing or cannot be understood.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self._folder = folder
        self._camera_id = options.camera_id
        self._color = numbered_files(folder / "color", PICTURES, self.notices)
        given_k, given, scale_known = read_intrinsics(
            folder / "intrinsics.json", self.notices, list(self._color.values())
        )
        self._measured, self._rectify = given_k, rectifier(given_k, folder / "intrinsics.json")
        self._intrinsics = self._rectify.intrinsics
        self.depth_scale = given or DEPTH_SCALE
        self._rows = read_rows(folder / "poses.txt", max(self._color, default=-1) + 1, self.notices)
        if not self._color:
            raise ImportSourceError(f"{folder / 'color'}: no images named by number (000000.jpg or .png)")
        if not self._rows:
            raise ImportSourceError(f"{folder / 'poses.txt'}: holds no pose")
        numbers = sorted({*self._color, *range(len(self._rows))})
        # An image that is missing is a bad frame, but thousands of poses with a few images are no bad frames.
        self._numbers = numbers if len(numbers) <= 2 * len(self._color) else sorted(self._color)
        poses_only = sum(number < len(self._rows) for number in numbers) - sum(
            n < len(self._rows) for n in self._numbers
        )
        if poses_only:
            missing = next(number for number in range(len(self._rows)) if number not in self._color)
            self.notices.append(
                f"{counted(poses_only, 'row')} of poses.txt without an image in {folder / 'color'}, the first for "
                f"image {missing}"
            )
        hz = options.frame_hz or DEFAULT_HZ
        self._stamps = self._read_stamps(hz)
        if max(self._color) >= len(self._rows) + len(self._color):
            raise ImportSourceError(
                f"{folder}: images are numbered up to {max(self._color)}, poses.txt has {len(self._rows)} rows; row i "
                "belongs to image i, counted from 0"
            )
        self._depth = depth_files(folder / "depth", options, self.depth_scale, self.notices)
        self._computed_depth = not options.without_depth
        labels = self._read_label_set()
        self._has_label = labels is not None and any((folder / name).is_dir() for name in ("label", PSEUDO_LABEL))
        self.info = StreamInfo(
            source=f"folder {folder.resolve().name}",
            cameras={options.camera_id: self._intrinsics},
            label_set=labels,
            frame_count=len(self._numbers),
            frame_hz=hz,
            metadata={} if scale_known else {SCALE_KEY: SCALE_UNKNOWN},
        )

    def __len__(self) -> int:
        return len(self._numbers)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        number = self._numbers[number]
        file = self._color.get(number, self._folder / "color" / f"{number:06d}.jpg")
        pose = self._pose(number)
        stamp_ns = self._stamps[number]
        if stamp_ns is None:
            raise BadFrameError(self._folder / "timestamps.txt", f"row {number + 1} is no time")
        rgb, encoded = read_rgb(file)
        image_size_must_be(rgb, self._measured, file)
        size = (self._measured.height, self._measured.width)
        depth, sigma = read_depth_if_there(self._depth.get(number), self.depth_scale, size), None
        if depth is None and self._computed_depth and self._image_of(file, COMPUTED_DEPTH).exists():
            depth = read_depth_if_there(self._image_of(file, COMPUTED_DEPTH), self.depth_scale, size)
            sigma = read_depth_if_there(self._image_of(file, DEPTH_SIGMA), self.depth_scale, size)
            if sigma is None:
                raise BadFrameError(self._image_of(file, DEPTH_SIGMA), "is missing: the spread of computed depth")
        label, label_error, pseudo = None, None, False
        if self._has_label and self.info.label_set is not None:
            label_file = self._image_of(file, "label")
            if not label_file.exists() and self._image_of(file, PSEUDO_LABEL).exists():
                label_file, pseudo = self._image_of(file, PSEUDO_LABEL), True
            try:
                label = read_label(label_file, self.info.label_set, size)
            except BadFrameError as error:
                label_error = Skipped(error.file, error.reason, number, label_only=True)
        nearest, bent = self._rectify.nearest, self._measured.distorted
        frame = PosedFrame(
            stamp_ns=stamp_ns,
            seq=number,
            camera_id=self._camera_id,
            rgb=self._rectify(np.ascontiguousarray(rgb[..., ::-1])) if bent else rgb,
            depth_m=None if depth is None else nearest(depth),
            label=None if label is None else nearest(label),
            intrinsics=self._intrinsics,
            T_world_camera=pose,
            depth_sigma_m=None if sigma is None else nearest(sigma),
            label_is_pseudo=pseudo and label is not None,
        )
        return LoadedFrame(frame, None if bent else encoded, label_error)

    def _image_of(self, color: Path, kind: str) -> Path:
        return self._folder / kind / f"{color.stem}.png"

    def _pose(self, number: int) -> Float64:
        file = self._folder / "poses.txt"
        if number >= len(self._rows):
            raise BadFrameError(file, f"has {len(self._rows)} rows and so no pose for image {number}")
        line, text = self._rows[number]
        try:
            values = np.array(read_numbers(text), np.float64)
        except ValueError as error:
            raise BadFrameError(file, f"line {line}: {error}") from error
        if values.size != 16:
            raise BadFrameError(file, f"line {line}: expected 16 numbers (4x4, row by row), got {values.size}")
        return check_frame_pose(values.reshape(4, 4), file, line)

    def _read_stamps(self, frame_hz: float) -> list[int | None]:
        """Of each frame; None = its row is no time."""
        file = self._folder / "timestamps.txt"
        count = self._numbers[-1] + 1
        if not file.exists():
            self.notices.append(f"no timestamps.txt: stamps are made up at {frame_hz:g} frames a second")
            return [round(i * 1e9 / frame_hz) for i in range(count)]
        rows = [text.strip().replace(",", ".") for _, text in read_rows(file, count, self.notices)]
        if len(rows) < count:
            raise ImportSourceError(f"{file}: needs a stamp for each of {count} frames, has {len(rows)} rows")
        whole = not any(re.fullmatch(r"\d*\.\d*|[\d.]+[eE][-+]?\d+", row) for row in rows)
        stamps: list[int | None] = []
        broken: list[str] = []
        for number, row in enumerate(rows[:count], 1):
            try:
                stamps.append(_whole_ns(row) if whole else seconds_to_ns(row))
            except ValueError as error:
                stamps.append(None)
                broken.append(f"row {number}: {error}")
        if 2 * len(broken) >= count:
            raise ImportSourceError(f"{file}: {broken[0]}")
        good = [(number, stamp) for number, stamp in enumerate(stamps, 1) if stamp is not None]
        back = next((n for (_, a), (n, b) in pairwise(good) if b <= a), 0)
        if back:
            raise ImportSourceError(
                f"{file}: row {back} is not later than the row before it; frames need rising stamps: sort the images, "
                "or fix the stamps"
            )
        (first, first_ns), (last, last_ns) = good[0], good[-1]
        if last > first and (last_ns - first_ns) / (last - first) < LEAST_PERIOD_NS:
            raise ImportSourceError(
                f"{file}: frames are {(last_ns - first_ns) / (last - first):g} ns apart; whole numbers are "
                "nanoseconds: write seconds with a point (1.0), or convert milliseconds"
            )
        return stamps

    def _read_label_set(self) -> LabelSet | None:
        file = self._folder / "labels.json"
        if not file.exists():
            if (self._folder / "label").is_dir():
                self.notices.append("label/ is left out: labels.json, which names its classes, is missing")
            return None
        return read_label_set(file, self.notices)


def _whole_ns(row: str) -> int:
    """Raises: ValueError: no whole number, or too large for a stamp."""
    if not row.isdecimal() or int(row) > MAX_STAMP_NS:
        raise ValueError(f"'{row[:40]}' is not a time from 0 to {MAX_STAMP_NS} ns; write capture times")
    return int(row)


def read_label_set(file: Path, notices: list[str] | None = None) -> LabelSet:
    """``labels.json`` -> label set; one that says nothing else is called as its folder.

    Args:
        file: To read.
        notices: Gets a sentence on what had to be assumed of the id that means unknown.

    Raises:
        ImportSourceError: missing, or no label set.
    """
    try:
        labels = read_json(file, _Labels)
        label_set = label_set_from(labels, file.resolve().parent.name)
        if notices is not None:
            notices += _ignore_notices(labels, label_set, file)
        return label_set
    except ConfigError as error:
        raise ImportSourceError(str(error)) from error
    except (LabelError, ValueError) as error:
        raise ImportSourceError(f"{file}: {error}") from error


def _ignore_notices(labels: _Labels, label_set: LabelSet, file: Path) -> list[str]:
    if labels.ignore is None:
        return [f"{file}: has no ignore id; {label_set.ignore_id}, which is no class, stands for unknown"]
    name = labels.classes.get("0")
    if labels.ignore is msgspec.UNSET and name is not None:
        return [
            f"{file}: names no ignore id, so class 0 '{name}' is read as unknown; where it is a class, "
            'write "ignore": null'
        ]
    return []


def rectifier(measured: CameraIntrinsics, file: Path) -> Rectifier:
    """What undoes a lens that a file tells.

    Raises:
        ImportSourceError: it leaves no image.
    """
    try:
        return Rectifier(measured)
    except ConfigError as error:
        raise ImportSourceError(f"{file}: {error}") from error


def read_intrinsics(
    file: Path, notices: list[str], pictures: Sequence[Path]
) -> tuple[CameraIntrinsics, DepthScale | None, bool]:
    """``intrinsics.json`` -> intrinsics, the scale of depth images where given, and whether poses are in metres.

    Args:
        file: To read.
        notices: Gets a sentence on keys that are not read.
        pictures: The first that can be read tells the size where the file does not.

    Raises:
        ImportSourceError: missing, or a value that cannot be.
    """
    try:
        plain = read_plain_json(file, 1 << 20)
        i = convert_known(plain, _Intrinsics, str(file))
        notices += unknown_notice(file, unknown_keys([plain], _Intrinsics))
        if i.depth_scale is not None and i.depth_scale < 1:
            raise ImportSourceError(
                f"{file}: depth_scale {i.depth_scale:g} is no number of units per metre; where it is metres per unit, "
                f"write {1 / i.depth_scale:g}"
            )
        scale = DepthScale(i.depth_scale, file) if i.depth_scale is not None else None
        lenses = (i.distortion, i.dist_coeffs, i.distortion_coefficients, i.coeffs, i.D)
        coefficients = next((lens for lens in lenses if lens), ())
        size = (i.width, i.height) if i.width and i.height else first_size(pictures)
        if size is None:
            raise ImportSourceError(f"{file}: has no width and height, and no image that tells them")
        named = i.camera_model or i.distortion_model or i.lens_model or i.model or "opencv"
        model = "fisheye" if i.fisheye else named
        lens = lens_intrinsics(model, coefficients, (i.fx, i.fy, i.cx, i.cy), (int(size[0]), int(size[1])))
        return lens, scale, i.scale != SCALE_UNKNOWN
    except (ConfigError, FrameError) as error:
        raise ImportSourceError(f"{file}: {error}") from error


def label_set_from(labels: _Labels, folder_name: str) -> LabelSet:
    """Label set of a recording: its own ids, names and colours; those of a known set where it draws its ids from one.

    Raises:
        LabelError, ValueError: ids that are no numbers of 0 to 255, a class twice, or colours beyond 255.
    """
    if any(not 0 <= value <= 255 for color in labels.colors.values() for value in color):
        raise ValueError("colors must be three numbers of 0 to 255")
    classes = {int(key): name for key, name in labels.classes.items()}
    ignore_id = 0 if labels.ignore is msgspec.UNSET else labels.ignore
    if ignore_id is not None:
        classes.pop(ignore_id, None)
    ids = sorted(classes)
    name = labels.id_space.lower() or folder_name[:MAX_NAME]
    own = make_label_set(name, [classes[i] for i in ids], ids=ids, ignore_id=ignore_id)
    known = PROVIDED.get(name)
    chosen = {} if known is None else dict(zip(known.ids, known.colors, strict=True))
    chosen |= {int(key): color for key, color in labels.colors.items()}
    colors = tuple(chosen.get(i, color) for i, color in zip(ids, own.colors, strict=True))
    return LabelSet(own.name, own.ids, own.names, colors, own.ignore_id)
