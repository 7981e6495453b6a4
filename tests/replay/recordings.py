"""Small recordings in each foreign format, written to disk."""

import importlib
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation

from semantic_mapper.geometry import invert_pose, look_at
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.importers.base import ImportOptions, ImportReport
from semantic_mapper.replay.importers.run import import_recording
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.gps import GpsPosition, east_north_up
from semantic_mapper.types import Float64, PosedFrame

WIDTH, HEIGHT = 32, 24
INTRINSICS = {"width": WIDTH, "height": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "depth_scale": 1000.0}
CLASSES = {"0": "ignore", "1": "wall", "2": "floor", "5": "chair"}


def color(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """BGR, smooth, different for each frame."""
    v, u = np.mgrid[:height, :width]
    return np.stack((u * 255 // width, v * 255 // height, np.full_like(u, number * 20)), -1).astype(np.uint8)


def depth(number: int) -> np.ndarray:
    return (1000 + 10 * number + np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)).astype(np.uint16)


def label(number: int) -> np.ndarray:
    ids = np.array((0, 1, 2, 5), np.uint8)
    return ids[(np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) // 7 + number) % 4]


def pose(number: int) -> np.ndarray:
    angle = 0.1 * number
    T_world_camera = np.eye(4)
    T_world_camera[:2, :2] = ((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle)))
    T_world_camera[:3, 3] = (0.05 * number, -0.02 * number, 1.5)
    return T_world_camera


def write_image(file: Path, image: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), image)


def pose_row(number: int) -> str:
    return " ".join(repr(float(x)) for x in pose(number).ravel())


def make_folder(folder: Path, count: int = 6) -> Path:
    for i in range(count):
        write_image(folder / "color" / f"{i:06d}.jpg", color(i))
        write_image(folder / "depth" / f"{i:06d}.png", depth(i))
        write_image(folder / "label" / f"{i:06d}.png", label(i))
    (folder / "poses.txt").write_text("\n".join(pose_row(i) for i in range(count)) + "\n")
    (folder / "intrinsics.json").write_text(json.dumps(INTRINSICS))
    (folder / "labels.json").write_text(json.dumps({"id_space": "NYU40", "classes": CLASSES, "ignore": 0}))
    return folder


def make_tum(folder: Path, count: int = 6) -> Path:
    """30 Hz images, poses at 100 Hz turning about z; depth 4 ms after colour."""
    start = 1_305_031_102_175_304_000
    rgb, depths, truth = ["# color images"], ["# depth maps"], ["# timestamp tx ty tz qx qy qz qw"]
    for i in range(count):
        ns = start + i * 33_333_333
        write_image(folder / "rgb" / f"{seconds(ns)}.png", color(i))
        write_image(folder / "depth" / f"{seconds(ns + 4_000_000)}.png", depth(i) * 5)
        rgb.append(f"{seconds(ns)} rgb/{seconds(ns)}.png")
        depths.append(f"{seconds(ns + 4_000_000)} depth/{seconds(ns + 4_000_000)}.png")
    for k in range(-2, count * 4 + 2):
        ns = start + k * 10_000_000
        half = tum_angle(ns - start) / 2
        truth.append(f"{seconds(ns)} {(ns - start) / 1e9:.9f} 0 1.5 0 0 {np.sin(half):.12f} {np.cos(half):.12f}")
    for name, lines in (("rgb", rgb), ("depth", depths), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "intrinsics.json").write_text(json.dumps({**INTRINSICS, "depth_scale": 5000.0}))
    return folder


def tum_angle(ns: int) -> float:
    return 0.5 * ns / 1e9


def seconds(ns: int) -> str:
    return f"{ns // 10**9}.{ns % 10**9 // 1000:06d}"


def make_scannet(folder: Path, count: int = 6, step: int = 20) -> Path:
    """Colour and labels are twice as large as depth, as the sensor's are."""
    for i in range(count):
        n = i * step
        write_image(folder / "color" / f"{n}.jpg", color(i, 2 * WIDTH, 2 * HEIGHT))
        write_image(folder / "depth" / f"{n}.png", depth(i))
        large = np.repeat(np.repeat(label(i), 2, 0), 2, 1)
        write_image(folder / "label-filt" / f"{n}.png", large)
        (folder / "pose").mkdir(exist_ok=True)
        (folder / "pose" / f"{n}.txt").write_text("\n".join(" ".join(map(repr, row)) for row in pose(i).tolist()))
    (folder / "intrinsic").mkdir()
    write_matrix(folder / "intrinsic" / "intrinsic_depth.txt", 30.0, 31.0, 15.5, 11.5)
    # The same rays at twice the size; pixel centres are integers.
    write_matrix(folder / "intrinsic" / "intrinsic_color.txt", 60.0, 62.0, 31.5, 23.5)
    return folder


def write_matrix(file: Path, fx: float, fy: float, cx: float, cy: float) -> None:
    file.write_text(f"{fx} 0 {cx} 0\n0 {fy} {cy} 0\n0 0 1 0\n0 0 0 1\n")


def nyu40_color(name: str) -> tuple[int, int, int]:
    return NYU40.colors[NYU40.names.index(name)]


# Collections of posed pictures, and data sets.

W, H, F = 64, 48, 50.0
GL = np.diag((1.0, -1.0, -1.0, 1.0))


def poses(count: int = 3) -> list[Float64]:
    """A camera at 1.5 m that looks level along x, and walks to its right; z is up."""
    eye = np.array((0.0, 0.0, 1.5))
    step = np.array((0.0, -0.2, 0.0))
    return [look_at(eye + n * step, eye + n * step + (2.0, 0.1 * n, 0.0), np.eye(3)[2]) for n in range(count)]


def write_pictures(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for n, name in enumerate(names):
        picture = np.full((H, W, 3), (40 * n + 20) % 256, np.uint8)
        picture[H // 2 :, W // 4] = (0, 0, 255)
        assert cv2.imwrite(str(folder / name), picture)


def imported(src: Path, **options: Any) -> tuple[ImportReport, list[PosedFrame]]:
    dst = src.parent / "log.mcap"
    report = import_recording(src, dst, options=ImportOptions(**options), overwrite=True)
    with LogReader(dst) as log:
        return report, list(log)


def make_transforms(folder: Path, form: str = "frame_{:05d}.png", count: int = 3, **more: Any) -> Path:
    write_pictures(folder / "images", [form.format(n + 1) for n in range(count)])
    frames = [
        {"file_path": f"images/{form.format(n + 1)}", "transform_matrix": (T @ GL).tolist()}
        for n, T in enumerate(poses(count))
    ]
    given = {"fl_x": F, "fl_y": F, "cx": W / 2, "cy": H / 2, "w": W, "h": H, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(given))
    return folder


def add_depth(folder: Path) -> Path:
    """Depth images of half the size: 1.5 m and a millimetre more in each frame, without measurement above."""
    (folder / "depths").mkdir()
    found = json.loads((folder / "transforms.json").read_text())
    for n, frame in enumerate(found["frames"]):
        units = np.full((H // 2, W // 2), 1500 + n, np.uint16)
        units[: H // 4] = 0
        cv2.imwrite(str(folder / "depths" / f"{n}.png"), units)
        frame["depth_file_path"] = f"depths/{n}.png"
    (folder / "transforms.json").write_text(json.dumps(found))
    return folder


def quaternion(R: Float64) -> tuple[float, float, float, float]:
    """w x y z of a rotation."""
    x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
    return w, x, y, z


POINTS = np.array([(2.0, -0.3, 1.4), (2.5, 0.4, 1.7), (1.8, 0.0, 1.2)])


def make_colmap(folder: Path, kind: str) -> Path:
    """A model as COLMAP writes it, with the pictures beside it."""
    write_pictures(folder / "images", [f"{n}.png" for n in range(3)])
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(f"# Camera list\n1 SIMPLE_RADIAL {W} {H} {F} {W / 2} {H / 2} 0\n")
    rows = []
    for n, T in enumerate(poses()):
        pose = invert_pose(T)
        numbers = (*quaternion(pose[:3, :3]), *pose[:3, 3])
        rows.append(f"{n + 1} {' '.join(map(repr, map(float, numbers)))} 1 {n}.png")
        rows.append(" ".join(f"{10.5 + k} 20.5 {k + 1}" for k in range(3)) if n else "")
    (sparse / "images.txt").write_text("# Image list\n" + "\n".join(rows) + "\n")
    lines = [f"{k + 1} {x} {y} {z} 1 2 3 0.5 2 {k}" for k, (x, y, z) in enumerate(POINTS)]
    (sparse / "points3D.txt").write_text("\n".join(lines) + "\n")
    if kind == "bin":
        importlib.import_module("pycolmap").Reconstruction(sparse).write_binary(sparse)
        for file in (*sparse.glob("*.txt"), *sparse.glob("rigs.*"), *sparse.glob("frames.*")):
            file.unlink()
    return folder


def arkit(T: Float64) -> Float64:
    """Camera to world as ARKit has it, of a pose in a world with z up."""
    T_y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return T_y_up @ T @ GL


def make_polycam(folder: Path) -> Path:
    """A capture with corrected pictures and poses, a quarter second apart."""
    names = [str(5_000_000 + 250_000 * n) for n in range(3)]
    for kind in ("images", "corrected_images"):
        write_pictures(folder / "keyframes" / kind, [f"{name}.jpg" for name in names])
    for kind in ("cameras", "corrected_cameras", "depth", "confidence"):
        (folder / "keyframes" / kind).mkdir()
    for name, T in zip(names, poses(), strict=True):
        matrix = arkit(T)
        camera = {f"t_{i}{j}": float(matrix[i, j]) for i in range(3) for j in range(4)}
        camera |= {"fx": F, "fy": F, "cx": W / 2, "cy": H / 2, "width": W, "height": H, "blur_score": 90.0}
        (folder / "keyframes" / "corrected_cameras" / f"{name}.json").write_text(json.dumps(camera))
        confidence = np.full((H // 4, W // 4), 255, np.uint8)
        confidence[:, 0] = 0
        cv2.imwrite(str(folder / "keyframes" / "depth" / f"{name}.png"), np.full((H // 4, W // 4), 1250, np.uint16))
        cv2.imwrite(str(folder / "keyframes" / "confidence" / f"{name}.png"), confidence)
    return folder


def make_record3d(folder: Path, **changes: Any) -> Path:
    write_pictures(folder / "rgb", [f"{n}.jpg" for n in range(3)])
    rows = []
    for T in poses():
        w, x, y, z = quaternion(arkit(T)[:3, :3])
        rows.append([x, y, z, w, *arkit(T)[:3, 3].tolist()])
    given = {"w": W, "h": H, "fps": 4, "K": [F, 0, 0, 0, F, 0, W / 2, H / 2, 1], "poses": rows}
    (folder / "metadata.json").write_text(json.dumps({**given, **changes}))
    return folder


ORIGIN = GpsPosition(-33.8568, 151.2153, 40.0)  # south and east


METRES_PER_DEGREE = 111_000.0


def flight(count: int = 12) -> Float64:
    """Poses (N, 4, 4) of a circle of 20 m, 30 m above the ground, looking at its middle; x east, y north, z up."""
    angles = np.arange(count) * 2 * np.pi / count
    eyes = np.stack((20 * np.cos(angles), 20 * np.sin(angles), 30 + 2 * np.sin(3 * angles)), axis=1)
    return np.stack([look_at(eye, np.zeros(3), np.eye(3)[2]) for eye in eyes])


def positions_of(enu: Float64) -> list[GpsPosition]:
    """Where places (N, 3) near ``ORIGIN`` are; exact to a millimetre by a few steps of Newton's method."""
    guess = np.zeros_like(enu)
    for _ in range(4):
        found = [
            GpsPosition(
                ORIGIN.latitude + n / METRES_PER_DEGREE, ORIGIN.longitude + e / METRES_PER_DEGREE, ORIGIN.altitude_m + u
            )
            for e, n, u in guess
        ]
        guess += (enu - east_north_up(found, ORIGIN)) * ([1 / np.cos(np.radians(ORIGIN.latitude)), 1, 1])
    return found


def tag(file: Path, position: GpsPosition, **changes: Any) -> None:
    """Write a position into a JPEG's EXIF data, as cameras do."""

    def angle(degrees: float) -> tuple[IFDRational, ...]:
        whole, minutes = int(abs(degrees)), abs(degrees) % 1 * 60
        millionths = IFDRational(round(minutes % 1 * 60 * 1_000_000), 1_000_000)
        return IFDRational(whole), IFDRational(int(minutes)), millionths

    image = Image.open(file)
    exif = image.getexif()
    found = {
        1: "N" if position.latitude >= 0 else "S",
        2: angle(position.latitude),
        3: "E" if position.longitude >= 0 else "W",
        4: angle(position.longitude),
        5: b"\x01" if position.altitude_m < 0 else b"\x00",
        6: IFDRational(round(abs(position.altitude_m) * 1000), 1000),
    }
    exif.get_ifd(0x8825).update({key: value for key, value in found.items() if key not in changes.get("without", ())})
    image.save(file, exif=exif, quality=95)


def picture(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((H, W, 3), 90, np.uint8)).save(file)
    return file


def make_opensfm(folder: Path, poses: Float64, **camera: Any) -> Path:
    """A project with its reconstruction, as OpenSfM writes it."""
    lens = {"projection_type": "perspective", "focal": F / W, "k1": 0.0, "k2": 0.0, "focal_prior": 0.85}
    shots = {}
    for n, T in enumerate(poses):
        name = f"DJI_{n}.JPG"
        picture(folder / "images" / name)
        T_camera_world = invert_pose(T)
        shots[name] = {
            "rotation": cv2.Rodrigues(T_camera_world[:3, :3])[0].ravel().tolist(),
            "translation": T_camera_world[:3, 3].tolist(),
            "camera": "v2 dji",
            "orientation": 1,
            "capture_time": 0.0,
            "gps_dop": 5.0,
        }
    points = {str(n): {"coordinates": [n - 4.0, 0.5 * n, 0.0], "color": [1.0, 2.0, 3.0]} for n in range(9)}
    model = {
        "cameras": {"v2 dji": {"width": W, "height": H, **lens, **camera}},
        "shots": shots,
        "points": points,
        "reference_lla": {"latitude": 52.5, "longitude": 13.4, "altitude": 35.0},
    }
    (folder / "reconstruction.json").write_text(json.dumps([model]))
    return folder


DRIVE = "2013_05_28_drive_0000_sync"


PERSPECTIVE = """calib_time: 18-Dec-2013 10:13:35
corner_dist: 9.950000e-02
S_00: 1.408000e+03 5.120000e+02
K_00: 7.884311e+02 0.0 6.873046e+02 0.0 7.867554e+02 2.437552e+02 0.0 0.0 1.0
R_rect_00: 0.999974 -0.007141 -0.000089 0.007141 0.999969 -0.003247 0.000112 0.003247 0.999995
P_rect_00: 52.554261 0.0 31.049453 0.0 0.0 52.554261 11.769549 0.0 0.0 0.0 1.0 0.0
S_rect_00: {w}.0 {h}.0
R_rect_01: 0.999778 0.012120 -0.017290 -0.012117 0.999926 0.000302 0.017292 -0.000092 0.999850
P_rect_01: 52.554261 0.0 31.049453 -31.2269 0.0 52.554261 11.769549 0.0 0.0 0.0 1.0 0.0
S_rect_01: {w}.0 {h}.0
"""


def make_replica(folder: Path, count: int = 3, width: int = 640, height: int = 480) -> Path:
    sequence = folder / "room_0" / "Sequence_1"
    for i in range(count):
        write_image(sequence / f"rgb/rgb_{i}.png", color(i, width, height))
        write_image(sequence / f"depth/depth_{i}.png", np.full((height, width), 1500 + i, np.uint16))
        label = np.full((height, width), (0, 3, 93)[i % 3], np.uint8)
        label[0] = 97
        write_image(sequence / f"semantic_class/semantic_class_{i}.png", label)
    (sequence / "traj_w_c.txt").write_text("\n".join(pose_row(i) for i in range(count)) + "\n")
    classes = [{"id": 3, "name": "basket"}, {"id": 93, "name": "wall"}, {"id": 97, "name": "window"}]
    info = {"classes": classes, "objects": [{"class_id": 93, "id": 1}], "id_to_label": [-1, 93]}
    (folder / "room_0" / "habitat").mkdir()
    (folder / "room_0" / "habitat" / "info_semantic.json").write_text(json.dumps(info))
    return sequence


def make_kitti360(root: Path, numbers: tuple[int, ...] = (250, 251, 252), width: int = 64, height: int = 24) -> Path:
    (root / "calibration").mkdir(parents=True)
    (root / "calibration" / "perspective.txt").write_text(PERSPECTIVE.format(w=width, h=height))
    times = [f"2013-05-28 08:46:{i // 10:02d}.{i % 10}04547200" for i in range(max(numbers) + 1)]
    for camera in ("image_00", "image_01"):
        raw = root / "data_2d_raw" / DRIVE / camera
        for i in numbers:
            write_image(raw / f"data_rect/{i:010d}.png", color(i % 10 + (camera == "image_01"), width, height))
            label = np.full((height, width), 7, np.uint8)
            label[0], label[1], label[2, :] = 26, 0, 42
            write_image(root / f"data_2d_semantics/train/{DRIVE}/{camera}/semantic/{i:010d}.png", label)
        (raw / "timestamps.txt").write_text("\n".join(times) + "\n")
    poses = root / "data_poses" / DRIVE
    poses.mkdir(parents=True)
    rows = [f"{i} {pose_row(i - 250)} " for i in numbers if i != 251]  # the car has no pose for some images
    (poses / "cam0_to_world.txt").write_text("\n".join(rows) + "\n")
    return root


def add_scans(root: Path, points: np.ndarray, numbers: tuple[int, ...] = (250,)) -> Path:
    """A scan of ``points`` (N, 3), in the scanner's axes: ahead, left, up; it stands 0.5 m above the camera."""
    scans = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    for i in numbers:
        np.concatenate((points, np.ones((len(points), 1))), axis=1).astype("<f4").tofile(scans / f"{i:010d}.bin")
    (root / "calibration" / "calib_cam_to_velo.txt").write_text("0 0 1 0 -1 0 0 0 0 -1 0 -0.5\n")
    return scans


def change_json(file: Path, **more: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **more}))


def said(report: Any) -> str:
    return " ".join(report.notices)
