"""ScanNet scenes as its tools export them.

``color/N.jpg``, ``depth/N.png`` (uint16 mm), ``pose/N.txt`` (4x4 camera to world, -inf where tracking was lost),
``intrinsic/intrinsic_color.txt`` and ``intrinsic_depth.txt`` (or ``intrinsics_color.txt`` in the folder itself), and
``label-filt/N.png`` or ``label/N.png``: 8 bits hold NYU40 ids; 16 bits hold ScanNet's raw ids, which need the data
set's ``scannetv2-labels.combined.tsv`` in this folder or up to two above.

Colour is larger than depth (1296x968 against 640x480) and both cameras are taken to stand in one point, as the data
set's extrinsics say. So each depth pixel's ray hits the colour image at ``K_color @ inv(K_depth) @ pixel``, whatever
its depth: colour and labels are resampled to the depth image's pixels (colour by area, labels by nearest pixel), and
the depth camera's intrinsics hold. Depth itself is not touched.
"""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError, ImportSourceError, LabelError
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.importers.base import (
    PICTURES,
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    Skipped,
    check_frame_pose,
    depth_files,
    numbered_files,
    read_depth,
    read_depth_if_there,
    read_matrix,
    read_plane,
    read_rgb,
    without_picture,
)
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

DEPTH_SCALE = DepthScale(1000.0, convention="ScanNet's millimetres")
SENSOR_HZ = 30.0
_TABLE = "scannetv2-labels.combined.tsv"
_SAME_PIXEL = 0.25  # px; colour that is off by less is not resampled


