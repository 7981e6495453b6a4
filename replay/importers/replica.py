"""Replica rooms as rendered for Semantic-NeRF: one sequence of one scene.

The folder is ``SCENE/Sequence_1`` (or 2): ``rgb/rgb_N.png``, ``depth/depth_N.png`` (uint16 mm, z),
``semantic_class/semantic_class_N.png`` (uint8 class ids of Replica, 0 = none), ``semantic_instance/`` (not used), and
``traj_w_c.txt`` (a row of 16 numbers a frame, row-major ``T_world_camera``, OpenCV axes). The layout and the units are
those that ``SSR/datasets/replica/replica_datasets.py`` of https://github.com/Harry-Zhi/semantic_nerf reads; the camera
is the one of its ``SSR/training/trainer.py``: 640x480, horizontal field of view 90 degrees, so fx = fy = 320, and the
principal point in the middle. Another image size keeps that field of view.

Class names come from Replica's own ``info_semantic.json`` ("classes": [{"id", "name"}, ...]), which is looked for in
the sequence's folder, the scene's, its ``habitat``, and in ``semantic_info/SCENE`` next to the scenes.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from semantic_mapper.config import read_json
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError, LabelError
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    Skipped,
    check_frame_pose,
    depth_files,
    image_size_must_be,
    numbered_files,
    read_depth_if_there,
    read_label,
    read_numbers,
    read_rgb,
    read_rows,
    without_picture,
)
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

DEPTH_SCALE = DepthScale(1000.0, convention="millimetres, as Semantic-NeRF's renderer writes them")
RENDER_HZ = 30.0  # the renderer has no clock; its path moves like a hand-held camera at this rate
HFOV_DEG = 90.0
_INFO = "info_semantic.json"
_TRAJECTORY = "traj_w_c.txt"


class _Class(msgspec.Struct):
    id: int
    name: str


MAX_INFO_BYTES = 1 << 26  # it lists every object of the scene


class _Info(msgspec.Struct):
    classes: list[_Class]


class ReplicaRecording:
    """A sequence, opened; one frame for each colour image.

    Args:
        folder: Of the sequence.
        options: See ``ImportOptions``.

    Raises:
        ImportSourceError: images or poses are missing, or their numbers do not agree.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self.depth_scale = DEPTH_SCALE
        self._folder = folder
        self._camera_id = options.camera_id
        self._hz = options.frame_hz or RENDER_HZ
        self._color = list(numbered_files(folder / "rgb", (".png",), self.notices).items())
        self._depth = depth_files(folder / "depth", options, self.depth_scale, self.notices)
        self._labels = numbered_files(folder / "semantic_class", (".png",), self.notices)
        numbers = dict(self._color)
        self._rows = read_rows(folder / _TRAJECTORY, max(numbers, default=-1) + 1, self.notices)
        self.notices += without_picture("depth image", self._depth, numbers, folder / "rgb")
        self._check_counts(options)
        self._intrinsics = self._find_intrinsics()
        labels = self._read_label_set() if self._labels else None
        self.info = StreamInfo(
            source=f"replica {folder.resolve().parent.name} {folder.resolve().name}",
            cameras={options.camera_id: self._intrinsics},
            label_set=labels,
            frame_count=len(self._color),
            frame_hz=self._hz,
        )

    def __len__(self) -> int:
        return len(self._color)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        name, file = self._color[number]
        rgb, encoded = read_rgb(file)
        image_size_must_be(rgb, self._intrinsics, file)
        size = (self._intrinsics.height, self._intrinsics.width)
        depth = read_depth_if_there(self._depth.get(name), DEPTH_SCALE, size)
        label, label_error = None, None
        if self.info.label_set is not None:
            label_file = self._labels.get(name, self._folder / "semantic_class" / f"semantic_class_{name}.png")
            try:
                label = read_label(label_file, self.info.label_set, size)
            except BadFrameError as error:
                label_error = Skipped(error.file, error.reason, number, label_only=True)
        frame = PosedFrame(
            stamp_ns=round(name * 1e9 / self._hz),
            seq=number,
            camera_id=self._camera_id,
            rgb=rgb,
            depth_m=depth,
            label=label,
            intrinsics=self._intrinsics,
            T_world_camera=self._pose(name),
        )
        return LoadedFrame(frame, encoded, label_error)

    def _check_counts(self, options: ImportOptions) -> None:
        if not self._color:
            raise ImportSourceError(f"{self._folder / 'rgb'}: no images rgb_0.png, rgb_1.png, ...")
        if not self._depth and not options.without_depth:
            raise ImportSourceError(f"{self._folder / 'depth'}: no images depth_0.png, depth_1.png, ...")
        last = self._color[-1][0]
        if last >= len(self._rows):
            raise ImportSourceError(
                f"{self._folder / _TRAJECTORY}: has {len(self._rows)} rows, images go up to rgb_{last}.png; row i "
                "belongs to image i, counted from 0: take the file that was downloaded with these images"
            )

    def _find_intrinsics(self) -> CameraIntrinsics:
        for _, file in self._color:
            try:
                height, width = read_rgb(file)[0].shape[:2]
            except BadFrameError:  # reported when its turn comes
                continue
            f = width / 2 / np.tan(np.deg2rad(HFOV_DEG) / 2)
            try:
                return CameraIntrinsics(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
            except FrameError as error:
                raise ImportSourceError(f"{file}: {error}") from error
        raise ImportSourceError(f"{self._folder / 'rgb'}: none of its images can be read; download them again")

    def _pose(self, name: int) -> Float64:
        file = self._folder / _TRAJECTORY
        line, text = self._rows[name]
        try:
            values = np.array(read_numbers(text), np.float64)
        except ValueError as error:
            raise BadFrameError(file, f"line {line}: {error}") from error
        if values.size != 16:
            raise BadFrameError(file, f"line {line}: expected 16 numbers (4x4, row by row), got {values.size}")
        return check_frame_pose(values.reshape(4, 4), file, line)

    def _read_label_set(self) -> LabelSet | None:
        here = self._folder.resolve()
        scene = here.parent
        places = (here, scene, scene / "habitat", scene.parent / "semantic_info" / scene.name)
        file = next((place / _INFO for place in places if (place / _INFO).exists()), None)
        if file is None:
            self.notices.append(
                f"semantic_class/ is left out: {_INFO}, which names its classes, is in none of "
                f"{', '.join(map(str, places))}; Replica has it for each scene"
            )
            return None
        try:
            classes = {c.id: c.name for c in read_json(file, _Info, MAX_INFO_BYTES).classes if c.id > 0}
            return make_label_set("replica", list(classes.values()), ids=list(classes))
        except ConfigError as error:
            raise ImportSourceError(str(error)) from error
        except LabelError as error:
            raise ImportSourceError(f"{file}: {error}") from error
