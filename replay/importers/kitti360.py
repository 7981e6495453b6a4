"""KITTI-360: one drive, its two rectified perspective cameras, and the depth that its laser scanner gives them.

The layout is that of https://www.cvlibs.net/datasets/kitti-360/documentation.php ("Folder Structure", "Calibration",
"Camera Poses"): under the root, ``calibration/perspective.txt`` (``P_rect_0x`` 3x4, ``S_rect_0x`` width height),
``data_2d_raw/DRIVE/image_0x/data_rect/NNNNNNNNNN.png`` and ``image_0x/timestamps.txt`` (a row a frame),
``data_poses/DRIVE/cam0_to_world.txt`` (frame number and the 16 numbers of ``T_world_camera`` of the rectified left
camera; not every frame has one), and, for drives that are labelled,
``data_2d_semantics/train/DRIVE/image_0x/semantic/NNNNNNNNNN.png`` (uint8 ids). Depth comes from
``data_3d_raw/DRIVE/velodyne_points/data/NNNNNNNNNN.bin`` (float32 x y z reflectance a point, in the scanner's axes),
where it is there, by way of ``calibration/calib_cam_to_velo.txt`` (3x4, unrectified left camera -> scanner) and
``R_rect_00``. The scanner reaches 2 degrees above the horizon; its scans are not corrected for the car's motion.
DRIVE is ``2013_05_28_drive_0000_sync`` and the like; give the root where it holds one, else ``data_2d_raw/DRIVE``.

Class ids, names and colours are those of ``kitti360scripts/helpers/labels.py`` in
https://github.com/autonomousvision/kitti360Scripts, but for its category "void", which is read as unknown.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from semantic_mapper.errors import FrameError, ImportSourceError, LabelError
from semantic_mapper.geometry import check_pose, invert_pose, transform
from semantic_mapper.labels import LabelSet
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    Skipped,
    check_frame_pose,
    image_size_must_be,
    numbered_files,
    read_bytes,
    read_lines,
    read_numbers,
    read_plane,
    read_rgb,
    read_rows,
    split_row,
)
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

CAMERAS = ("image_00", "image_01")
SOURCE = "kitti360 "  # begins the name of the source of such logs, whose frames have the numbers of the drive
NOMINAL_HZ = 10.0  # of drives whose timestamps.txt is not there
_CLASSES = (  # from id 7 on
    "road 804080|sidewalk f423e8|parking faaaa0|rail track e6968c|building 464646|wall 66669c|fence be9999|"
    "guard rail b4a5b4|bridge 966464|tunnel 96785a|pole 999999|polegroup 999999|traffic light faaa1e|"
    "traffic sign dcdc00|vegetation 6b8e23|terrain 98fb98|sky 4682b4|person dc143c|rider ff0000|car 00008e|"
    "truck 000046|bus 003c64|caravan 00005a|trailer 00006e|train 005064|motorcycle 0000e6|bicycle 770b20|garage 408080|"
    "gate be9999|stop 96785a|smallpole 999999|lamp 004040|trash bin 0080c0|vending machine 804000|box 404080"
).split("|")
_FIRST_ID = 7
BEAM_STEP_RAD = (np.radians(0.18), np.radians(0.43))  # between two beams of the scanner (HDL-64E) across and upwards
MIN_SCAN_M = 0.5
_VOID = (*range(1, _FIRST_ID), 42, 43, 44, 255)  # ego vehicle, static, ..., unknown object, and license plate (-1)


def _label_set() -> LabelSet:
    names, colors = zip(*(text.rsplit(" ", 1) for text in _CLASSES), strict=True)
    rgb = tuple((c[0], c[1], c[2]) for c in map(bytes.fromhex, colors))
    return LabelSet("kitti360-ids", tuple(range(_FIRST_ID, _FIRST_ID + len(names))), names, rgb)


LABELS = _label_set()


class Kitti360Recording:
    """A drive, opened; a frame for each image of the left camera and, where they are there, of the right one.

    Args:
        folder: The root with one drive, or the drive's folder in ``data_2d_raw``.
        options: See ``ImportOptions``; cameras are called as their folders are.

    Raises:
        ImportSourceError: calibration, images or poses are missing or cannot be understood.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        root, drive = find_drive(folder)
        self._drive_folder = root / "data_2d_raw" / drive
        self._semantics = root / "data_2d_semantics" / "train" / drive
        self._files = {
            name: numbered_files(self._drive_folder / name / "data_rect", (".png",), self.notices) for name in CAMERAS
        }
        self._cameras = [name for name in CAMERAS if self._files[name]]
        if not self._cameras:
            where = self._drive_folder / CAMERAS[0] / "data_rect"
            raise ImportSourceError(f"{where}: no rectified images; download 'Perspective Images' of this drive")
        calibration = root / "calibration" / "perspective.txt"
        self._intrinsics: dict[str, CameraIntrinsics] = {}
        self._T_cam0_camera: dict[str, Float64] = {}
        values = _read_calibration(calibration)
        for name in self._cameras:
            self._intrinsics[name], self._T_cam0_camera[name] = rectified_camera(values, name[-2:], calibration)
        self._scans = root / "data_3d_raw" / drive / "velodyne_points" / "data"
        self._T_cam0_scanner = _scanner_pose(root / "calibration", values) if self._scans.is_dir() else None
        if self._T_cam0_scanner is None or options.without_depth:
            self._T_cam0_scanner = None
            self.notices.append(f"no laser scans of {self._scans}: frames come without depth")
        self.depth_scale = DepthScale(1000.0, convention="depth comes from laser scans, in metres")
        self._poses_file = root / "data_poses" / drive / "cam0_to_world.txt"
        self._poses = self._read_poses()
        self._stamps = self._read_stamps(options.frame_hz)
        labelled = any((self._semantics / name / "semantic").is_dir() for name in self._cameras)
        if not labelled:
            self.notices.append(f"no labels: {self._semantics} has no semantic/; test drives have none")
        # The two cameras fire together: the left one first, so that stamps never fall.
        self._order = sorted((number, name) for name in self._cameras for number in self._files[name])
        self.info = StreamInfo(
            source=f"{SOURCE}{drive}",
            cameras=self._intrinsics,
            label_set=LABELS if labelled else None,
            frame_count=len(self._order),
            frame_hz=options.frame_hz or NOMINAL_HZ,
        )

    def __len__(self) -> int:
        return len(self._order)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        index, camera = self._order[number]
        file = self._files[camera][index]
        pose = self._pose(index, camera)
        rgb, encoded = read_rgb(file)
        intrinsics = self._intrinsics[camera]
        image_size_must_be(rgb, intrinsics, file)
        label, label_error = None, None
        if (self._semantics / camera / "semantic").is_dir():
            try:
                size = (intrinsics.height, intrinsics.width)
                label = read_semantics(self._semantics / camera / "semantic" / f"{index:010d}.png", size)
            except BadFrameError as error:
                label_error = Skipped(error.file, error.reason, number, label_only=True)
        frame = PosedFrame(
            stamp_ns=self._stamp(index, camera),
            seq=index,
            camera_id=camera,
            rgb=rgb,
            depth_m=self._depth(index, camera),
            label=label,
            intrinsics=intrinsics,
            T_world_camera=pose,
        )
        return LoadedFrame(frame, encoded, label_error)

    def _pose(self, index: int, camera: str) -> Float64:
        if index not in self._poses:
            raise BadFrameError(self._poses_file, f"has no pose for image {index}; the drive has poses where it moved")
        line, pose = self._poses[index]
        return check_frame_pose(pose, self._poses_file, line) @ self._T_cam0_camera[camera]

    def _depth(self, index: int, camera: str) -> Float32 | None:
        """Depth image (H, W) of the scan of a frame; None without scans, and of a frame that has none."""
        file = self._scans / f"{index:010d}.bin"
        if self._T_cam0_scanner is None or not file.exists():
            return None
        T_camera_scanner = invert_pose(self._T_cam0_camera[camera]) @ self._T_cam0_scanner
        return depth_of_scan(read_scan(file), T_camera_scanner, self._intrinsics[camera])

    def _stamp(self, index: int, camera: str) -> int:
        stamps = self._stamps.get(camera)
        if stamps is None:
            return round(index * 1e9 / self.info.frame_hz)
        if index >= len(stamps):
            file = self._drive_folder / camera / "timestamps.txt"
            raise BadFrameError(file, f"has {len(stamps)} rows and so no time for image {index}")
        line, text = stamps[index]
        return _time_ns(text, self._drive_folder / camera / "timestamps.txt", line)

    def _read_poses(self) -> dict[int, tuple[int, Float64]]:
        poses: dict[int, tuple[int, Float64]] = {}
        bad: list[str] = []
        for line, text in read_lines(self._poses_file):
            try:
                index, *numbers = split_row(text)
                T_world_cam0 = np.array([float(n) for n in numbers], np.float64).reshape(4, 4)
                number = int(float(index))
            except (ValueError, OverflowError) as error:
                bad.append(f"line {line} ({error})")
                continue
            if number in poses:
                self.notices.append(
                    f"{self._poses_file}, line {line}: a second pose of image {number}; the first counts"
                )
            poses.setdefault(number, (line, T_world_cam0))
        if not poses:
            raise ImportSourceError(
                f"{self._poses_file}: holds no pose: no row of a frame number and the 16 numbers of a 4x4 matrix"
                f"{' (' + bad[0] + ')' if bad else ''}; poses.txt, with 12, is another file"
            )
        if bad:
            self.notices.append(f"{self._poses_file}: {counted(len(bad), 'row')} left out, no pose: {bad[0]}")
        return poses

    def _read_stamps(self, frame_hz: float | None) -> dict[str, list[tuple[int, str]]]:
        files = {name: self._drive_folder / name / "timestamps.txt" for name in self._cameras}
        missing = [str(file) for file in files.values() if not file.exists()]
        if missing or frame_hz is not None:
            why = f"{missing[0]} is missing" if missing else "a rate is given"
            self.notices.append(f"{why}: stamps are made up at {frame_hz or NOMINAL_HZ:g} frames a second")
            return {}
        stamps: dict[str, list[tuple[int, str]]] = {}
        for name, file in files.items():
            stamps[name] = read_rows(file, max(self._files[name]) + 1, self.notices)
            # Of one form, so that their order is that of time.
            texts = [text.strip() for _, text in stamps[name] if text]
            if any(a >= b for a, b in pairwise(texts)):
                self.notices.append(f"{file}: stamps go back, or are there twice")
        return stamps


