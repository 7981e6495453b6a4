"""Replica as rendered for Semantic-NeRF, and KITTI-360: small folders in the published layouts."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers import ImportOptions, detect_format, import_recording
from semantic_mapper.replay.importers.kitti360 import LABELS, depth_of_scan
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import CameraIntrinsics
from tests.replay import recordings as rec

DRIVE = "2013_05_28_drive_0000_sync"
W, H = 640, 480
# The published file with a size, focal length and centre of small images; the right camera stands 0.594 m to the right.
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


def make_replica(folder: Path, count: int = 3, width: int = W, height: int = H) -> Path:
    sequence = folder / "room_0" / "Sequence_1"
    for i in range(count):
        rec.write_image(sequence / f"rgb/rgb_{i}.png", rec.color(i, width, height))
        rec.write_image(sequence / f"depth/depth_{i}.png", np.full((height, width), 1500 + i, np.uint16))
        label = np.full((height, width), (0, 3, 93)[i % 3], np.uint8)
        label[0] = 97
        rec.write_image(sequence / f"semantic_class/semantic_class_{i}.png", label)
    (sequence / "traj_w_c.txt").write_text("\n".join(rec.pose_row(i) for i in range(count)) + "\n")
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
            rec.write_image(raw / f"data_rect/{i:010d}.png", rec.color(i % 10 + (camera == "image_01"), width, height))
            label = np.full((height, width), 7, np.uint8)
            label[0], label[1], label[2, :] = 26, 0, 42
            rec.write_image(root / f"data_2d_semantics/train/{DRIVE}/{camera}/semantic/{i:010d}.png", label)
        (raw / "timestamps.txt").write_text("\n".join(times) + "\n")
    poses = root / "data_poses" / DRIVE
    poses.mkdir(parents=True)
    rows = [f"{i} {rec.pose_row(i - 250)} " for i in numbers if i != 251]  # the car has no pose for some images
    (poses / "cam0_to_world.txt").write_text("\n".join(rows) + "\n")
    return root


def test_a_replica_sequence_is_imported_without_loss(tmp_path: Path) -> None:
    sequence = make_replica(tmp_path)
    report = import_recording(sequence, tmp_path / "log.mcap")
    assert (report.format, report.frames, report.labelled, report.skipped) == ("replica", 3, 3, ())
    with LogReader(tmp_path / "log.mcap") as log:
        k = log.info.cameras["camera"]
        assert (k.width, k.height, k.cx, k.cy) == (640, 480, 319.5, 239.5)
        assert k.fx == k.fy == pytest.approx(320.0)
        assert log.info.source == "replica room_0 Sequence_1"
        assert log.info.label_set is not None and log.info.label_set.ids == (3, 93, 97)
        assert log.info.label_set.names == ("basket", "wall", "window")
        for i, frame in enumerate(log):
            assert np.array_equal(frame.rgb[..., ::-1], rec.color(i, W, H))
            assert frame.depth_m is not None and (frame.depth_m == np.float32(1500 + i) / np.float32(1000)).all()
            assert np.array_equal(frame.T_world_camera, rec.pose(i)) and frame.stamp_ns == round(i * 1e9 / 30)
            assert frame.label is not None and frame.label[0, 0] == 97 and frame.label[1, 1] == (0, 3, 93)[i]


def test_what_is_wrong_with_a_replica_sequence_is_told(tmp_path: Path) -> None:
    sequence = make_replica(tmp_path, 3, 64, 48)
    with pytest.raises(ImportSourceError, match=r"is a scene of Replica; name one sequence: .*Sequence_1"):
        detect_format(sequence.parent)
    info = sequence.parent / "habitat" / "info_semantic.json"
    (sequence / "depth" / "depth_1.png").unlink()
    label = np.full((48, 64), 55, np.uint8)
    rec.write_image(sequence / "semantic_class" / "semantic_class_2.png", label)
    report = import_recording(sequence, tmp_path / "log.mcap")
    told = {s.frame: f"{s.file.name}: {s.reason}" for s in report.skipped}
    assert "semantic_class_2.png" in told[2] and "55" in told[2]
    assert (report.frames, report.with_depth, report.labelled) == (3, 2, 2)
    info.rename(sequence.parent / "info_semantic.json")
    assert import_recording(sequence, tmp_path / "beside.mcap").labelled == 2
    (sequence.parent / "info_semantic.json").write_text('{"classes": [{"id": "three"}]}')
    with pytest.raises(ImportSourceError, match=r"info_semantic\.json.*int"):
        import_recording(sequence, tmp_path / "x.mcap")
    (sequence.parent / "info_semantic.json").unlink()
    report = import_recording(sequence, tmp_path / "unnamed.mcap")
    assert report.labelled == 0 and "info_semantic.json, which names its classes" in report.notices[0]
    (sequence / "traj_w_c.txt").write_text(rec.pose_row(0))
    with pytest.raises(ImportSourceError, match=r"traj_w_c\.txt: has 1 rows, images go up to rgb_2"):
        import_recording(sequence, tmp_path / "x.mcap")


def test_a_kitti360_drive_is_imported_with_both_cameras(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    assert detect_format(root) == detect_format(root / "data_2d_raw" / DRIVE) == "kitti360"
    report = import_recording(root, tmp_path / "log.mcap")
    assert (report.frames, report.labelled) == (4, 4) and "without depth" in report.notices[0]
    assert [(s.frame, s.file.name) for s in report.skipped] == [(2, "cam0_to_world.txt"), (3, "cam0_to_world.txt")]
    with LogReader(tmp_path / "log.mcap") as log:
        frames = list(log)
        assert [(f.camera_id, f.seq) for f in frames] == [
            ("image_00", 250),
            ("image_01", 250),
            ("image_00", 252),
            ("image_01", 252),
        ]
        for f in frames:
            assert f.depth_m is None and (f.intrinsics.fx, f.intrinsics.cx) == (52.554261, 31.049453)
            assert (f.intrinsics.width, f.intrinsics.height) == (64, 24) and log.info.cameras[f.camera_id]
            seconds = f.seq // 10
            second = datetime(2013, 5, 28, 8, 46, seconds, tzinfo=UTC).timestamp()
            assert f.stamp_ns == int(second) * 10**9 + (f.seq % 10) * 100_000_000 + 4_547_200
            assert f.label is not None and f.label[0, 0] == 26 and not f.label[1:3].any() and (f.label[3:] == 7).all()
            shift = np.array((0.594184, 0, 0)) if f.camera_id == "image_01" else np.zeros(3)
            left = rec.pose(f.seq - 250)
            assert np.array_equal(f.T_world_camera[:3, :3], left[:3, :3])
            np.testing.assert_allclose(f.T_world_camera[:3, 3], left[:3, :3] @ shift + left[:3, 3], atol=1e-6)
        assert log.info.label_set == LABELS


def add_scans(root: Path, points: np.ndarray, numbers: tuple[int, ...] = (250,)) -> Path:
    """A scan of ``points`` (N, 3), in the scanner's axes: ahead, left, up; it stands 0.5 m above the camera."""
    scans = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    for i in numbers:
        np.concatenate((points, np.ones((len(points), 1))), axis=1).astype("<f4").tofile(scans / f"{i:010d}.bin")
    (root / "calibration" / "calib_cam_to_velo.txt").write_text("0 0 1 0 -1 0 0 0 0 -1 0 -0.5\n")
    return scans


