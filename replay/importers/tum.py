"""TUM RGB-D sequences, and data sets that are published much like them: Bonn RGB-D Dynamic and ICL-NUIM.

Each colour image gets the depth image nearest in time (each depth image once) and the pose interpolated between its two
neighbours. A frame without a depth image within 20 ms comes without depth, and one without a pose is left out. Depth is
registered to colour, with 5000 units per metre where ``intrinsics.json`` does not give another ``depth_scale``.
Intrinsics come from ``intrinsics.json`` where the folder has one (same layout as in a sequence folder), else from the
calibration published for freiburg1, 2 or 3, by the folder's name, else the default of the sensor's ROS driver.

Bonn (https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset) gives poses of the markers on the sensor, in which the
camera's place is ``T_ros^-1 @ pose @ T_ros @ T_m``. The published ``T_m`` enlarges by 1.059: it brings what the sensor
measures to the metres of the motion capture. Here depth is enlarged, and poses are rigid.

ICL-NUIM (https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html) numbers its frames. Its camera has fy = -480: y is up in
camera and world, whose axes are left-handed. Both are mirrored here, so that z is up in the world.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import interpolate_pose, nearest_pose, pose_matrix
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import MATCH_NS, BadFrameError, DepthScale, ImportOptions
from semantic_mapper.replay.importers.folder import read_intrinsics
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics, Float64

DEPTH_SCALE = DepthScale(5000.0, convention="TUM's; another one belongs into intrinsics.json as depth_scale")
ICL_SCALE = DepthScale(5000.0, convention="ICL-NUIM's")
_POSE_GAP_NS = 200_000_000  # poses come at 100 Hz; over a longer gap nothing is interpolated
_HZ = 30.0

_CALIBRATIONS = {
    "freiburg1": CameraIntrinsics(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": CameraIntrinsics(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": CameraIntrinsics(535.4, 539.2, 320.1, 247.6, 640, 480),  # its images are rectified
    "rgbd_bonn": CameraIntrinsics(
        542.822841, 542.57687, 315.59352, 237.756098, 640, 480, (0.039903, -0.099343, -0.00073, -0.000144)
    ),
}
_DEFAULT = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)

# Bonn's, as published.
_T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # its own inverse
_T_M = np.array([[1.0157, 0.1828, -0.2389, 0.0113], [0.0009, -0.8431, -0.6413, -0.0098],
                 [-0.3009, 0.6147, -0.8085, 0.0111], [0, 0, 0, 1]])  # fmt: skip
_ENLARGED = float(np.cbrt(np.linalg.det(_T_M[:3, :3])))
BONN_SCALE = DepthScale(5000.0 / _ENLARGED, convention=f"Bonn's 5000, and its T_m that enlarges by {_ENLARGED:.4f}")

_ICL = CameraIntrinsics(481.2, 480.0, 319.5, 239.5, 640, 480)
_Y_DOWN = np.diag((1.0, -1.0, 1.0, 1.0))  # of the camera
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of the world: y and z change places


def open_tum(folder: Path, options: ImportOptions) -> PosedPictures:
    """A TUM sequence, opened; one frame for each line of ``rgb.txt``.

    Raises ImportSourceError: a list is missing or holds nothing that can be used.
    """
    notices: list[str] = []
    name = folder.resolve().name
    if "_frei_png" in name:
        raise ImportSourceError(
            f"{folder}: is ICL-NUIM as TUM's; its poses are of other axes: unpack it again, with associations.txt and "
            "*.gt.freiburg as published"
        )
    intrinsics, depth_scale, scale_from = _intrinsics(folder, notices)
    T_marker_camera = _T_M.copy()
    T_marker_camera[:3, :3] /= _ENLARGED
    T_marker_camera = nearest_pose(T_marker_camera)  # it is of few digits
    color = _read_list(folder / "rgb.txt", notices)
    if not color:
        raise ImportSourceError("; ".join((f"{folder / 'rgb.txt'}: holds no line 'stamp file'", *notices[-1:])))
    depth = _read_list(folder / "depth.txt", notices) if (folder / "depth.txt").exists() else []
    if not depth:
        scale_from = ""
        notices.append("no depth.txt, or no image in it: frames come without depth")
    stamps_ns, poses, left_out = read_trajectory(folder / "groundtruth.txt")
    notices += tables.left_out_notice("pose", left_out)
    color_ns, depth_ns = (np.array([stamp for stamp, _ in rows], np.int64) for rows in (color, depth))
    matches = match_nearest(color_ns, depth_ns, MATCH_NS)
    pictures: list[PosedPicture] = []
    for (stamp, file), match in zip(color, matches, strict=True):
        pose = pose_at(stamp, stamps_ns, poses, _POSE_GAP_NS)
        if pose is None:
            pose = BadFrameError(file, f"groundtruth.txt has no pose near its time {stamp / 1e9:.6f}")
        elif "rgbd_bonn" in name:
            pose = _T_ROS @ pose @ _T_ROS @ T_marker_camera
        pictures.append(PosedPicture(file, intrinsics, pose, stamp, depth[match][1] if match >= 0 else None))
    return PosedPictures(f"tum {name}", pictures, options, depth_scale, notices, scale_from=scale_from, hz=_HZ)


def open_icl(folder: Path, options: ImportOptions) -> PosedPictures:
    """A sequence of ICL-NUIM in its variant for TUM's tools, opened; one frame for each line of ``associations.txt``.

    Raises ImportSourceError: lists or poses are missing, or poses are there twice.
    """
    notices: list[str] = []
    listed, truths = folder / "associations.txt", sorted(folder.glob("*.gt.freiburg"))
    if len(truths) != 1:
        raise ImportSourceError(f"{folder}: has {len(truths)} files *.gt.freiburg; keep the one of these pictures")
    stamps_ns, rows, left_out = read_trajectory(truths[0])
    notices += tables.left_out_notice("pose", left_out)
    poses = dict(zip((stamps_ns // 1_000_000_000).tolist(), rows, strict=True))

    def picture_of(numbered: tuple[int, str]) -> PosedPicture:
        line, text = numbered
        try:
            number, depth, _, color = text.split()
            row = poses.get(int(number))
        except ValueError as error:
            raise ImportSourceError(f"{listed}, line {line}: expected 'number depth number colour'") from error
        pose = BadFrameError(truths[0], f"has no pose for image {number}")
        if row is not None:
            pose = _Z_UP @ pose_matrix(row[:3], row[3:]) @ _Y_DOWN
        stamp_ns = round(int(number) * 1e9 / _HZ)
        return PosedPicture(
            tables.inside(folder, color), _ICL, pose, stamp_ns, tables.inside(folder, depth), seq=int(number)
        )

    pictures = tables.keep_good(picture_of, tables.read_lines(listed), "line", notices)
    return PosedPictures(f"icl {folder.resolve().name}", pictures, options, ICL_SCALE, notices, hz=_HZ)


def _intrinsics(folder: Path, notices: list[str]) -> tuple[CameraIntrinsics, DepthScale, str]:
    """Intrinsics, depth scale, and what of them is assumed though the data set may be another one."""
    file = folder / "intrinsics.json"
    usual = BONN_SCALE if "rgbd_bonn" in folder.resolve().name else DEPTH_SCALE
    if file.exists():
        intrinsics, given, _ = read_intrinsics(file, notices, sorted((folder / "rgb").glob("*")))
        return intrinsics, given or usual, "" if given or usual is BONN_SCALE else f"depth of {usual}"
    known = next((k for name, k in _CALIBRATIONS.items() if name in folder.resolve().name), None)
    if known is not None:
        return known, usual, ""
    notices.append(
        "no intrinsics.json, and no freiburg1, 2, 3 or rgbd_bonn in the name: the ROS default f = 525 is used"
    )
    return _DEFAULT, usual, f"a camera of f = 525 and depth of {usual}"


def _read_list(file: Path, notices: list[str]) -> list[tuple[int, Path]]:
    """Stamps and files of a list, sorted by the stamps."""
    entries: dict[int, Path] = {}
    left_out: list[str] = []
    for line, text in tables.read_lines(file):
        words = re.split(r"[,;\s]+", text.strip(), maxsplit=1)
        try:
            stamp_ns, picture = tables.seconds_to_ns(words[0]), tables.inside(file.parent, words[1].strip())
            if stamp_ns in entries:
                raise ValueError("its stamp is there already")
        except (ValueError, IndexError, ImportSourceError) as error:
            left_out.append(f"{file}, line {line}: expected 'stamp file' ({error})")
            continue
        entries[stamp_ns] = picture
    notices += tables.left_out_notice("line", left_out)
    return sorted(entries.items())


def read_trajectory(file: Path) -> tuple[NDArray[np.int64], Float64, list[str]]:
    """Read lines ``stamp tx ty tz qx qy qz qw``, stamps in seconds.

    Gives stamps (N,) in nanoseconds, rising, rows (N, 7) tx ty tz qx qy qz qw, and why other lines are left out. Raises
    ImportSourceError: the file is missing or holds no pose.
    """
    found: dict[int, list[float]] = {}
    left_out: list[str] = []
    for line, text in tables.read_lines(file):
        words = tables.split_row(text)
        try:
            stamp_ns, row = tables.seconds_to_ns(words[0]), [float(word) for word in words[1:]]
            if len(row) != 7 or not np.isfinite(row).all():
                raise ValueError("not 3 numbers of a position and 4 of a unit quaternion")
            if abs(np.linalg.norm(row[3:]) - 1) > tables.MAX_NORM_ERROR:
                raise ValueError(
                    f"its quaternion has length {np.linalg.norm(row[3:]):.3g}, not 1; the order is qx qy qz qw"
                )
            if found.setdefault(stamp_ns, row) != row:
                raise ValueError("a second pose of this stamp; the first counts")
        except ValueError as error:
            left_out.append(f"{file}, line {line}: {error}")
    if not found:
        raise ImportSourceError("; ".join((f"{file}: holds no pose 'stamp tx ty tz qx qy qz qw'", *left_out[:1])))
    order = sorted(found)
    return np.array(order, np.int64), np.array([found[s] for s in order], np.float64), left_out


def match_nearest(a_ns: NDArray[np.int64], b_ns: NDArray[np.int64], within_ns: int) -> list[int]:
    """For each stamp of ``a`` the index of the nearest of ``b``, -1 = none; each of ``b`` goes to its nearest once.

    Both are rising; ``within_ns`` is the largest difference.
    """
    if not len(b_ns):
        return [-1] * len(a_ns)
    nearest = np.searchsorted(b_ns[:-1] + np.diff(b_ns) // 2, a_ns)
    distance = np.abs(b_ns[nearest] - a_ns)
    order = np.argsort(distance, kind="stable")
    order = order[distance[order] <= within_ns]
    taken = order[np.unique(nearest[order], return_index=True)[1]]  # of each of ``b`` the nearest
    result = np.full(len(a_ns), -1)
    result[taken] = nearest[taken]
    return result.tolist()


def pose_at(
    stamp_ns: int, stamps_ns: NDArray[np.int64], rows: Float64, max_gap_ns: int, within_ns: int = MATCH_NS
) -> Float64 | None:
    """Pose (4, 4) at a time: position linear, rotation spherical; None where there are no poses round that time.

    Stamps (N,) rise; rows (N, 7) are tx ty tz qx qy qz qw. Nothing is interpolated
    between two that are more than ``max_gap_ns`` apart: there, before the first and after the last pose, the nearest
    one within ``within_ns`` counts.
    """
    after = int(np.searchsorted(stamps_ns, stamp_ns))
    before = after - 1
    if before >= 0 and after < len(rows) and stamps_ns[after] - stamps_ns[before] <= max_gap_ns:
        fraction = float(stamp_ns - stamps_ns[before]) / float(stamps_ns[after] - stamps_ns[before])
        a, b = (pose_matrix(row[:3], row[3:]) for row in rows[[before, after]])
        return interpolate_pose(a, b, fraction)
    near = [i for i in (before, after) if 0 <= i < len(rows) and abs(int(stamps_ns[i]) - stamp_ns) <= within_ns]
    best = min(near, key=lambda i: abs(int(stamps_ns[i]) - stamp_ns), default=None)
    return None if best is None else pose_matrix(rows[best, :3], rows[best, 3:])
