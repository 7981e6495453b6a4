"""KITTI-360: one drive, its two rectified perspective cameras, and the depth that its laser scanner gives them.

The layout is that of https://www.cvlibs.net/datasets/kitti-360/documentation.php ("Folder Structure", "Calibration",
"Camera Poses"). ``cam0_to_world.txt`` has ``T_world_camera`` of the rectified left camera; not every frame has one.
Depth comes from the laser scans (float32 x y z reflectance a point, in the scanner's axes), where they are there, by
way of ``calib_cam_to_velo.txt`` (3x4, unrectified left camera -> scanner) and ``R_rect_00``. The scanner reaches 2
degrees above the horizon; its scans are not corrected for the car's motion.

Class ids, names and colours are those of ``kitti360scripts/helpers/labels.py`` in
https://github.com/autonomousvision/kitti360Scripts, but for its category "void", which is read as unknown.
"""

from contextlib import suppress
from pathlib import Path

import numpy as np

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import camera_matrix, invert_pose, transform
from semantic_mapper.labels import LabelSet
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import (
    BadFrameError,
    DepthScale,
    ImportOptions,
    camera_of,
    check_label,
    depth_of_points,
    read_bytes,
    read_plane,
)
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

CAMERAS = ("image_00", "image_01")
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


def open_kitti360(folder: Path, options: ImportOptions) -> PosedPictures:
    """A drive, opened; a frame for each image of the left camera and, where they are there, of the right one.

    ``folder`` is the root with one drive, or the drive's in ``data_2d_raw``; cameras are called as their folders are.
    Raises ImportSourceError: calibration, images or poses are missing or cannot be understood.
    """
    notices: list[str] = []
    root, drive = find_drive(folder)
    raw, semantics = root / "data_2d_raw" / drive, root / "data_2d_semantics" / "train" / drive
    files = {name: tables.numbered_files(raw / name / "data_rect", (".png",), notices) for name in CAMERAS}
    cameras = [name for name in CAMERAS if files[name]]
    if not cameras:
        raise ImportSourceError(
            f"{raw / CAMERAS[0] / 'data_rect'}: no rectified images; download 'Perspective Images' of this drive"
        )
    calibration = root / "calibration" / "perspective.txt"
    rectified = {name: _rectified_camera(calibration, name[-2:]) for name in cameras}
    scans_folder = root / "data_3d_raw" / drive / "velodyne_points" / "data"
    scans = tables.numbered_files(scans_folder, (".bin",), notices)
    if not scans:
        notices.append(f"no laser scans of {scans_folder}: frames come without depth")
    T_cam0_scanner = _scanner_pose(calibration) if scans else np.eye(4)
    poses_file = root / "data_poses" / drive / "cam0_to_world.txt"
    poses = _read_poses(poses_file, notices)
    labels = {name: tables.numbered_files(semantics / name / "semantic", (".png",), notices) for name in cameras}
    if not any(labels.values()):
        notices.append(f"no labels: {semantics} has no semantic/; test drives have none")

    pictures: list[PosedPicture] = []
    for name in cameras:
        intrinsics, T_cam0_camera = rectified[name]
        stamps = tables.read_stamps(raw / name / "timestamps.txt", max(files[name]) + 1, NOMINAL_HZ, notices)
        for number, file in files[name].items():
            pose = poses.get(number)
            if pose is None:
                pose = BadFrameError(poses_file, f"has no pose for image {number}; the drive has poses where it moved")
            else:
                pose = pose @ T_cam0_camera
            pictures.append(
                PosedPicture(
                    file,
                    intrinsics,
                    pose,
                    stamps[number],
                    depth_file=scans.get(number),
                    label_file=labels[name].get(number),
                    seq=number,
                    camera_id=name,
                )
            )
    pictures.sort(key=lambda picture: (picture.seq, picture.camera_id))  # the two cameras fire together

    def read_depth(picture: PosedPicture, _: Rectifier) -> Float32:
        assert picture.depth_file is not None
        data = read_bytes(picture.depth_file)
        if len(data) % 16:
            raise BadFrameError(picture.depth_file, "a scan has 16 bytes a point, this one has not; download it again")
        points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
        intrinsics, T_cam0_camera = rectified[picture.camera_id]
        T_camera_scanner = invert_pose(T_cam0_camera) @ T_cam0_scanner
        return depth_of_scan(points, T_camera_scanner, intrinsics)

    return PosedPictures(
        f"kitti360 {drive}",
        pictures,
        options,
        DepthScale(1000.0, convention="depth comes from laser scans, in metres"),
        notices,
        hz=NOMINAL_HZ,
        labels=LABELS if any(labels.values()) else None,
        read_label=_read_semantics,
        read_depth=read_depth,
    )