def test_laser_scans_give_depth_to_both_cameras(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    add_scans(root, np.array([[4.0, 0.0, -0.5], [-4.0, 0, 0], [np.nan, 0, 0]]))  # the second lies behind the camera
    report = import_recording(root, tmp_path / "log.mcap")
    assert (report.frames, report.with_depth) == (4, 2) and not any("depth" in n for n in report.notices)
    with LogReader(tmp_path / "log.mcap") as log:
        left, right, later, _ = log
    for frame, shift_m in ((left, 0.0), (right, 0.594184)):
        assert frame.depth_m is not None
        k = frame.intrinsics
        row, column = np.nonzero(frame.depth_m)
        assert len(row) == 1 and frame.depth_m[row, column] == pytest.approx(4.0, abs=0.05)
        assert abs(column[0] - (k.cx - k.fx * shift_m / 4)) < 1.5 and abs(row[0] - k.cy) < 1.5
    assert later.depth_m is None


def test_a_scan_fills_the_pixels_between_its_beams() -> None:
    camera = CameraIntrinsics(552.6, 552.6, 100.0, 50.0, 200, 100)
    depth = depth_of_scan(np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 9.0]]), np.eye(4), camera)
    row, column = np.nonzero(depth)
    assert (row.min(), row.max(), column.min(), column.max()) == (48, 52, 99, 101) and (depth[row, column] == 5).all()
    assert not depth_of_scan(np.zeros((0, 3)), np.eye(4), camera).any()