def find_drive(folder: Path) -> tuple[Path, str]:
    """Root of the data set and name of the drive.

    Raises:
        ImportSourceError: several drives, none, or a folder of another kind.
    """
    folder = folder.resolve()
    if folder.parent.name == "data_2d_raw":
        return folder.parent.parent, folder.name
    drives = sorted(path.name for path in (folder / "data_2d_raw").glob("*_drive_*_sync") if path.is_dir())
    if len(drives) == 1:
        return folder, drives[0]
    if not drives:
        raise ImportSourceError(f"{folder / 'data_2d_raw'}: no drive (2013_05_28_drive_0000_sync or the like) in it")
    raise ImportSourceError(
        f"{folder}: holds {len(drives)} drives; name the folder of one: {folder / 'data_2d_raw' / drives[0]}, "
        f"{', '.join(drives[1:])}"
    )


def rectified_camera(values: dict[str, list[float]], which: str, file: Path) -> tuple[CameraIntrinsics, Float64]:
    """Intrinsics of a rectified camera, and ``T_cam0_camera`` (4, 4): where it stands next to the left one.

    Args:
        values: Lines of ``perspective.txt`` by name.
        which: "00" or "01".
        file: Named in errors.

    Raises:
        ImportSourceError: lines are missing, or of another length.
    """
    P, size = values.get(f"P_rect_{which}", []), values.get(f"S_rect_{which}", [])
    if len(P) != 12 or len(size) != 2:
        raise ImportSourceError(f"{file}: needs 'P_rect_{which}:' with 12 numbers and 'S_rect_{which}:' with 2")
    matrix = np.array(P, np.float64).reshape(3, 4)
    K = matrix[:, :3]
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
        raise ImportSourceError(f"{file}: P_rect_{which} has skew, which is not undone; use the file of the data set")
    try:
        intrinsics = CameraIntrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(size[0]), int(size[1]))
        offset = np.linalg.solve(K, matrix[:, 3])
    except (FrameError, ValueError, OverflowError, np.linalg.LinAlgError) as error:  # int() of NaN or infinity, too
        raise ImportSourceError(f"{file}: P_rect_{which} and S_rect_{which}: {error}") from error
    T_cam0_camera = np.eye(4)
    T_cam0_camera[:3, 3] = -offset  # P = K [I | t] takes points of the left camera
    return intrinsics, T_cam0_camera