def _read_poses(file: Path, notices: list[str]) -> dict[int, Float64]:
    """``T_world_cam0`` by the number of the image."""
    poses: dict[int, Float64] = {}
    bad: list[str] = []
    for line, text in tables.read_lines(file):
        try:
            index, *numbers = tables.split_row(text)
            T_world_cam0 = np.array([float(n) for n in numbers], np.float64).reshape(4, 4)
            poses.setdefault(int(float(index)), T_world_cam0)
        except (ValueError, OverflowError) as error:
            bad.append(f"{file}, line {line}: {error}")
    if not poses:
        raise ImportSourceError(
            f"{file}: holds no pose: no row of a frame number and the 16 numbers of a 4x4 matrix"
            f"{' (' + bad[0] + ')' if bad else ''}; poses.txt, with 12, is another file"
        )
    notices += tables.left_out_notice("pose", bad)
    return poses


def find_drive(folder: Path) -> tuple[Path, str]:
    """Root of the data set and name of the drive.

    Raises ImportSourceError: several drives, none, or a folder of another kind.
    """
    folder = folder.resolve()
    if folder.parent.name == "data_2d_raw":
        return folder.parent.parent, folder.name
    drives = sorted(path.name for path in (folder / "data_2d_raw").glob("*_drive_*_sync") if path.is_dir())
    if len(drives) == 1:
        return folder, drives[0]
    raise ImportSourceError(
        f"{folder / 'data_2d_raw'}: holds {len(drives)} drives (2013_05_28_drive_0000_sync or the like); name the "
        f"folder of one: {', '.join(drives) or 'no folder fits'}"
    )


def _calibrated(file: Path, name: str, count: int) -> Float64:
    """Numbers of the line of a calibration file that begins with a name, or of the only line, without one."""
    for _, text in tables.read_lines(file):
        label, colon, numbers = text.rpartition(":")
        if label.strip() == name and (colon or not name):
            with suppress(ValueError):
                values = np.array(tables.read_numbers(numbers), np.float64)
                if len(values) == count and np.isfinite(values).all():
                    return values
    wanted = f"'{name}:' with {count} numbers" if name else f"{count} numbers"
    raise ImportSourceError(f"{file}: needs {wanted}; download it again")


def _rectified_camera(file: Path, which: str) -> tuple[CameraIntrinsics, Float64]:
    """Intrinsics of the rectified camera "00" or "01", and ``T_cam0_camera`` (4, 4)."""
    P = _calibrated(file, f"P_rect_{which}", 12).reshape(3, 4)
    width, height = _calibrated(file, f"S_rect_{which}", 2)
    intrinsics = camera_of(f"{file}: P_rect_{which} and S_rect_{which}", P[[0, 1, 0, 1], [0, 1, 2, 2]], (width, height))
    T_cam0_camera = np.eye(4)
    # P = K [I | t] takes points of the left camera
    T_cam0_camera[:3, 3] = -np.linalg.solve(camera_matrix(intrinsics), P[:, 3])
    return intrinsics, T_cam0_camera


def _scanner_pose(file: Path) -> Float64:
    """T_cam0_scanner (4, 4): the scanner in the rectified left camera."""
    T_scanner_camera, T_cam0_raw = np.eye(4), np.eye(4)
    T_scanner_camera[:3] = _calibrated(file.with_name("calib_cam_to_velo.txt"), "", 12).reshape(3, 4)
    T_cam0_raw[:3, :3] = _calibrated(file, "R_rect_00", 9).reshape(3, 3)
    return T_cam0_raw @ invert_pose(T_scanner_camera)


def _read_semantics(file: Path, labels: LabelSet, size: tuple[int, int]) -> UInt8:
    """Label image (H, W) with the ids of the data set; those of its category "void" become 0."""
    ids = read_plane(file, "uint8", size, "label").astype(np.uint8)
    ids[np.isin(ids, _VOID)] = labels.ignore_id
    return check_label(ids, labels, file)


def depth_of_scan(points: Float64, T_camera_scanner: Float64, intrinsics: CameraIntrinsics) -> Float32:
    """Depth image (H, W) of a scan, (N, 3) in the scanner's axes; 0 where no beam went.

    A point fills the pixels between its beam and the next ones, the nearest point wins: so what the camera does not see
    but the scanner on the roof does is hidden by what stands before it.
    """
    p = transform(T_camera_scanner, points)
    p = p[np.isfinite(p).all(axis=1) & (p[:, 2] > MIN_SCAN_M)]
    focals = (intrinsics.fx, intrinsics.fy)
    across, up = (int(np.ceil((f * step - 1) / 2)) for f, step in zip(focals, BEAM_STEP_RAD, strict=True))
    return depth_of_points(p, intrinsics, (across, up))
