"""Label images of a log's frames in a folder: ``NNNNNN.png`` (uint8 class ids), each named by the number of its frame.

``labels.json`` next to them holds the classes, as in a sequence folder, and may name the log. A folder without it is in
the classes of the log. Pixels of the ignore id are not labelled: strokes are a label image, too.
"""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, FrameError, LabelError, LogError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.replay.importers.base import BadFrameError, read_label
from semantic_mapper.replay.importers.folder import read_label_set
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.replay.run_folder import prepare_folder
from semantic_mapper.types import PosedFrame, UInt8

LABELS_FILE = "labels.json"
MAX_CLASSES_BYTES = 1 << 16  # of a text file of names


class LogIdentity(msgspec.Struct, frozen=True):
    """Which log label images are of."""

    name: str  # of its file, for people; a log may be renamed
    frames: int
    digest: str  # of the stamps, cameras and poses of its first, middle and last frame


class _NamedLog(msgspec.Struct):
    log: LogIdentity | None = None


def log_identity(log: Log) -> LogIdentity:
    """What tells a log from others, also from one that was made with the same stamps."""
    found = hashlib.sha256()
    for number in sorted({0, len(log) // 2, len(log) - 1}):
        try:
            frame = log.frame(number)
        except (LogError, FrameError):
            found.update(b"damaged")
            continue
        found.update(f"{number} {frame.camera_id} {frame.stamp_ns} ".encode())
        found.update(np.ascontiguousarray(frame.T_world_camera).tobytes())
    return LogIdentity(log.path.name, len(log), found.hexdigest()[:16])


@dataclass(frozen=True, slots=True)
class LabelFolder:
    """A folder of label images of one log, and their classes."""

    path: Path
    label_set: LabelSet

    def numbers(self) -> list[int]:
        """Numbers of the frames that have a label image, ascending."""
        return sorted(self._files())

    def labelled(self, frame: PosedFrame, number: int) -> PosedFrame:
        """A frame, by its number in the log, with its label image in place of its own; errors as of ``read``."""
        label = self.read(number, (frame.intrinsics.height, frame.intrinsics.width))
        return replace(frame, label=label, label_is_pseudo=False)

    def read(self, number: int, size: tuple[int, int]) -> UInt8:
        """Label image (H, W) of a frame; ``LogError`` where it is missing or damaged, of another size or classes."""
        file = self._files().get(number)
        if file is None:
            raise LogError(f"{self.path}: has no label image of frame {number}, {number:06d}.png")
        try:
            return read_label(file, self.label_set, size)
        except BadFrameError as error:
            raise LogError(str(error)) from error

    def write(self, number: int, label: UInt8) -> None:
        """Write the label image (H, W) of a frame, whole or not at all; one without a labelled pixel is removed.

        Raises LabelError: an id that is no class. LogError: it cannot be written.
        """
        channels = self.label_set.to_channels(label, f"label image of frame {number}")
        there = self._files().get(number, self.path / f"{number:06d}.png")
        try:
            if (channels >= 0).any():
                write_bytes(there, cv2.imencode(".png", np.ascontiguousarray(label))[1].tobytes())
            else:
                there.unlink(missing_ok=True)
        except OSError as error:
            raise LogError(f"{there}: cannot be changed: {error.strerror or error}") from error

    def _files(self) -> dict[int, Path]:
        files = sorted(self.path.glob("*.png"))
        return {int(file.stem): file for file in files if file.stem.isascii() and file.stem.isdigit()}


def open_label_folder(path: Path, log: Log) -> LabelFolder:
    """Label images of a log's frames, to be read.

    Raises LabelError: nobody knows what they mean. LogError: they are missing, or of another log, or of frames that it
    does not have. ImportSourceError: an invalid labels.json.
    """
    label_set = log.info.label_set
    if (path / LABELS_FILE).exists():
        label_set = read_label_set(path / LABELS_FILE)
        _check_log(path, log)
    if label_set is None:
        raise LabelError(f"{path}: no labels.json says what its ids mean, and {log.path} has no classes; add the file")
    folder = LabelFolder(path, label_set)
    numbers = folder.numbers()
    if not numbers:
        raise LogError(f"{path}: has no label images; they are called by the number of their frame, 000012.png")
    if numbers[-1] >= len(log):
        raise LogError(f"{path}: has labels of frame {numbers[-1]}, and {log.path} has {len(log)} frames")
    return folder


def make_label_folder(path: Path, log: Log, label_set: LabelSet) -> LabelFolder:
    """A folder to write label images of a log to: a new one, or one with labels of the same log, to go on with.

    A folder that is there may have fewer classes than ``label_set``, with the same ids. Raises LogError: it holds
    labels of another log. ConfigError: it cannot be made. LabelError: it holds labels of other classes.
    ImportSourceError: its labels.json is invalid.
    """
    folder = LabelFolder(path, label_set)
    if (path / LABELS_FILE).exists():
        _check_log(path, log)
        there = read_label_set(path / LABELS_FILE)
        kept = set(zip(there.ids, there.names, strict=True)) <= set(zip(label_set.ids, label_set.names, strict=True))
        if folder.numbers() and (not kept or there.ignore_id != label_set.ignore_id):
            raise LabelError(
                f"{path}: holds labels of other classes ({', '.join(there.names)}; unknown is {there.ignore_id}); leave"
                " out --classes to go on with them, give classes that hold these with their ids, or another folder"
            )
    elif folder.numbers():
        raise LogError(f"{path}: has images, but no labels.json that says what they are; choose another folder")
    prepare_folder(path)
    data = plain_labels(label_set) | {"log": msgspec.to_builtins(log_identity(log))}
    write_bytes(path / LABELS_FILE, json.dumps(data, indent=1, ensure_ascii=False).encode(), raises=LogError)
    return folder


def read_classes(file: Path) -> LabelSet:
    """Classes from a file: a ``labels.json``, or a text with one name a line, whose ids are then 1, 2, 3, ...

    Raises ConfigError: no such file, or no text. ImportSourceError, LabelError: no classes.
    """
    if file.suffix == ".json":
        return read_label_set(file)
    try:
        lines = read_regular(file, MAX_CLASSES_BYTES).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read as a text of class names ({error})") from error
    names = [line.strip() for line in lines]
    return make_label_set(file.stem, [name for name in names if name and not name.startswith("#")])


def plain_labels(label_set: LabelSet) -> dict[str, Any]:
    """A label set as ``labels.json`` has it."""
    return {
        "id_space": label_set.name,
        "classes": {str(i): name for i, name in zip(label_set.ids, label_set.names, strict=True)},
        "ignore": label_set.ignore_id,
        "colors": {str(i): list(c) for i, c in zip(label_set.ids, label_set.colors, strict=True)},
    }


def _check_log(path: Path, log: Log) -> None:
    named = read_json(path / LABELS_FILE, _NamedLog).log
    here = log_identity(log)
    if named is not None and (named.frames, named.digest) != (here.frames, here.digest):
        raise LogError(f"{path}: holds labels of another log, {named.name} ({named.frames} frames); give that one")