def read_semantics(file: Path, size: tuple[int, int]) -> UInt8:
    """Label image (H, W) with the ids of the data set; those of its category "void" become 0.

    Raises:
        BadFrameError: missing, damaged, of another size, or an id that the data set does not have.
    """
    ids = read_plane(file, "uint8", size, "label").astype(np.uint8)
    ids[np.isin(ids, _VOID)] = LABELS.ignore_id
    try:
        LABELS.to_channels(ids, "label image")
    except LabelError as error:
        raise BadFrameError(file, str(error)) from error
    return ids


def read_scan(file: Path) -> Float64:
    """Points (N, 3) of a scan, metres, in the scanner's axes.

    Raises:
        BadFrameError: it cannot be read, or does not hold four numbers a point.
    """
    try:
        data = read_bytes(file)
    except OSError as error:
        raise BadFrameError(file, f"the scan cannot be read ({error.strerror or error})") from error
    if len(data) % 16:
        raise BadFrameError(file, f"a scan has 16 bytes a point, this one {len(data)} bytes; download it again")
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)


def depth_of_scan(points: Float64, T_camera_scanner: Float64, intrinsics: CameraIntrinsics) -> Float32:
    """Depth image (H, W) of a scan, 0 where no beam went.

    A point fills the pixels between its beam and the next ones, the nearest point wins: so what the camera does not see
    but the scanner on the roof does is hidden by what stands before it.

    Args:
        points: (N, 3) in the scanner's axes.
        T_camera_scanner: (4, 4).
        intrinsics: Of the camera.
    """
    k = intrinsics
    p = transform(T_camera_scanner, points)
    p = p[np.isfinite(p).all(axis=1) & (p[:, 2] > MIN_SCAN_M)]
    uv = np.rint(p[:, :2] / p[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy))
    half_u, half_v = (int(np.ceil((f * step - 1) / 2)) for f, step in zip((k.fx, k.fy), BEAM_STEP_RAD, strict=True))
    margin = np.array((half_u, half_v))
    inside = ((uv >= -margin) & (uv < np.array((k.width, k.height)) + margin)).all(axis=1)
    (u, v), z = (uv[inside] + margin).astype(np.int64).T, p[inside, 2].astype(np.float32)
    depth = np.full((k.height + 4 * half_v, k.width + 4 * half_u), np.inf, np.float32)
    for dv in range(2 * half_v + 1):
        for du in range(2 * half_u + 1):
            np.minimum.at(depth, (v + dv, u + du), z)
    depth = depth[2 * half_v : 2 * half_v + k.height, 2 * half_u : 2 * half_u + k.width]
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def _scanner_pose(calibration: Path, values: dict[str, list[float]]) -> Float64:
    """T_cam0_scanner (4, 4): the scanner in the rectified left camera.

    Raises:
        ImportSourceError: files or lines are missing, or of another form.
    """
    file = calibration / "calib_cam_to_velo.txt"
    words = [word for _, text in read_lines(file) for word in text.split()]
    rectification = values.get("R_rect_00", [])
    if len(rectification) != 9:
        raise ImportSourceError(f"{calibration / 'perspective.txt'}: needs 'R_rect_00:' with 9 numbers to use scans")
    try:
        T_scanner_camera = np.vstack((np.array([float(w) for w in words]).reshape(3, 4), (0, 0, 0, 1)))
        check_pose(T_scanner_camera, "calib_cam_to_velo.txt")
    except (ValueError, FrameError) as error:
        raise ImportSourceError(f"{file}: expected the 12 numbers of a rigid 3x4 matrix ({error})") from error
    T_cam0_raw = np.eye(4)
    T_cam0_raw[:3, :3] = np.array(rectification).reshape(3, 3)
    return T_cam0_raw @ invert_pose(T_scanner_camera)


def _read_calibration(file: Path) -> dict[str, list[float]]:
    values: dict[str, list[float]] = {}
    for line, text in read_lines(file):
        name, _, numbers = text.partition(":")
        if not re.fullmatch(r"[PRS]_rect_0[01]", name.strip()):
            continue
        try:
            values[name.strip()] = read_numbers(numbers)
        except ValueError as error:
            raise ImportSourceError(f"{file}, line {line}: {error}") from error
    return values


def _time_ns(text: str, file: Path, line: int) -> int:
    """``2013-05-28 08:46:02.904547200`` -> nanoseconds since 1970."""
    seconds, _, fraction = text.strip().replace("T", " ").partition(".")
    try:
        whole = datetime.strptime(seconds, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        return int(whole.timestamp()) * 1_000_000_000 + int((fraction or "0")[:9].ljust(9, "0"))
    except ValueError as error:
        raise BadFrameError(file, f"line {line}: expected a date and a time: {error}") from error