def test_what_is_wrong_with_laser_scans_is_told(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    scans = add_scans(root, np.array([[4.0, 0.0, 0.0]]), (250, 252))
    (scans / "0000000250.bin").write_bytes(b"123")
    report = import_recording(root, tmp_path / "log.mcap")
    assert "16 bytes a point" in report.skipped[0].reason and report.with_depth == 2
    (root / "calibration" / "calib_cam_to_velo.txt").write_text("1 2 3\n")
    with pytest.raises(ImportSourceError, match=r"calib_cam_to_velo\.txt: expected the 12 numbers"):
        import_recording(root, tmp_path / "x.mcap")


def test_the_label_table_is_the_published_one() -> None:
    name = dict(zip(LABELS.ids, LABELS.names, strict=True))
    color = dict(zip(LABELS.ids, LABELS.colors, strict=True))
    assert (name[7], name[11], name[21], name[26], name[34], name[41]) == (
        "road",
        "building",
        "vegetation",
        "car",
        "garage",
        "box",
    )
    assert (color[7], color[23], color[39], color[41]) == ((128, 64, 128), (70, 130, 180), (0, 128, 192), (64, 64, 128))
    assert len(LABELS) == 35 and LABELS.ids[-1] == 41


def test_what_is_wrong_with_a_kitti360_folder_is_told(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    out = tmp_path / "log.mcap"
    right = root / "data_2d_raw" / DRIVE / "image_01" / "data_rect"
    for file in right.iterdir():
        file.unlink()
    for camera in ("image_00", "image_01"):
        (root / "data_2d_raw" / DRIVE / camera / "timestamps.txt").unlink()
    rec.write_image(root / f"data_2d_semantics/train/{DRIVE}/image_00/semantic/0000000252.png", np.full((24, 64), 99))
    report = import_recording(root, out, options=ImportOptions())
    with LogReader(out) as log:
        assert [(f.camera_id, f.seq, f.stamp_ns) for f in log] == [
            ("image_00", 250, 25 * 10**9),
            ("image_00", 252, 25_200_000_000),
        ]
    assert "stamps are made up at 10 frames" in report.notices[1] and report.labelled == 1
    assert any("99" in s.reason and s.label_only for s in report.skipped)

    (root / "data_2d_raw" / "2013_05_28_drive_0002_sync").mkdir()
    with pytest.raises(ImportSourceError, match=r"holds 2 drives; name the folder of one: .*drive_0000_sync"):
        import_recording(root, tmp_path / "x.mcap")
    drive = root / "data_2d_raw" / DRIVE
    poses = root / "data_poses" / DRIVE / "cam0_to_world.txt"
    kept = poses.read_text()
    for file, text, complaint in (
        (poses, "250 1 0 0 0 0 1 0 0 0 0 1 0\n", "poses.txt, with 12, is another file"),
        (poses, "", "holds no pose"),
        (root / "calibration" / "perspective.txt", PERSPECTIVE.format(w="nan", h=24), "perspective.txt"),
        (root / "calibration" / "perspective.txt", PERSPECTIVE.format(w=640, h=480), "perspective.txt.*do not fit"),
        (root / "calibration" / "perspective.txt", "P_rect_00: 1 2 3\n", "needs 'P_rect_00:' with 12 numbers"),
    ):
        file.write_text(text)
        with pytest.raises(ImportSourceError, match=complaint):
            import_recording(drive, tmp_path / "x.mcap")
        poses.write_text(kept)
    for file in (drive / "image_00" / "data_rect").iterdir():
        file.unlink()
    with pytest.raises(ImportSourceError, match="no rectified images"):
        import_recording(drive, tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()
