"""Logs as folders of images: the sequence folder that ``import`` reads, TUM RGB-D, and TUM's trajectory file alone."""

import json
from collections.abc import Iterable
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

MILLIMETRES = 1000.0  # units a metre, where the log says none
_SUFFIX = {"jpeg": "jpg", "png": "png", "raw": "png"}
_EXACT_M = 1e-6  # float32 has no more at the distances of a room


class _ImageFolder:
    """A folder of images of one camera: depth in one scale, intrinsics, and what the layout could not hold."""

    def __init__(self, folder: Path, depth_scale: float = 0.0, scale_known: bool = True) -> None:
        self.notices: list[str] = []
        self._folder = folder
        self._intrinsics: CameraIntrinsics | None = None
        self._depth_scale = depth_scale  # units a metre; 0 = the log's
        self._inexact = self._computed_depths = 0
        self._largest_error = 0.0
        self._about = {} if scale_known else {SCALE_KEY: SCALE_UNKNOWN}

    def _check_camera(self, frame: PosedFrame) -> None:
        self._intrinsics = self._intrinsics or frame.intrinsics
        if frame.intrinsics != self._intrinsics:
            raise LeftOut("its camera has other intrinsics than the first frame's, and the layout has but one")

    def _write(self, name: str, data: bytes) -> None:
        (self._folder / name).parent.mkdir(exist_ok=True)
        (self._folder / name).write_bytes(data)

    def _write_png(self, name: str, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """One channel, 8 or 16 bits; level 1, a third of the time for some more bytes."""
        self._write(name, cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())

    def _write_depth(self, name: str, depth_m: Float32, item: ExportFrame) -> None:
        """Write it as uint16, in the units of the log where none are given; what is too far away becomes 0."""
        self._depth_scale = self._depth_scale or item.depth_scale
        scale = self._depth_scale or MILLIMETRES
        metres = np.nan_to_num(depth_m, posinf=0.0, neginf=0.0)
        units = np.rint(metres * np.float32(scale))
        held = np.where((units >= 0) & (units <= 65535), units, 0).astype(np.uint16)
        error = float(np.abs(held.astype(np.float32) / np.float32(scale) - metres).max(initial=0.0))
        self._inexact += error > _EXACT_M
        self._largest_error = max(self._largest_error, error)
        self._write_png(name, held)

    def _write_text(self, name: str, lines: Iterable[object]) -> None:
        (self._folder / name).write_text("\n".join(map(str, lines)) + "\n", encoding="utf-8")

    def _finish_camera(self) -> None:
        """Write the intrinsics as ``import`` reads them, and note what was lost."""
        scale = self._depth_scale or MILLIMETRES
        if self._inexact:
            self.notices.append(
                f"depth of {self._inexact} frames is not exact in steps of 1/{scale:g} m: off by up to "
                f"{self._largest_error * 1e3:.3g} mm"
            )
        if self._intrinsics is not None:
            plain = {name: getattr(self._intrinsics, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
            self._write_text("intrinsics.json", [json.dumps({**plain, "depth_scale": scale, **self._about}, indent=1)])
            if any(self._intrinsics.distortion):
                self.notices.append("lens distortion is not in the files: undistort the images with the log's own")


class FolderExporter(_ImageFolder):
    """The sequence folder (see ``replay/importers/folder.py``): the same frames come back from ``import``.

    Colour images keep the bytes of the log, depth its units, poses and stamps every digit. Numbers of frames are their
    places in the folder. Pseudo labels and computed depth lie in folders of their own, so that nobody takes them for
    labels of people and depth of a sensor. The folder is there, and empty.
    """

    def __init__(self, folder: Path, info: StreamInfo) -> None:
        super().__init__(folder, scale_known=info.scale_known)
        self._labels = info.label_set
        self._poses: list[str] = []
        self._stamps: list[int] = []
        self._without_depth: list[str] = []
        self._pseudo_labels = 0

    def add(self, item: ExportFrame) -> None:
        """Write one frame. Raises LeftOut: its stamp does not rise, or its camera has changed."""
        frame = item.frame
        if self._stamps and frame.stamp_ns <= self._stamps[-1]:
            raise LeftOut("it is not later than the frame before it, which the layout needs")
        self._check_camera(frame)
        number = f"{len(self._poses):06d}"
        name = f"{number}.png"
        self._write(f"color/{number}.{_SUFFIX[item.rgb.encoding]}", item.rgb.data)
        if frame.depth_m is not None and frame.depth_sigma_m is not None:
            self._write_depth(f"{COMPUTED_DEPTH}/{name}", frame.depth_m, item)
            self._write_depth(f"{DEPTH_SIGMA}/{name}", frame.depth_sigma_m, item)
            self._computed_depths += 1
        elif frame.depth_m is not None:
            self._write_depth(f"depth/{name}", frame.depth_m, item)
        if frame.depth_m is None or frame.depth_sigma_m is not None:
            self._without_depth.append(name)
        if frame.label is not None and self._labels is not None:
            self._write_png(f"{PSEUDO_LABEL if frame.label_is_pseudo else 'label'}/{name}", frame.label)
            self._pseudo_labels += frame.label_is_pseudo
        self._poses.append(" ".join(map(repr, frame.T_world_camera.ravel().tolist())))
        self._stamps.append(frame.stamp_ns)

    def finish(self) -> None:
        """Write what describes the images, and empty depth images where others have some: each has one or none."""
        self._write_text("poses.txt", self._poses)
        self._write_text("timestamps.txt", self._stamps)
        if self._labels is not None:
            self._write_text("labels.json", [json.dumps(plain_labels(self._labels), indent=1, ensure_ascii=False)])
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
        self._finish_camera()
        k, missing = self._intrinsics, self._without_depth
        if k is not None and 0 < len(missing) < len(self._poses):
            for name in missing:
                self._write_png(f"depth/{name}", np.zeros((k.height, k.width), np.uint16))
            self.notices.append(
                f"{len(missing)} frames have no depth; their depth images are empty (0 = no measurement)"
            )


class TumExporter(_ImageFolder):
    """A TUM RGB-D sequence: ``rgb/``, ``depth/`` (5000 units a metre), their lists and ``groundtruth.txt``.

    In addition to what the data set has there is ``intrinsics.json``, which our import reads. Depth that was computed
    is left out, since readers would take it for a sensor's. The folder is there, and empty.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, DEPTH_SCALE.units_per_m)
        self._names: dict[str, dict[int, str]] = {"rgb": {}, "depth": {}}  # by stamp
        self._trajectory = TrajectoryExporter(folder / "groundtruth.txt")

    def add(self, item: ExportFrame) -> None:
        """Write one frame. Raises LeftOut: there is a frame of that time already, or its camera has changed."""
        frame = item.frame
        self._check_camera(frame)
        self._trajectory.add(item)
        stamp = _seconds(frame.stamp_ns)
        color = f"rgb/{stamp}.{_SUFFIX[item.rgb.encoding]}"
        self._write(color, item.rgb.data)
        self._names["rgb"][frame.stamp_ns] = f"{stamp} {color}"
        if frame.depth_sigma_m is not None:
            self._computed_depths += 1
        elif frame.depth_m is not None:
            self._write_depth(f"depth/{stamp}.png", frame.depth_m, item)
            self._names["depth"][frame.stamp_ns] = f"{stamp} depth/{stamp}.png"

    def finish(self) -> None:
        """Write the lists."""
        titles = {"rgb": "# color images", "depth": "# depth maps, 5000 units a metre"}
        for name, lines in self._names.items():
            rows = (lines[stamp] for stamp in sorted(lines))
            self._write_text(f"{name}.txt", (titles[name], "# timestamp filename", *rows))
        self._trajectory.finish()
        if self._computed_depths:
            self.notices.append(f"depth of {self._computed_depths} frames is computed, not a sensor's, and is left out")
        missing = len(self._names["rgb"]) - len(self._names["depth"])
        if missing:
            self.notices.append(f"{missing} frames have no depth; programs that pair the lists will leave them out")
        self._finish_camera()


class TrajectoryExporter:
    """Poses alone, a line ``stamp tx ty tz qx qy qz qw`` each, as ``evo`` and others read them.

    Where poses are not in metres (``scale_known``), a comment says so.
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


def _seconds(stamp_ns: int) -> str:
    """Nanoseconds as seconds with nine places, exactly."""
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
