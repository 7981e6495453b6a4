"""Sequence folders, TUM, ScanNet, Replica and KITTI-360: right values of what they hold."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import ImportSourceError, LogError
from semantic_mapper.geometry import project, unproject
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.importers.base import ImportOptions, ImportReport
from semantic_mapper.replay.importers.kitti360 import LABELS, depth_of_scan
from semantic_mapper.replay.importers.run import detect_format, import_recording, needs_import
from semantic_mapper.replay.importers.seven_scenes import T_COLOR_DEPTH
from semantic_mapper.types import CameraIntrinsics
from tests.replay import recordings as rec
from tests.replay.recordings import DRIVE, add_scans, imported, make_kitti360, make_replica


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return rec.make_folder(tmp_path / "kitchen")


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    return rec.make_tum(tmp_path / "desk")


@pytest.fixture
def scannet(tmp_path: Path) -> Path:
    return rec.make_scannet(tmp_path / "scene0000_00")


def reasons(report: ImportReport) -> dict[int, str]:
    return {skipped.frame: f"{skipped.file.name}: {skipped.reason}" for skipped in report.skipped}


def test_a_sequence_folder_is_imported_without_loss(folder: Path) -> None:
    report, frames = imported(folder)
    assert (report.format, report.frames, report.labelled, report.skipped) == ("folder", 6, 6, [])
    labels = report.info.label_set
    assert labels is not None and (labels.name, labels.ids, labels.ignore_id) == ("nyu40", (1, 2, 5), 0)
    assert labels.colors == tuple(rec.nyu40_color(name) for name in ("wall", "floor", "chair"))
    assert report.info.source == "folder kitchen"
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.rgb[..., ::-1], cv2.imread(str(folder / "color" / f"{i:06d}.jpg")))
        assert frame.depth_m is not None and np.array_equal(frame.depth_m, rec.depth(i).astype(np.float32) / 1000)
        assert frame.label is not None and np.array_equal(frame.label, rec.label(i))
        assert np.array_equal(frame.T_world_camera, rec.pose(i))
        assert (frame.seq, frame.stamp_ns, frame.intrinsics.fy) == (i, round(i * 1e9 / 6), 31.0)


def test_labels_without_an_ignore_id_keep_all_their_classes(folder: Path) -> None:
    classes = {"0": "wall", "1": "floor", "2": "chair", "5": "lamp"}
    (folder / "labels.json").write_text(json.dumps({"classes": classes, "ignore": None}))
    report, frames = imported(folder)
    labels = report.info.label_set
    assert labels is not None and (labels.ids, labels.ignore_id) == ((0, 1, 2, 5), 255)
    assert report.labelled == 6 and np.array_equal(frames[0].label, rec.label(0))
    assert (labels.to_channels(rec.label(0)) >= 0).all()
    assert any("no ignore id; 255" in notice for notice in report.notices)
    (folder / "labels.json").write_text(json.dumps({"classes": classes}))
    report, _ = imported(folder)
    assert any("class 0 'wall' is read as unknown" in notice for notice in report.notices)


def test_each_bad_frame_is_left_out_with_its_reason_and_the_rest_kept(tmp_path: Path) -> None:
    src = rec.make_folder(tmp_path / "kitchen", count=14)
    rows = (src / "poses.txt").read_text().splitlines()
    rows[1] = rows[1].replace("1.5", "nan")
    rows[2] = " ".join(["2"] * 12 + ["0", "0", "0", "1"])
    rows[3] = "1 2 3"
    rows[4] = rows[4] + "x"
    (src / "poses.txt").write_text("# poses\n\n" + "\n".join(rows) + "\n")
    (src / "color" / "000006.jpg").write_bytes((src / "color" / "000006.jpg").read_bytes()[:-40])
    rec.write_image(src / "color" / "000007.jpg", rec.color(7, 40, 20))
    (src / "depth" / "000008.png").write_bytes(b"no image")
    rec.write_image(src / "depth" / "000009.png", rec.label(9))  # 8 bits
    rec.write_image(src / "depth" / "000010.png", rec.depth(10)[:10])
    strange = rec.label(11)
    strange[3, 4] = 77
    rec.write_image(src / "label" / "000011.png", strange)
    (src / "label" / "000012.png").unlink()  # no label is no fault
    report, frames = imported(src)
    assert [frame.seq for frame in frames] == [0, 5, 11, 12, 13] and report.labelled == 3
    assert [frame.seq for frame in frames if frame.label is None] == [11, 12]
    assert [skipped.frame for skipped in report.skipped if skipped.label_only] == [11]
    said = reasons(report)
    for number, words in {
        1: "poses.txt: line 4: the pose holds NaN",
        2: "not a rotation",
        3: "expected 16 numbers (4x4, row by row), got 3",
        4: "poses.txt: line 7: could not convert",
        6: "000006.jpg: JPEG image is cut off",
        7: "the image is 40x20, the camera's intrinsics say 32x24",
        8: "000008.png: the depth image is damaged",
        9: "one uint16 channel, this one has 1 of uint8",
        10: "the depth image is 32x10, the colour image 32x24",
        11: "class ids [77] are not in label set 'nyu40'",
    }.items():
        assert words in said.pop(number), words
    assert not said


def test_images_of_another_size_and_one_form_have_the_intrinsics_of_that_size(folder: Path) -> None:
    rec.write_image(folder / "color" / "000001.jpg", rec.color(1, 64, 48))
    rec.write_image(folder / "label" / "000001.png", np.zeros((48, 64), np.uint8))
    rec.write_image(folder / "depth" / "000002.png", rec.depth(2)[::2, ::2])
    report, frames = imported(folder)
    large, small = frames[1:3]
    assert not report.skipped and large.intrinsics.fx == 60.0
    assert large.depth_m is not None and small.depth_m is not None
    assert np.array_equal(large.depth_m[::2, ::2], rec.depth(1) / np.float32(1000))
    assert np.array_equal(small.depth_m[::2, ::2], rec.depth(2)[::2, ::2] / np.float32(1000))


def test_stamps_come_from_timestamps_txt_where_there_is_one(folder: Path) -> None:
    for text, stamps in (
        ("10000000\n25000000\n47000000\n50000000\n60000000\n70000000", [10**7, 25 * 10**6, 47 * 10**6]),
        ("0.5\n1.25\n2.000000001\n3.\n4.0\n5.0", [5 * 10**8, 125 * 10**7, 2 * 10**9 + 1]),
    ):
        (folder / "timestamps.txt").write_text(text)
        report, frames = imported(folder)
        assert [frame.stamp_ns for frame in frames[:3]] == stamps and not report.notices


def test_an_import_without_one_good_frame_fails_and_leaves_an_older_log_alone(folder: Path) -> None:
    dst = folder.parent / "log.mcap"
    import_recording(folder, dst)
    before = dst.read_bytes()
    assert not needs_import(dst) and needs_import(shutil.copy(dst, folder / "log.mcap").parent)
    (folder / "poses.txt").write_text("\n".join(["nan " * 16] * 6))
    with pytest.raises(ImportSourceError, match="none of its 6 frames can be used"):
        import_recording(folder, dst, overwrite=True)
    with pytest.raises(LogError, match=r"log\.mcap: exists already; choose another name, or --overwrite it"):
        import_recording(folder, dst)
    assert dst.read_bytes() == before
    assert sorted(p.name for p in folder.parent.iterdir()) == ["kitchen", "log.mcap"]


def test_every_second_frame_is_imported(folder: Path) -> None:
    told: list[tuple[int, int]] = []
    stamps = [frame.stamp_ns for frame in imported(folder)[1]]
    assert [frame.stamp_ns for frame in imported(folder, every=2, max_frames=2)[1]] == stamps[:3:2]
    options = ImportOptions(every=2, max_frames=2)
    import_recording(folder, folder.parent / "b.mcap", "folder", lambda *at: told.append(at), options=options)
    assert told == [(1, 2), (2, 2)]


def test_formats_are_told_apart(folder: Path, tmp_path: Path) -> None:
    for name in ("nothing", "half/color", "bag", "nice", "above/film/left"):
        (tmp_path / name).mkdir(parents=True)
    files = ("half/poses.txt", "film.MP4", "day.zip", "a.sens", "nice/traj.txt", "log.mcap", "above/film/left/1.jpg")
    for name in ("bag/metadata.yaml", "bag/day_0.db3", "day.bag", *files):
        (tmp_path / name).touch()
    (tmp_path / "own" / "deep").mkdir(parents=True)
    (tmp_path / "own" / "rgb").mkdir()
    cv2.imwrite(str(tmp_path / "own" / "deep" / "1.png"), np.ones((4, 4), np.uint16))
    cv2.imwrite(str(tmp_path / "own" / "rgb" / "1.png"), np.ones((4, 4, 3), np.uint8))
    for src, complaint in (
        ("nothing", "no recording of a known format"),
        (".", r"holds recordings; name one of them: .*bag, .*day.bag, .*kitchen \(`semantic-mapper map .*bag`\)"),
        ("above", r"holds folders of pictures; name one of them: .*left \(`semantic-mapper map .*above/film/left`\)"),
        (
            "own",
            r"holds depth \(.*own/deep\), but has no layout .* shows the files of each format; .*own/rgb alone is a",
        ),
        ("nothink", r"no such file or folder; did you mean `.*/nothing`\?"),
        ("hapf/color", r"no such file or folder; did you mean `.*/half/color`\?"),
        ("half", "nearest to a recording of format 'folder', but lacks intrinsics.json; docs/layouts.md shows"),
        ("film.MP4", "is a film, which has no poses"),
        ("day.zip", "is packed; unpack it"),
        ("a.sens", "unpack it by the data set's SensReader"),
        ("nice", "NICE-SLAM renders, but no results/"),
        ("no", "no such file or folder"),
        ("log.mcap", "nor a log of semantic-mapper"),
    ):
        with pytest.raises(ImportSourceError, match=complaint):
            detect_format(tmp_path / src)
    assert [detect_format(tmp_path / src) for src in ("bag", "day.bag")] == ["rosbag", "rosbag"]
    shutil.move(tmp_path / "bag", tmp_path / "above" / "film" / "bag")
    with pytest.raises(ImportSourceError, match=r"holds recordings; name one of them: .*above/film/bag"):
        detect_format(tmp_path / "above")
    with pytest.raises(ImportSourceError, match="no format 'film'"):
        import_recording(folder, tmp_path / "x.mcap", "film")


def test_a_tum_sequence_gets_matched_depth_and_interpolated_poses(tum: Path) -> None:
    report, frames = imported(tum)
    assert (report.format, report.frames, report.skipped) == ("tum", 6, [])
    assert report.info.label_set is None
    first = frames[0].stamp_ns
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.rgb[..., ::-1], rec.color(i))
        assert frame.depth_m is not None and np.abs(frame.depth_m - rec.depth(i) / 1000).max() < 1e-6
        after_s = (frame.stamp_ns - first) / 1e9
        angle = rec.tum_angle(frame.stamp_ns - first)
        assert np.allclose(frame.T_world_camera[:3, 3], (after_s, 0, 1.5), atol=1e-6)
        assert np.allclose(frame.T_world_camera[:2, 0], (np.cos(angle), np.sin(angle)), atol=1e-6)
    assert first == 1_305_031_102_175_304_000  # to the nanosecond


def test_calibrations_of_tum_and_bonn_go_by_the_name_of_the_sequence(tmp_path: Path) -> None:
    for name, fx, notice in (
        ("freiburg1_desk", 546.636, ""),  # 517.3 before its lens is undone
        ("freiburg3_office", 535.4, ""),
        ("rgbd_bonn_crowd", 543.86, ""),
        ("mine", 525.0, "ROS"),
    ):
        src = rec.make_tum(tmp_path / name, count=2)
        (src / "intrinsics.json").unlink()
        for kind, image in (("rgb", rec.color(0, 640, 480)), ("depth", np.full((480, 640), 5000, np.uint16))):
            for file in (src / kind).iterdir():
                rec.write_image(file, image)
        report, frames = imported(src)
        assert report.info.cameras["camera"].fx == pytest.approx(fx, abs=0.1)
        assert notice in " ".join(report.notices)
        assumed = report.info.metadata.get("scale", "")  # which the ending of `map` repeats
        assert assumed.startswith("a camera of f = 525 and depth of 5000 units") if name == "mine" else not assumed
        ray = np.array((0.3, -0.2, 1.0))
        expected = np.add(ray, (0, 0, 1.5))
        if "bonn" in name:  # as published: T_ros T T_ros T_m takes what the sensor sees to the world
            T_m = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
            expected = T_m @ ray + (0.0113, -0.0098, 0.0111) + (0, 1.5, 0)
        assert np.allclose(frames[0].T_world_camera[:3] @ (*frames[0].depth_m[240, 320] * ray, 1), expected, atol=1e-3)


def test_points_of_icl_nuim_fall_on_the_pixels_of_its_camera(tmp_path: Path) -> None:
    (src := tmp_path / "living_room_traj2_frei_png").mkdir()
    R, t = Rotation.from_rotvec((0.3, -0.4, 0.2)), np.array((0.5, 1.2, -2.0))
    for number in range(2):
        rec.write_image(src / f"rgb/{number}.png", rec.color(0, 640, 480))
        rec.write_image(src / f"depth/{number}.png", np.full((480, 640), 7500, np.uint16))
    (src / "associations.txt").write_text("0 depth/0.png 0 rgb/0.png\n1 depth/1.png 1 rgb/1.png\n")
    (src / "livingRoom2.gt.freiburg").write_text(f"1 {' '.join(map(str, (*t, *R.as_quat())))}\n")
    report, (frame,) = imported(src)
    assert reasons(report) == {0: "livingRoom2.gt.freiburg: has no pose for image 0"}
    assert (frame.seq, frame.stamp_ns) == (1, 33_333_333) and frame.depth_m is not None and frame.depth_m[0, 0] == 1.5
    point = np.array((1.1, 0.7, 1.9))  # y is up in its world, as in its camera
    x, y, z = R.inv().apply(point - t)
    ours = np.linalg.inv(frame.T_world_camera) @ (*point[[0, 2, 1]], 1)
    u, v = project(ours[None, :3], frame.intrinsics)[0]
    assert np.allclose((u, v), (481.2 * x / z + 319.5, -480 * y / z + 239.5))
    with pytest.raises(ImportSourceError, match="unpack it again"):
        import_recording(src, tmp_path / "b.mcap", "tum")


def test_a_scannet_scene_is_brought_to_the_pixels_of_its_depth(scannet: Path) -> None:
    report, frames = imported(scannet)
    assert (report.format, report.frames, report.labelled, report.skipped) == ("scannet", 6, 6, [])
    assert report.info.label_set == NYU40
    for i, frame in enumerate(frames):
        assert frame.rgb.shape == (rec.HEIGHT, rec.WIDTH, 3) and (frame.seq, frame.intrinsics.fx) == (i, 30.0)
        assert frame.stamp_ns == round(i * 20 * 1e9 / 30)
        large = cv2.imread(str(scannet / "color" / f"{i * 20}.jpg"))
        area = large.reshape(rec.HEIGHT, 2, rec.WIDTH, 2, 3).mean((1, 3))
        assert np.abs(frame.rgb[..., ::-1] - area).max() <= 1
        assert frame.depth_m is not None and np.array_equal(frame.depth_m, rec.depth(i).astype(np.float32) / 1000)
        assert np.array_equal(frame.label, rec.label(i))
        assert np.array_equal(frame.T_world_camera, rec.pose(i))


def test_scannet_colour_and_labels_follow_the_ray_where_the_cameras_differ(scannet: Path) -> None:
    # The colour camera looks 4 depth pixels further to the right: what was at u is at u - 4.
    rec.write_matrix(scannet / "intrinsic" / "intrinsic_color.txt", 60.0, 62.0, 31.5 - 8.0, 23.5)
    frame = imported(scannet)[1][0]
    assert frame.label is not None
    assert np.array_equal(frame.label[:, 4:], rec.label(0)[:, :-4])
    assert not frame.label[:, :4].any()  # outside the colour image: unknown
    red = frame.rgb[:, 10, 2].astype(int)
    expected = cv2.imread(str(scannet / "color" / "0.jpg"))[::2, 12, 0].astype(int)
    assert np.abs(red - expected).max() <= 8


def test_raw_scannet_ids_need_the_table_of_the_data_set(scannet: Path) -> None:
    for i in range(6):
        raw = np.repeat(np.repeat(rec.label(i), 2, 0), 2, 1).astype(np.uint16)
        raw[raw == 5] = 1163
        rec.write_image(scannet / "label-filt" / f"{i * 20}.png", raw)
    report, _ = imported(scannet)
    assert (report.frames, report.labelled) == (6, 0) and "scannetv2-labels.combined.tsv" in reasons(report)[0]
    table = "id\traw_category\tnyu40id\n1\twall\t1\n2\tfloor\t2\n1163\tobject\t40\n1164\tnothing\t\n"
    (scannet.parent / "scannetv2-labels.combined.tsv").write_text(table)
    report, frames = imported(scannet)
    assert report.labelled == 6
    assert np.array_equal(frames[0].label, np.where(rec.label(0) == 5, 40, rec.label(0)))


def test_classes_are_renamed_and_joined_and_images_turned_on_the_way_in(folder: Path) -> None:
    plain = imported(folder)[1]
    report, frames = imported(folder, renames={"floor": "ground", "chair": "ground"}, quarters=1)
    labels = report.info.label_set
    assert report.labelled == 6 and labels is not None and (labels.names, labels.ids) == (("wall", "ground"), (1, 2))
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.label, np.rot90(np.where(rec.label(i) == 5, 2, rec.label(i)), -1))
        assert np.array_equal(frame.rgb, np.rot90(plain[i].rgb, -1)) and frame.intrinsics.width == rec.HEIGHT
        np.testing.assert_allclose(frame.T_world_camera[:3, 1], plain[i].T_world_camera[:3, 0])


def test_a_replica_sequence_is_imported_without_loss(tmp_path: Path) -> None:
    report, frames = imported(make_replica(tmp_path))
    assert (report.format, report.frames, report.labelled, report.skipped) == ("replica", 3, 3, [])
    k, labels = report.info.cameras["camera"], report.info.label_set
    assert (k.width, k.height, k.cx, k.cy) == (640, 480, 319.5, 239.5) and k.fx == k.fy == pytest.approx(320.0)
    assert report.info.source == "replica room_0 Sequence_1"
    assert labels is not None and (labels.ids, labels.names) == ((3, 93, 97), ("basket", "wall", "window"))
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.rgb[..., ::-1], rec.color(i, 640, 480))
        assert frame.depth_m is not None and (frame.depth_m == np.float32(1500 + i) / np.float32(1000)).all()
        assert np.array_equal(frame.T_world_camera, rec.pose(i)) and frame.stamp_ns == round(i * 1e9 / 30)
        assert frame.label is not None and frame.label[0, 0] == 97 and frame.label[1, 1] == (0, 3, 93)[i]


def test_a_kitti360_drive_is_imported_with_both_cameras(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    assert detect_format(root) == detect_format(root / "data_2d_raw" / DRIVE) == "kitti360"
    report, frames = imported(root)
    assert (report.frames, report.labelled) == (4, 4) and "without depth" in report.notices[0]
    assert report.info.label_set == LABELS and list(report.info.cameras) == ["image_00", "image_01"]
    assert [(s.frame, s.file.name) for s in report.skipped] == [(2, "cam0_to_world.txt"), (3, "cam0_to_world.txt")]
    assert [(f.seq, f.camera_id) for f in frames] == [
        *((250, "image_00"), (250, "image_01")),
        *((252, "image_00"), (252, "image_01")),
    ]
    for f in frames:
        assert f.depth_m is None and (f.intrinsics.fx, f.intrinsics.cx) == (52.554261, 31.049453)
        assert (f.intrinsics.width, f.intrinsics.height) == (64, 24)
        second = datetime(2013, 5, 28, 8, 46, f.seq // 10, tzinfo=UTC).timestamp()
        assert f.stamp_ns == int(second) * 10**9 + (f.seq % 10) * 100_000_000 + 4_547_200
        assert f.label is not None and f.label[0, 0] == 26 and not f.label[1:3].any() and (f.label[3:] == 7).all()
        shift = np.array((0.594184 * (f.camera_id == "image_01"), 0, 0))
        left = rec.pose(f.seq - 250)
        assert np.array_equal(f.T_world_camera[:3, :3], left[:3, :3])
        np.testing.assert_allclose(f.T_world_camera[:3, 3], left[:3, :3] @ shift + left[:3, 3], atol=1e-6)


def test_laser_scans_give_depth_to_both_cameras(tmp_path: Path) -> None:
    root = make_kitti360(tmp_path / "KITTI-360")
    add_scans(root, np.array([[4.0, 0.0, -0.5], [-4.0, 0, 0], [np.nan, 0, 0]]))  # the second lies behind the camera
    report, (left, right, later, _) = imported(root)
    assert (report.frames, report.with_depth) == (4, 2) and not any("depth" in n for n in report.notices)
    for frame, shift_m in ((left, 0.0), (right, 0.594184)):
        assert frame.depth_m is not None
        k = frame.intrinsics
        row, column = np.nonzero(frame.depth_m)
        assert len(row) == 1 and frame.depth_m[row, column] == pytest.approx(4.0, abs=0.05)
        assert abs(column[0] - (k.cx - k.fx * shift_m / 4)) < 1.5 and abs(row[0] - k.cy) < 1.5
    assert later.depth_m is None
    # A scan fills the pixels between its beams.
    camera = CameraIntrinsics(552.6, 552.6, 100.0, 50.0, 200, 100)
    depth = depth_of_scan(np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 9.0]]), np.eye(4), camera)
    row, column = np.nonzero(depth)
    assert (row.min(), row.max(), column.min(), column.max()) == (48, 52, 99, 101) and (depth[row, column] == 5).all()
    assert not depth_of_scan(np.zeros((0, 3)), np.eye(4), camera).any()


def test_a_sequence_of_7_scenes_gets_poses_and_depth_of_its_colour_camera(tmp_path: Path) -> None:
    src = tmp_path / "chess" / "seq-01"
    src.mkdir(parents=True)
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    plane = 2.0 / (1 + 0.2 * (u - 320) / 585 - 0.1 * (v - 240) / 585)  # n @ p = 2 m before the depth camera
    depth = np.where(u < 20, 65535, np.rint(1000 * plane)).astype(np.uint16)
    for number in (0, 3):
        rec.write_image(src / f"frame-{number:06d}.color.png", np.full((480, 640, 3), number, np.uint8))
        rec.write_image(src / f"frame-{number:06d}.depth.png", depth)
        np.savetxt(src / f"frame-{number:06d}.pose.txt", rec.pose(number))
    report, frames = imported(src.parent)
    assert f"the recording is {src}, the only one" in report.notices[0]
    assert (report.format, report.frames, [frame.stamp_ns for frame in frames]) == ("7-scenes", 2, [0, 100_000_000])
    for frame in frames:
        np.testing.assert_allclose(frame.T_world_camera, rec.pose(frame.seq) @ np.linalg.inv(T_COLOR_DEPTH), atol=1e-12)
        assert frame.depth_m is not None and not frame.depth_m[:, :10].any()
        points = unproject(frame.depth_m, frame.intrinsics)[frame.depth_m > 0] - T_COLOR_DEPTH[:3, 3]
        assert len(points) > 0.7 * 480 * 640 and np.abs(points @ (0.2, -0.1, 1) - 2).max() < 0.003
    (tmp_path / "chess" / "camera-intrinsics.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")
    with pytest.raises(ImportSourceError, match="another data set in its layout"):
        imported(src)


def test_large_pictures_are_made_smaller_with_depth_and_labels_unless_they_shall_stay(tmp_path: Path) -> None:
    src = rec.make_folder(tmp_path / "kitchen", count=2)
    (whole,) = imported(src, max_frames=1)[1]
    report, (frame,) = imported(src, max_frames=1, megapixels=whole.rgb.shape[0] * whole.rgb.shape[1] / 4e6)
    height, width = whole.rgb.shape[0] // 2, whole.rgb.shape[1] // 2
    assert frame.rgb.shape == (height, width, 3) and report.info.cameras["camera"] == frame.intrinsics
    assert frame.depth_m is not None and frame.label is not None
    assert frame.depth_m.shape == frame.label.shape == (height, width)
    assert frame.intrinsics.fx == whole.intrinsics.fx / 2 and f"are made {width}x{height}" in " ".join(report.notices)
