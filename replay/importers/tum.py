"""TUM RGB-D sequences: ``rgb.txt``, ``depth.txt`` (stamp, file), ``groundtruth.txt`` (stamp tx ty tz qx qy qz qw).

Each colour image gets the depth image nearest in time (each depth image once) and the pose interpolated between its two
neighbours. A frame without a depth image within 20 ms comes without depth, and one without a pose is left out. Depth is
registered to colour, with 5000 units per metre where ``intrinsics.json`` does not give another ``depth_scale``.
The lens distortion of the calibration is undone in both.
Intrinsics come from ``intrinsics.json`` where the folder has one (same layout as in a sequence folder), else from the
calibration published for freiburg1, 2 or 3, by the folder's name, else the default of the sensor's ROS driver.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import interpolate_pose, pose_matrix
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    LoadedFrame,
    check_frame_pose,
    image_size_must_be,
    inside,
    numpy_notice,
    read_depth,
    read_lines,
    read_rgb,
    seconds_to_ns,
    split_row,
)
from semantic_mapper.replay.importers.folder import read_intrinsics, rectifier
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

DEPTH_SCALE = DepthScale(5000.0, convention="TUM's; another one belongs into intrinsics.json as depth_scale")
MAX_NORM_ERROR = 0.1  # of a unit quaternion: files have few digits, and are normalised; more is no rotation
_POSE_GAP_NS = 200_000_000  # poses come at 100 Hz; over a longer gap nothing is interpolated

_CALIBRATIONS = {
    "freiburg1": CameraIntrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": CameraIntrinsics(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": CameraIntrinsics(535.4, 539.2, 320.1, 247.6, 640, 480),  # its images are rectified
}
_DEFAULT = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)


class TumRecording:
    """A TUM sequence, opened; one frame for each line of ``rgb.txt``.

    Args:
        folder: Of the sequence.
        options: See ``ImportOptions``.

    Raises:
        ImportSourceError: a list is missing or holds nothing that can be used.
    """

    def __init__(self, folder: Path, options: ImportOptions) -> None:
        self.notices: list[str] = []
        self.depth_scale = DEPTH_SCALE
        self._folder = folder
        self._options = options
        self._measured = self._read_intrinsics()
        self._rectify = rectifier(self._measured, folder / "intrinsics.json")
        self._intrinsics = self._rectify.intrinsics
        self._color = self._read_list(folder / "rgb.txt")
        if not self._color:
            raise ImportSourceError(
                "; ".join((f"{folder / 'rgb.txt'}: holds no line 'stamp file'", *self.notices[-1:]))
            )
        depth = [] if options.without_depth else self._read_depth_list()
        trajectory = read_trajectory(folder / "groundtruth.txt")
        self._pose_stamps, self._poses = trajectory.stamps_ns, trajectory.rows
        self.notices += [*trajectory.left_out, *trajectory.remarks]
        self._depth_of = match_nearest(
            np.array([stamp for stamp, _ in self._color], np.int64),
            np.array([stamp for stamp, _ in depth], np.int64),
            round(options.match_s * 1e9),
        )
        self._depth_files = [file for _, file in depth]
        self.notices += numpy_notice(self._depth_files, self.depth_scale)
        self.info = StreamInfo(
            source=f"tum {folder.resolve().name}",
            cameras={options.camera_id: self._intrinsics},
            frame_count=len(self._color),
            frame_hz=30.0,
        )

    def __len__(self) -> int:
        return len(self._color)

    def load(self, number: int) -> LoadedFrame:
        """Read one frame.

        Raises:
            BadFrameError: it cannot be used.
        """
        stamp, file = self._color[number]
        pose = _pose_at(stamp, self._pose_stamps, self._poses, round(self._options.match_s * 1e9))
        if pose is None:
            raise BadFrameError(file, f"groundtruth.txt has no pose near its time {stamp / 1e9:.6f}")
        rgb, encoded = read_rgb(file)
        image_size_must_be(rgb, self._measured, file)
        size = (self._measured.height, self._measured.width)
        bent = self._measured.distorted
        match = self._depth_of[number]
        depth = read_depth(self._depth_files[match], self.depth_scale, size) if match >= 0 else None
        frame = PosedFrame(
            stamp_ns=stamp,
            seq=number,
            camera_id=self._options.camera_id,
            rgb=self._rectify(np.ascontiguousarray(rgb[..., ::-1])) if bent else rgb,
            depth_m=None if depth is None else self._rectify.nearest(depth),
            label=None,
            intrinsics=self._intrinsics,
            T_world_camera=check_frame_pose(pose, self._folder / "groundtruth.txt"),
        )
        return LoadedFrame(frame, None if bent else encoded)

    def _read_intrinsics(self) -> CameraIntrinsics:
        file = self._folder / "intrinsics.json"
        if file.exists():
            intrinsics, given, _ = read_intrinsics(file, self.notices, sorted((self._folder / "rgb").glob("*")))
            self.depth_scale = given or DEPTH_SCALE
            return intrinsics
        name = self._folder.resolve().name
        for key, calibration in _CALIBRATIONS.items():
            if key in name:
                return calibration
        self.notices.append("no intrinsics.json and no freiburg1, 2 or 3 in the name: the ROS default f = 525 is used")
        return _DEFAULT

    def _read_depth_list(self) -> list[tuple[int, Path]]:
        file = self._folder / "depth.txt"
        entries = self._read_list(file) if file.exists() else []
        if not entries:
            self.notices.append("no depth.txt, or no image in it: frames come without depth")
        return entries

    def _read_list(self, file: Path) -> list[tuple[int, Path]]:
        entries: list[tuple[int, Path]] = []
        seen: set[int | Path] = set()
        back = 0
        for line, text in read_lines(file):
            words = re.split(r"[,;\s]+", text.strip(), maxsplit=1)
            try:
                stamp_ns, picture = seconds_to_ns(words[0]), inside(self._folder, words[1].strip())
                if stamp_ns in seen or picture in seen:
                    raise ValueError("its stamp or file is there already")
            except (ValueError, IndexError, ImportSourceError) as error:
                self.notices.append(f"{file}, line {line} is passed over: expected 'stamp file' ({error})")
                continue
            back += bool(entries) and stamp_ns < entries[-1][0]
            seen |= {stamp_ns, picture}
            entries.append((stamp_ns, picture))
        if back:
            self.notices.append(f"{file}: stamps go back {counted(back, 'time')}; frames are sorted by them")
        return sorted(entries, key=lambda entry: entry[0])


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryFile:
    """What a trajectory file holds.

    Args:
        stamps_ns: (N,) rising.
        rows: (N, 7) tx ty tz qx qy qz qw.
        left_out: A sentence on every line that is passed over.
        remarks: Sentences on what is odd about the others.
    """

    stamps_ns: NDArray[np.int64]
    rows: Float64
    left_out: list[str]
    remarks: list[str]


def read_trajectory(file: Path) -> TrajectoryFile:
    """Read lines ``stamp tx ty tz qx qy qz qw``, stamps in seconds.

    Raises:
        ImportSourceError: the file is missing or holds no pose.
    """
    found: dict[int, list[float]] = {}
    left_out: list[str] = []
    remarks: list[str] = []
    first = ""
    back, last_ns = 0, -1
    for line, text in read_lines(file):
        words = split_row(text)
        try:
            stamp_ns, row = seconds_to_ns(words[0]), [float(word) for word in words[1:]]
            if len(row) != 7 or not np.isfinite(row).all():
                raise ValueError("not 3 numbers of a position and 4 of a unit quaternion")
            if abs(np.linalg.norm(row[3:]) - 1) > MAX_NORM_ERROR:
                raise ValueError(
                    f"its quaternion has length {np.linalg.norm(row[3:]):.3g}, not 1; the order is qx qy qz qw"
                )
            if found.get(stamp_ns, row) != row:
                raise ValueError("a second pose of this stamp; the first counts")
        except (ValueError, IndexError) as error:
            left_out.append(f"{file}, line {line} is passed over: {error}")
            first = first or f"; line {line}: {error}"
            continue
        back += stamp_ns < last_ns
        found[stamp_ns], last_ns = row, stamp_ns
    if not found:
        raise ImportSourceError(f"{file}: holds no pose 'stamp tx ty tz qx qy qz qw'{first}")
    if back:
        remarks.append(f"{file}: stamps go back {counted(back, 'time')}; poses are sorted by them")
    order = sorted(found)
    return TrajectoryFile(np.array(order, np.int64), np.array([found[s] for s in order], np.float64), left_out, remarks)


def match_nearest(a_ns: NDArray[np.int64], b_ns: NDArray[np.int64], within_ns: int) -> list[int]:
    """For each stamp of ``a`` the index of the nearest of ``b``, -1 = none; each of ``b`` goes to its nearest once.

    Args:
        a_ns, b_ns: (N,), (M,) rising.
        within_ns: Largest difference.
    """
    if not len(b_ns):
        return [-1] * len(a_ns)
    right = np.clip(np.searchsorted(b_ns, a_ns), 1, max(len(b_ns) - 1, 1))
    right = np.minimum(right, len(b_ns) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(b_ns[left] - a_ns) <= np.abs(b_ns[right] - a_ns), left, right)
    distance = np.abs(b_ns[nearest] - a_ns)
    result = [-1] * len(a_ns)
    taken: set[int] = set()
    for i in np.argsort(distance, kind="stable"):
        index = int(nearest[i])
        if distance[i] <= within_ns and index not in taken:
            taken.add(index)
            result[int(i)] = index
    return result


def _pose_at(stamp_ns: int, stamps_ns: NDArray[np.int64], rows: Float64, within_ns: int) -> Float64 | None:
    """Pose (4, 4) at a time: position linear, rotation spherical; None where there are no poses round that time.

    Args:
        stamp_ns: When.
        stamps_ns: (N,) rising.
        rows: (N, 7) tx ty tz qx qy qz qw.
        within_ns: How far from a single pose (before the first, after the last, at a gap) it still counts.
    """
    after = int(np.searchsorted(stamps_ns, stamp_ns))
    before = after - 1
    if before >= 0 and after < len(rows) and stamps_ns[after] - stamps_ns[before] <= _POSE_GAP_NS:
        fraction = float(stamp_ns - stamps_ns[before]) / float(stamps_ns[after] - stamps_ns[before])
        a, b = (pose_matrix(row[:3], row[3:]) for row in rows[[before, after]])
        return interpolate_pose(a, b, fraction)
    near = [i for i in (before, after) if 0 <= i < len(rows) and abs(int(stamps_ns[i]) - stamp_ns) <= within_ns]
    if not near:
        return None
    best = min(near, key=lambda i: abs(int(stamps_ns[i]) - stamp_ns))
    return pose_matrix(rows[best, :3], rows[best, 3:])
