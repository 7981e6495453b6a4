"""Logs as folders of images: the sequence folder that ``import`` reads, TUM RGB-D, and TUM's trajectory file alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from semantic_mapper.replay.exporters.base import ExportFrame, LeftOut, depth_units, quaternion, seconds, write_png
from semantic_mapper.replay.importers.folder import COMPUTED_DEPTH, DEPTH_SIGMA, PSEUDO_LABEL
from semantic_mapper.replay.importers.tum import DEPTH_SCALE
from semantic_mapper.replay.label_folder import plain_labels
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, PosedFrame

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
        self._pseudo_labels = self._computed_depths = 0
        self._intrinsics = _OneCamera(info.scale_known)
        (folder / "color").mkdir()

    def add(self, item: ExportFrame) -> None:
        """Write one frame.

        Raises:
            LeftOut: its stamp does not rise, or its camera has changed.
        """
        frame = item.frame
        if self._stamps and frame.stamp_ns <= self._stamps[-1]:
            raise LeftOut("it is not later than the frame before it, which the layout needs")
        self._intrinsics.check(frame)
        number = len(self._poses)
        color = self._folder / "color" / f"{number:06d}.{_SUFFIX[item.rgb.encoding]}"
        color.write_bytes(item.rgb.data)
        name = f"{number:06d}.png"
        if frame.depth_sigma_m is None:
            self._depth.write(self._folder / "depth" / name, item)
        else:
            self._depth.write_computed(self._folder / COMPUTED_DEPTH / name, self._folder / DEPTH_SIGMA / name, item)
            self._computed_depths += 1
        if frame.label is not None and self._labels is not None:
            folder = self._folder / (PSEUDO_LABEL if frame.label_is_pseudo else "label")
            folder.mkdir(exist_ok=True)
            write_png(folder / name, frame.label)
            self._pseudo_labels += frame.label_is_pseudo
        self._poses.append(" ".join(map(repr, frame.T_world_camera.ravel().tolist())))
        self._stamps.append(frame.stamp_ns)

    def finish(self) -> None:
        """Write what describes the images."""
        self._depth.fill_in(self._folder / "depth", len(self._poses), self._intrinsics.value)
        (self._folder / "poses.txt").write_text("\n".join(self._poses) + "\n", encoding="ascii")
        (self._folder / "timestamps.txt").write_text("\n".join(map(str, self._stamps)) + "\n", encoding="ascii")
        self._intrinsics.write(self._folder / "intrinsics.json", self._depth.scale)
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
        self.notices += self._depth.notices + self._intrinsics.notices


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
        self._names: dict[str, list[str]] = {"rgb": [], "depth": []}
        self._trajectory = Trajectory()
        self._depth = _DepthFiles(TUM_UNITS_PER_M)
        self._computed_depths = 0
        self._intrinsics = _OneCamera()
        (folder / "rgb").mkdir()

    def add(self, item: ExportFrame) -> None:
        """Write one frame.

        Raises:
            LeftOut: there is a frame of that time already, or its camera has changed.
        """
        frame = item.frame
        self._intrinsics.check(frame)
        self._trajectory.add(item)
        stamp = seconds(frame.stamp_ns)
        color = f"rgb/{stamp}.{_SUFFIX[item.rgb.encoding]}"
        (self._folder / color).write_bytes(item.rgb.data)
        self._names["rgb"].append(f"{stamp} {color}")
        if frame.depth_sigma_m is not None:
            self._computed_depths += 1
        elif self._depth.write(self._folder / "depth" / f"{stamp}.png", item):
            self._names["depth"].append(f"{stamp} depth/{stamp}.png")

    def finish(self) -> None:
        """Write the lists."""
        titles = {"rgb": "# color images", "depth": "# depth maps, 5000 units a metre"}
        for name, lines in self._names.items():
            text = "\n".join((titles[name], "# timestamp filename", *sorted(lines, key=_by_stamp)))
            (self._folder / f"{name}.txt").write_text(text + "\n", encoding="ascii")
        self._trajectory.write(self._folder / "groundtruth.txt")
        self._intrinsics.write(self._folder / "intrinsics.json", TUM_UNITS_PER_M)
        if self._computed_depths:
            self.notices.append(f"depth of {self._computed_depths} frames is computed, not a sensor's, and is left out")
        missing = len(self._names["rgb"]) - len(self._names["depth"])
        if missing:
            self.notices.append(f"{missing} frames have no depth; programs that pair the lists will leave them out")
        self.notices += self._depth.notices + self._intrinsics.notices


class TrajectoryExporter:
    """Poses alone, a line ``stamp tx ty tz qx qy qz qw`` each, as ``evo`` and others read them.

    Args:
        path: Of the file.
        scale_known: Whether poses are in metres; a comment says where not.
    """

    def __init__(self, path: Path, scale_known: bool) -> None:
        self.notices: list[str] = []
        self._path = path
        self._trajectory = Trajectory(scale_known)

    def add(self, item: ExportFrame) -> None:
        """Take one frame.

        Raises:
            LeftOut: there is a frame of that time already.
        """
        self._trajectory.add(item)

    def finish(self) -> None:
        """Write the file."""
        self._trajectory.write(self._path)


class Trajectory:
    """Poses by time."""

    def __init__(self, scale_known: bool = True) -> None:
        self._lines: dict[int, str] = {}
        self._about = () if scale_known else (f"# {SCALE_KEY}: {SCALE_UNKNOWN}",)

    def add(self, item: ExportFrame) -> None:
        """Take the pose of one frame.

        Raises:
            LeftOut: there is one of that time already.
        """
        frame = item.frame
        if frame.stamp_ns in self._lines:
            raise LeftOut("there is a frame of the same time already")
        numbers = (*frame.T_world_camera[:3, 3].tolist(), *quaternion(frame.T_world_camera).tolist())
        self._lines[frame.stamp_ns] = " ".join((seconds(frame.stamp_ns), *map(repr, numbers)))

    def write(self, file: Path) -> None:
        """Write them in order of time."""
        lines = (
            *self._about,
            "# timestamp tx ty tz qx qy qz qw",
            *(self._lines[stamp] for stamp in sorted(self._lines)),
        )
        file.write_text("\n".join(lines) + "\n", encoding="ascii")


class _DepthFiles:
    """Depth images of one scale, and what they could not hold."""

    def __init__(self, scale: float | None) -> None:
        self._scale = scale
        self._written: set[str] = set()
        self._inexact = 0
        self._largest_error = 0.0
        self._made_up = 0

    @property
    def scale(self) -> float:
        """Units a metre."""
        return self._scale or 1000.0

    @property
    def notices(self) -> list[str]:
        """For people."""
        notes: list[str] = []
        if self._inexact:
            notes.append(
                f"depth of {self._inexact} frames is not exact in steps of 1/{self.scale:g} m: off by up to "
                f"{self._largest_error * 1e3:.3g} mm"
            )
        if self._made_up:
            notes.append(f"{self._made_up} frames have no depth; their depth images are empty (0 = no measurement)")
        return notes

    def write(self, file: Path, item: ExportFrame) -> bool:
        """False where the frame has no depth."""
        depth = item.frame.depth_m
        if depth is None:
            return False
        self._scale = self._scale or item.depth_scale or None
        units, error = depth_units(depth, self.scale)
        if error > _EXACT_M:
            self._inexact += 1
            self._largest_error = max(self._largest_error, error)
        file.parent.mkdir(exist_ok=True)
        write_png(file, units)
        self._written.add(file.name)
        return True

    def write_computed(self, file: Path, sigma_file: Path, item: ExportFrame) -> None:
        """Write computed depth and its spread, in the same units."""
        frame = item.frame
        assert frame.depth_m is not None and frame.depth_sigma_m is not None
        self._scale = self._scale or item.depth_scale or None
        for image, metres in ((file, frame.depth_m), (sigma_file, frame.depth_sigma_m)):
            units, error = depth_units(metres, self.scale)
            self._inexact += error > _EXACT_M
            self._largest_error = max(self._largest_error, error)
            image.parent.mkdir(exist_ok=True)
            write_png(image, units)

    def fill_in(self, folder: Path, count: int, intrinsics: CameraIntrinsics | None) -> None:
        """Empty images for frames without depth, where others have some: the layout has one for each or none."""
        if not self._written or intrinsics is None:
            return
        empty = np.zeros((intrinsics.height, intrinsics.width), np.uint16)
        for name in {f"{number:06d}.png" for number in range(count)} - self._written:
            write_png(folder / name, empty)
            self._made_up += 1


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
        """Take the first frame's.

        Raises:
            LeftOut: a later frame has others.
        """
        self.value = self.value or frame.intrinsics
        if frame.intrinsics != self.value:
            raise LeftOut("its camera has other intrinsics than the first frame's, and the layout has but one")

    def write(self, file: Path, depth_scale: float) -> None:
        """Write them as ``import`` reads them."""
        if self.value is not None:
            k = self.value
            plain = {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}
            file.write_text(
                json.dumps({**plain, "depth_scale": depth_scale, **self._about}, indent=1), encoding="ascii"
            )


def _by_stamp(line: str) -> tuple[int, str]:
    whole, _, rest = line.partition(".")
    return int(whole), rest
