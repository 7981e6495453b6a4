"""Logs as folders of images: the sequence folder that ``import`` reads, TUM RGB-D, and TUM's trajectory file alone."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.replay.exporters.base import ExportFrame, LeftOut, quaternion
from semantic_mapper.replay.importers.folder import COMPUTED_DEPTH, DEPTH_SIGMA, PSEUDO_LABEL
from semantic_mapper.replay.importers.tum import DEPTH_SCALE
from semantic_mapper.replay.label_folder import plain_labels
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, PosedFrame

TUM_UNITS_PER_M = DEPTH_SCALE.units_per_m
_SUFFIX = {"jpeg": "jpg", "png": "png", "raw": "png"}
_EXACT_M = 1e-6  # float32 has no more at the distances of a room


class FolderExporter:
    """The sequence folder (see ``replay/importers/folder.py``): the same frames come back from ``import``.

    Colour images keep the bytes of the log, depth its units, poses and stamps every digit. Numbers of frames are their
    places in the folder. Pseudo labels and computed depth lie in folders of their own, so that nobody takes them for
    labels of people and depth of a sensor.

    Args:
        folder: Is there, and empty.
        info: Of the log.
    """

    def __init__(self, folder: Path, info: StreamInfo) -> None:
        self.notices: list[str] = []
        self._folder = folder
        self._labels = info.label_set
        self._poses: list[str] = []
        self._stamps: list[int] = []
        self._depth = _DepthFiles(None)
        self._measured: set[str] = set()
        self._pseudo_labels = self._computed_depths = 0
        self._camera = _OneCamera(info.scale_known)

    def add(self, item: ExportFrame) -> None:
        """Write one frame. Raises LeftOut: its stamp does not rise, or its camera has changed."""
        frame = item.frame
        if self._stamps and frame.stamp_ns <= self._stamps[-1]:
            raise LeftOut("it is not later than the frame before it, which the layout needs")
        self._camera.check(frame)
        number = f"{len(self._poses):06d}"
        _write(self._folder / "color" / f"{number}.{_SUFFIX[item.rgb.encoding]}", item.rgb.data)
        name = f"{number}.png"
        if frame.depth_m is not None and frame.depth_sigma_m is not None:
            self._depth.write(self._folder / COMPUTED_DEPTH / name, frame.depth_m, item)
            self._depth.write(self._folder / DEPTH_SIGMA / name, frame.depth_sigma_m, item)
            self._computed_depths += 1
        elif frame.depth_m is not None:
            self._depth.write(self._folder / "depth" / name, frame.depth_m, item)
            self._measured.add(name)
        if frame.label is not None and self._labels is not None:
            _write_png(self._folder / (PSEUDO_LABEL if frame.label_is_pseudo else "label") / name, frame.label)
            self._pseudo_labels += frame.label_is_pseudo
        self._poses.append(" ".join(map(repr, frame.T_world_camera.ravel().tolist())))
        self._stamps.append(frame.stamp_ns)

    def finish(self) -> None:
        """Write what describes the images, and empty depth images where others have some: each has one or none."""
        (self._folder / "poses.txt").write_text("\n".join(self._poses) + "\n", encoding="ascii")
        (self._folder / "timestamps.txt").write_text("\n".join(map(str, self._stamps)) + "\n", encoding="ascii")
        self._camera.write(self._folder / "intrinsics.json", self._depth.scale)
        if self._labels is not None:
            text = json.dumps(plain_labels(self._labels), indent=1, ensure_ascii=False)
            (self._folder / "labels.json").write_text(text, encoding="utf-8")
        if self._pseudo_labels:
            self.notices.append(
                f"{self._pseudo_labels} label images are pseudo labels, which weights have rendered: they are in "
                f"{PSEUDO_LABEL}/, not in label/"
            )
        if self._computed_depths:
            self.notices.append(
                f"depth of {self._computed_depths} frames is computed, not a sensor's: it is in {COMPUTED_DEPTH}/, "
                f"with its spread in {DEPTH_SIGMA}/, not in depth/"
            )
        self.notices += self._depth.notices
        k = self._camera.value
        missing = {f"{number:06d}.png" for number in range(len(self._poses))} - self._measured
        if self._measured and missing and k is not None:
            for name in missing:
                _write_png(self._folder / "depth" / name, np.zeros((k.height, k.width), np.uint16))
            self.notices.append(
                f"{len(missing)} frames have no depth; their depth images are empty (0 = no measurement)"
            )
        self.notices += self._camera.notices


class TumExporter:
    """A TUM RGB-D sequence: ``rgb/``, ``depth/`` (5000 units a metre), their lists and ``groundtruth.txt``.

    In addition to what the data set has there is ``intrinsics.json``, which our import reads. Depth that was computed
    is left out, since readers would take it for a sensor's.

    Args:
        folder: Is there, and empty.
    """

    def __init__(self, folder: Path) -> None:
        self.notices: list[str] = []
        self._folder = folder
        self._names: dict[str, dict[int, str]] = {"rgb": {}, "depth": {}}  # by stamp
        self._trajectory = TrajectoryExporter(folder / "groundtruth.txt")
        self._depth = _DepthFiles(TUM_UNITS_PER_M)
        self._computed_depths = 0
        self._camera = _OneCamera()

    def add(self, item: ExportFrame) -> None:
        """Write one frame. Raises LeftOut: there is a frame of that time already, or its camera has changed."""
        frame = item.frame
        self._camera.check(frame)
        self._trajectory.add(item)
        stamp = _seconds(frame.stamp_ns)
        color = f"rgb/{stamp}.{_SUFFIX[item.rgb.encoding]}"
        _write(self._folder / color, item.rgb.data)
        self._names["rgb"][frame.stamp_ns] = f"{stamp} {color}"
        if frame.depth_sigma_m is not None:
            self._computed_depths += 1
        elif frame.depth_m is not None:
            self._depth.write(self._folder / "depth" / f"{stamp}.png", frame.depth_m, item)
            self._names["depth"][frame.stamp_ns] = f"{stamp} depth/{stamp}.png"

    def finish(self) -> None:
        """Write the lists."""
        titles = {"rgb": "# color images", "depth": "# depth maps, 5000 units a metre"}
        for name, lines in self._names.items():
            text = "\n".join((titles[name], "# timestamp filename", *(lines[stamp] for stamp in sorted(lines))))
            (self._folder / f"{name}.txt").write_text(text + "\n", encoding="ascii")
        self._trajectory.finish()
        self._camera.write(self._folder / "intrinsics.json", TUM_UNITS_PER_M)
        if self._computed_depths:
            self.notices.append(f"depth of {self._computed_depths} frames is computed, not a sensor's, and is left out")
        missing = len(self._names["rgb"]) - len(self._names["depth"])
        if missing:
            self.notices.append(f"{missing} frames have no depth; programs that pair the lists will leave them out")
        self.notices += self._depth.notices + self._camera.notices


class TrajectoryExporter:
    """Poses alone, a line ``stamp tx ty tz qx qy qz qw`` each, as ``evo`` and others read them.

    Args:
        path: Of the file.
        scale_known: Whether poses are in metres; a comment says where not.
    """

    def __init__(self, path: Path, scale_known: bool = True) -> None:
        self.notices: list[str] = []
        self._path = path
        self._lines: dict[int, str] = {}
        self._about = () if scale_known else (f"# {SCALE_KEY}: {SCALE_UNKNOWN}",)

    def add(self, item: ExportFrame) -> None:
        """Take the pose of one frame. Raises LeftOut: there is a frame of that time already."""
        frame = item.frame
        if frame.stamp_ns in self._lines:
            raise LeftOut("there is a frame of the same time already")
        numbers = (*frame.T_world_camera[:3, 3].tolist(), *quaternion(frame.T_world_camera).tolist())
        self._lines[frame.stamp_ns] = " ".join((_seconds(frame.stamp_ns), *map(repr, numbers)))

    def finish(self) -> None:
        """Write the file, in order of time."""
        rows = (self._lines[stamp] for stamp in sorted(self._lines))
        lines = (*self._about, "# timestamp tx ty tz qx qy qz qw", *rows)
        self._path.write_text("\n".join(lines) + "\n", encoding="ascii")


class _DepthFiles:
    """Depth images of one scale, and what they could not hold."""

    def __init__(self, scale: float | None) -> None:
        self._scale = scale
        self._inexact = 0
        self._largest_error = 0.0

    @property
    def scale(self) -> float:
        """Units a metre."""
        return self._scale or 1000.0

    @property
    def notices(self) -> list[str]:
        """For people."""
        if not self._inexact:
            return []
        return [
            f"depth of {self._inexact} frames is not exact in steps of 1/{self.scale:g} m: off by up to "
            f"{self._largest_error * 1e3:.3g} mm"
        ]

    def write(self, file: Path, depth_m: Float32, item: ExportFrame) -> None:
        """Write it as uint16, in the units of the log where none are given; what is too far away becomes 0."""
        self._scale = self._scale or item.depth_scale or None
        metres = np.nan_to_num(depth_m, posinf=0.0, neginf=0.0)
        units = np.rint(metres * np.float32(self.scale))
        held = np.where((units >= 0) & (units <= 65535), units, 0).astype(np.uint16)
        error = float(np.abs(held.astype(np.float32) / np.float32(self.scale) - metres).max(initial=0.0))
        self._inexact += error > _EXACT_M
        self._largest_error = max(self._largest_error, error)
        _write_png(file, held)


class _OneCamera:
    """The intrinsics that all frames of a folder share."""

    def __init__(self, scale_known: bool = True) -> None:
        self.value: CameraIntrinsics | None = None
        self._about = {} if scale_known else {SCALE_KEY: SCALE_UNKNOWN}

    @property
    def notices(self) -> list[str]:
        """For people."""
        bent = self.value is not None and any(self.value.distortion)
        return ["lens distortion is not in the files: undistort the images with the log's own"] if bent else []

    def check(self, frame: PosedFrame) -> None:
        """Take the first frame's."""
        self.value = self.value or frame.intrinsics
        if frame.intrinsics != self.value:
            raise LeftOut("its camera has other intrinsics than the first frame's, and the layout has but one")

    def write(self, file: Path, depth_scale: float) -> None:
        """Write them as ``import`` reads them."""
        if self.value is not None:
            plain = {name: getattr(self.value, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
            text = json.dumps({**plain, "depth_scale": depth_scale, **self._about}, indent=1)
            file.write_text(text, encoding="ascii")


def _write(file: Path, data: bytes) -> None:
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(data)


def _write_png(file: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """One channel, 8 or 16 bits; level 1, a third of the time for some more bytes."""
    _write(file, cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _seconds(stamp_ns: int) -> str:
    """Nanoseconds as seconds with nine places, exactly."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