class ScanNetRecording:
    """An exported ScanNet scene, opened; one frame for each colour image.

    Args:
        folder: Of the scene.
        options: See ``ImportOptions``.

    Raises:
        ImportSourceError: intrinsics or images are missing.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self.depth_scale = DEPTH_SCALE
        self._folder = folder
        self._camera_id = options.camera_id
        self._hz = options.frame_hz or SENSOR_HZ
        self._color = list(numbered_files(folder / "color", PICTURES, self.notices).items())
        self._depth = depth_files(folder / "depth", options, self.depth_scale, self.notices)
        self._poses = numbered_files(folder / "pose", (".txt",), self.notices)
        numbers = dict(self._color)
        self.notices += without_picture("pose", self._poses, numbers, folder / "color")
        names = [name for name in ("label-filt", "label") if (folder / name).is_dir()]
        self._labels = numbered_files(folder / names[0], (".png",), self.notices) if names else {}
        self._has_label = bool(self._labels)
        self._nyu40_of_raw = self._read_table()
        self._color_intrinsics = self._read_intrinsics("color", [file for _, file in self._color])
        self._intrinsics = (
            self._color_intrinsics
            if options.without_depth
            else self._read_intrinsics("depth", list(self._depth.values()))
        )
        self._check_extrinsics()
        self.info = StreamInfo(
            source=f"scannet {folder.resolve().name}",
            cameras={options.camera_id: self._intrinsics},
            label_set=NYU40 if self._has_label else None,
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
        name, color_file = self._color[number]
        pose = self._pose(name)
        size = (self._intrinsics.height, self._intrinsics.width)
        depth = read_depth_if_there(self._depth.get(name), self.depth_scale, size)
        rgb, encoded = self._rgb(color_file)
        label, label_error = None, None
        if self._has_label:
            try:
                label = self._label(self._labels.get(name, self._folder / "label-filt" / f"{name}.png"))
            except BadFrameError as error:
                label_error = Skipped(error.file, error.reason, number, label_only=True)
        frame = PosedFrame(
            stamp_ns=round(name * 1e9 / self._hz),  # exports that keep each n-th frame keep its number
            seq=number,
            camera_id=self._camera_id,
            rgb=rgb,
            depth_m=depth,
            label=label,
            intrinsics=self._intrinsics,
            T_world_camera=pose,
        )
        return LoadedFrame(frame, encoded, label_error)

    def _pose(self, name: int) -> Float64:
        file = self._poses.get(name, self._folder / "pose" / f"{name}.txt")
        try:
            pose = read_matrix(file)
        except ImportSourceError as error:
            raise BadFrameError(file, str(error).removeprefix(f"{file}: ")) from error
        if not np.isfinite(pose).all():
            raise BadFrameError(file, "the scanner had lost track of its pose here (-inf)")
        return check_frame_pose(pose, file)

    def _rgb(self, file: Path) -> tuple[UInt8, EncodedImage | None]:
        rgb, encoded = read_rgb(file)
        c, d = self._color_intrinsics, self._intrinsics
        if rgb.shape[:2] != (c.height, c.width):
            raise BadFrameError(file, f"the image is {rgb.shape[1]}x{rgb.shape[0]}, the others {c.width}x{c.height}")
        if (c.width, c.height) != (d.width, d.height):
            rgb = np.asarray(cv2.resize(rgb, (d.width, d.height), interpolation=cv2.INTER_AREA), np.uint8)
            encoded = None
        M = pixel_map(d, scale_intrinsics(c, d.width, d.height))
        if moves_pixels(M, d):
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            warped = cv2.warpAffine(rgb, M, (d.width, d.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
            rgb, encoded = np.asarray(warped, np.uint8), None
        return rgb, encoded

    def _label(self, file: Path) -> UInt8:
        image = read_plane(file, "any", None, "label")
        c, d = self._color_intrinsics, self._intrinsics
        height, width = image.shape
        if (width, height) not in ((c.width, c.height), (d.width, d.height)):
            raise BadFrameError(file, f"the label image is {width}x{height}, neither the size of colour nor of depth")
        ids = self._to_nyu40(image, file)
        M = pixel_map(d, scale_intrinsics(c, width, height))
        if (width, height) != (d.width, d.height) or moves_pixels(M, d):
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            ids = np.asarray(cv2.warpAffine(ids, M, (d.width, d.height), flags=flags), np.uint8)  # outside: 0, ignore
        return ids

    def _to_nyu40(self, image: NDArray[np.uint8] | NDArray[np.uint16], file: Path) -> UInt8:
        if image.dtype == np.uint8:
            ids = image.astype(np.uint8)
        elif self._nyu40_of_raw is not None:
            ids = self._nyu40_of_raw[image.astype(np.int64)]
        else:
            raise BadFrameError(file, f"holds ScanNet's raw class ids; put the data set's {_TABLE} into {self._folder}")
        try:
            NYU40.to_channels(ids, "label image")
        except LabelError as error:
            raise BadFrameError(file, str(error)) from error
        return ids

    def _read_table(self) -> UInt8 | None:
        """Raw id -> NYU40 id, 0 for unknown: (65536,)."""
        here = self._folder.resolve()
        for folder in (here, *here.parents[:2]):
            file = folder / _TABLE
            if not file.exists():
                continue
            table = np.zeros(1 << 16, np.uint8)
            try:
                with file.open(encoding="utf-8", newline="") as lines:
                    for row in csv.DictReader(lines, delimiter="\t"):
                        table[int(row["id"])] = int(row["nyu40id"] or 0)
            except (OSError, KeyError, ValueError, TypeError, IndexError, OverflowError, csv.Error) as error:
                raise ImportSourceError(f"{file}: has no columns 'id' and 'nyu40id' of numbers: {error}") from error
            return table
        return None

    def _read_intrinsics(self, which: str, images: list[Path]) -> CameraIntrinsics:
        candidates = [self._folder / "intrinsic" / f"intrinsic_{which}.txt", self._folder / f"intrinsics_{which}.txt"]
        file = next((candidate for candidate in candidates if candidate.exists()), candidates[0])
        K = read_matrix(file)
        if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]) or np.any(np.abs(K[[1, 2, 2], [0, 0, 1]]) > 1e-9):
            raise ImportSourceError(f"{file}: is no matrix of a camera without skew, which is the one that is read")
        for image in images:
            try:
                height, width = read_rgb(image)[0].shape[:2] if which == "color" else read_depth_size(image)
                found = CameraIntrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height)
                if not (0.25 * width < K[0, 2] < 0.75 * width and 0.25 * height < K[1, 2] < 0.75 * height):
                    raise ImportSourceError(
                        f"{file}: its principal point ({K[0, 2]:g}, {K[1, 2]:g}) is far from the middle of images of "
                        f"{width}x{height}: they were resized, or cut; scale the matrix with them"
                    )
                return found
            except BadFrameError:  # reported when its turn comes
                continue
            except FrameError as error:
                raise ImportSourceError(f"{file}: {error}") from error
        raise ImportSourceError(f"{self._folder / which}: no image, named by number, that can be read")

    def _check_extrinsics(self) -> None:
        for which in ("color", "depth"):
            file = self._folder / "intrinsic" / f"extrinsic_{which}.txt"
            if file.exists() and not np.allclose(read_matrix(file), np.eye(4), atol=5e-3):
                self.notices.append(
                    f"{file.name} is not the identity; it is ignored, colour may be off by its parallax"
                )


def read_depth_size(file: Path) -> tuple[int, int]:
    """(height, width) of a depth image.

    Raises:
        BadFrameError: it cannot be read.
    """
    height, width = read_depth(file, DEPTH_SCALE, None).shape
    return height, width


def pixel_map(a: CameraIntrinsics, b: CameraIntrinsics) -> Float64:
    """(2, 3) affine map from pixels of camera a to those of b, both in one point and turned alike."""
    sx, sy = b.fx / a.fx, b.fy / a.fy
    return np.array(((sx, 0, b.cx - sx * a.cx), (0, sy, b.cy - sy * a.cy)))


def moves_pixels(M: Float64, intrinsics: CameraIntrinsics) -> bool:
    """Whether the map takes any pixel visibly elsewhere."""
    corners = np.array(((0, 0, 1), (intrinsics.width - 1, intrinsics.height - 1, 1)), np.float64)
    return bool(np.abs(corners @ M.T - corners[:, :2]).max() > _SAME_PIXEL)
