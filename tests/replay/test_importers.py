from __future__ import annotations

import json
import os
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError, LogError
from semantic_mapper.labels import NYU40
from semantic_mapper.replay.importers import ImportOptions, ImportReport, detect_format, import_recording
from semantic_mapper.replay.importers.tum import match_nearest
from semantic_mapper.replay.log.format import LogReader

from . import recordings as rec


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return rec.make_folder(tmp_path / "kitchen")


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    return rec.make_tum(tmp_path / "desk")


@pytest.fixture
def scannet(tmp_path: Path) -> Path:
    return rec.make_scannet(tmp_path / "scene0000_00")


def imported(src: Path, **options: object) -> tuple[ImportReport, LogReader]:
    dst = src.parent / "log.mcap"
    report = import_recording(src, dst, options=ImportOptions(**options), overwrite=True)  # type: ignore[arg-type]
    return report, LogReader(dst)


def reasons(report: ImportReport) -> dict[int, str]:
    return {skipped.frame: f"{skipped.file.name}: {skipped.reason}" for skipped in report.skipped}


@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_sequence_folder_is_imported_without_loss(tmp_path: Path, suffix: str) -> None:
    src = rec.make_folder(tmp_path / "kitchen", suffix=suffix)
    report, log = imported(src)
    assert (report.format, report.frames, report.labelled, report.skipped) == ("folder", 6, 6, ())
    assert log.info.source == "folder kitchen" and not log.errors and len(log) == 6
    for i, frame in enumerate(log):
        file = src / "color" / f"{i:06d}.{suffix}"
        assert np.array_equal(frame.rgb[..., ::-1], cv2.imread(str(file)))
        assert frame.depth_m is not None and np.array_equal(frame.depth_m, rec.depth(i).astype(np.float32) / 1000)
        assert frame.label is not None and np.array_equal(frame.label, rec.label(i))
        assert np.array_equal(frame.T_world_camera, rec.pose(i))
        assert (frame.seq, frame.stamp_ns, frame.intrinsics.fy) == (i, round(i * 1e9 / 6), 31.0)
    files = [parts[2] for _, parts in log.frame_parts()]
    assert files == [file.read_bytes() for file in sorted((src / "color").iterdir())]


def test_classes_keep_their_ids_and_the_colours_of_the_known_set(folder: Path) -> None:
    report, _ = imported(folder)
    labels = report.info.label_set
    assert labels is not None
    assert (labels.name, labels.ids, labels.names, labels.ignore_id) == (
        "nyu40",
        (1, 2, 5),
        ("wall", "floor", "chair"),
        0,
    )
    assert labels.colors == tuple(rec.nyu40_color(name) for name in labels.names)


def test_classes_of_an_unknown_id_space_get_colours_of_their_own(folder: Path) -> None:
    (folder / "labels.json").write_text(json.dumps({"classes": {"1": "a", "2": "b", "5": "c"}, "ignore": 0}))
    report, _ = imported(folder)
    labels = report.info.label_set
    assert labels is not None and labels.name == "kitchen" and len(set(labels.colors)) == 3


def test_labels_without_an_ignore_id_keep_all_their_classes(folder: Path) -> None:
    classes = {"0": "wall", "1": "floor", "2": "chair", "5": "lamp"}
    (folder / "labels.json").write_text(json.dumps({"classes": classes, "ignore": None}))
    report, log = imported(folder)
    labels = log.info.label_set
    assert labels is not None and (labels.ids, labels.ignore_id) == ((0, 1, 2, 5), 255)
    assert report.labelled == 6 and np.array_equal(log.frame(0).label, rec.label(0))
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
    (src / "color" / "000005.jpg").unlink()
    (src / "color" / "000006.jpg").write_bytes((src / "color" / "000006.jpg").read_bytes()[:-40])
    rec.write_image(src / "color" / "000007.jpg", rec.color(7, 40, 30))
    (src / "depth" / "000008.png").write_bytes(b"no image")
    rec.write_image(src / "depth" / "000009.png", rec.label(9))  # 8 bits
    rec.write_image(src / "depth" / "000010.png", rec.depth(10)[:10])
    report, log = imported(src)
    assert [frame.seq for frame in log] == [0, 11, 12, 13]
    said = reasons(report)
    for number, words in {
        1: "poses.txt: line 4: the pose holds NaN",
        2: "not a rotation",
        3: "expected 16 numbers (4x4, row by row), got 3",
        4: "poses.txt: line 7: could not convert",
        5: "000005.jpg: cannot be read (No such file",
        6: "000006.jpg: JPEG image is cut off",
        7: "the image is 40x30, the camera's intrinsics say 32x24",
        8: "000008.png: the depth image is damaged",
        9: "one uint16 channel, this one has 1 of uint8",
        10: "the depth image is 32x10, the colour image 32x24",
    }.items():
        assert words in said[number], (words, said[number])
    assert set(said) == set(range(1, 11))


def test_a_bad_label_image_costs_the_label_only(folder: Path) -> None:
    strange = rec.label(1)
    strange[3, 4] = 77
    rec.write_image(folder / "label" / "000001.png", strange)
    (folder / "label" / "000002.png").unlink()
    report, log = imported(folder)
    assert (report.frames, report.labelled) == (6, 4)
    assert [frame.seq for frame in log if frame.label is None] == [1, 2]
    assert all(skipped.label_only for skipped in report.skipped)
    assert "class ids [77] are not in label set 'nyu40'" in reasons(report)[1]
    assert "000002.png" in reasons(report)[2]


def test_depth_and_labels_may_be_missing_altogether(folder: Path) -> None:
    for kind in ("depth", "label"):
        for file in (folder / kind).iterdir():
            file.unlink()
        (folder / kind).rmdir()
    (folder / "labels.json").unlink()
    report, log = imported(folder)
    assert report.frames == 6 and report.info.label_set is None
    assert all(frame.depth_m is None and frame.label is None for frame in log)


def test_labels_without_names_are_left_out_and_said_so(folder: Path) -> None:
    (folder / "labels.json").unlink()
    report, log = imported(folder)
    assert report.labelled == 0 and any("labels.json" in notice for notice in report.notices)
    assert all(frame.label is None for frame in log)


@pytest.mark.parametrize(
    ("text", "stamps"),
    [
        ("10000000\n25000000\n47000000\n50000000\n60000000\n70000000", [10**7, 25 * 10**6, 47 * 10**6]),
        ("0.5\n1.25\n2.000000001\n3.\n4.0\n5.0", [5 * 10**8, 125 * 10**7, 2 * 10**9 + 1]),
    ],
)
def test_stamps_come_from_timestamps_txt_where_there_is_one(folder: Path, text: str, stamps: list[int]) -> None:
    (folder / "timestamps.txt").write_text(text)
    report, log = imported(folder)
    assert [frame.stamp_ns for frame in islice(log, 3)] == stamps and not report.notices


@pytest.mark.parametrize(
    ("file", "content", "complaint"),
    [
        ("intrinsics.json", "{", "intrinsics.json"),
        ("intrinsics.json", '{"width": 32, "height": 24, "fx": "f"}', "intrinsics.json.*fx"),
        ("intrinsics.json", '{"width": 32, "height": 24, "fx": 0, "fy": 1, "cx": 1, "cy": 1}', "must be positive"),
        ("intrinsics.json", '{"width": ' + "[" * 100_000, "intrinsics.json: "),
        ("intrinsics.json", '{"width": 32, "height": 24, "fx": 1e300, "fy": 1, "cx": 1, "cy": 1}', "fx = 1e.300"),
        ("intrinsics.json", " " * (1 << 20) + "{}", "larger than the limit"),
        ("labels.json", f'{{"classes": {{"1": "{"x" * 5000}"}}}}', "labels.json: .*name of class 1 has 5,000 letters"),
        ("labels.json", f'{{"id_space": "{"x" * 5000}", "classes": {{"1": "x"}}}}', "labels.json: .*its own name has"),
        (
            "intrinsics.json",
            '{"width": 32, "height": 24, "fx": 0.8, "fy": 1.1, "cx": 0.5, "cy": 0.5}',
            "intrinsics.json.*normalised",
        ),
        ("intrinsics.json", '{"width": 32, "height": 24, "fx": 31, "fy": 31, "cx": 1e19, "cy": 12}', "intrinsics.json"),
        ("timestamps.txt", "1\n2\n3\n" + 3 * "9223372036854775808\n", "timestamps.txt.*not a time from 0"),
        ("timestamps.txt", "1.0\n2.0\n3.0\n" + 3 * "99999999999.0\n", "timestamps.txt.*not a time"),
        ("labels.json", '{"classes": {"one": "wall"}}', "labels.json"),
        ("labels.json", '{"classes": ' + '{"a":' * 100_000, "labels.json: "),
        ("labels.json", " " * (1 << 20) + "{}", "larger than the limit"),
        ("labels.json", '{"classes": {"1": "wall", "2": "wall"}}', "twice"),
        ("poses.txt", "", "holds no pose"),
        ("timestamps.txt", "1\n2", "a stamp for each of 6 frames"),
        ("timestamps.txt", "1\n2\n2\n3\n4\n5", "row 3 is not later.*rising stamps"),
        ("timestamps.txt", "1\n2\n3\nsoon\nsoon\nsoon", "soon"),
        ("timestamps.txt", "1\n2\n3\n4\n5\n6", "1 ns apart; whole numbers are nanoseconds"),
        ("timestamps.txt", "1700\n1733\n1766\n1800\n1833\n1866", "or convert milliseconds"),
    ],
)
def test_a_file_that_concerns_all_frames_stops_the_import(
    folder: Path, file: str, content: str, complaint: str
) -> None:
    (folder / file).write_text(content)
    with pytest.raises(ImportSourceError, match=complaint):
        imported(folder)
    assert not (folder.parent / "log.mcap").exists()


def test_an_import_without_one_good_frame_fails_and_leaves_an_older_log_alone(folder: Path) -> None:
    dst = folder.parent / "log.mcap"
    import_recording(folder, dst)
    before = dst.read_bytes()
    (folder / "poses.txt").write_text("\n".join(["nan " * 16] * 6))
    with pytest.raises(ImportSourceError, match="none of its 6 frames can be used"):
        import_recording(folder, dst, overwrite=True)
    with pytest.raises(LogError, match=r"log\.mcap: exists already; choose another name, or --overwrite it"):
        import_recording(folder, dst)
    assert dst.read_bytes() == before
    assert sorted(p.name for p in folder.parent.iterdir()) == ["kitchen", "log.mcap"]


def test_an_import_may_be_done_again_and_tells_its_progress(folder: Path) -> None:
    dst = folder.parent / "log.mcap"
    told: list[tuple[int, int]] = []
    for _ in range(2):
        import_recording(folder, dst, "folder", lambda done, total: told.append((done, total)), overwrite=True)
    assert told == [(i, 6) for i in range(1, 7)] * 2
    assert import_recording(folder, dst, options=ImportOptions(max_frames=2), overwrite=True).frames == 2


def test_every_second_frame_is_imported(folder: Path) -> None:
    dst, told = folder.parent / "log.mcap", list[tuple[int, int]]()
    import_recording(folder, dst)
    with LogReader(dst) as log:
        stamps = [log.frame(number).stamp_ns for number in range(len(log))]
    options = ImportOptions(every=2, max_frames=2)
    import_recording(folder, dst, "folder", lambda *at: told.append(at), options=options, overwrite=True)
    with LogReader(dst) as log:
        assert [log.frame(number).stamp_ns for number in range(len(log))] == stamps[:3:2]
    assert told == [(1, 2), (2, 2)]


def test_a_destination_that_cannot_be_written_is_a_clear_error(folder: Path) -> None:
    with pytest.raises(LogError, match="cannot be written"):
        import_recording(folder, folder / "no" / "such" / "log.mcap")
    with pytest.raises(LogError, match="cannot be written"):
        import_recording(folder, folder, overwrite=True)


def test_formats_are_told_apart(folder: Path, tum: Path, scannet: Path, tmp_path: Path) -> None:
    assert [detect_format(src) for src in (folder, tum, scannet)] == ["folder", "tum", "scannet"]
    for name in ("nothing", "half/color", "bag"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("half/poses.txt", "bag/metadata.yaml", "bag/day_0.db3", "day.bag", "film.MP4", "day.zip"):
        (tmp_path / name).touch()
    (tmp_path / "log.mcap").touch()
    for src, complaint in (
        ("nothing", "no recording of a known format"),
        (".", "holds recordings; name one of them: .*bag, .*day.bag, .*desk, .*kitchen, .*scene0000_00"),
        ("half", "nearest to a recording of format 'folder', but lacks intrinsics.json"),
        ("film.MP4", "is a film, which has no poses"),
        ("day.zip", "is packed; unpack it"),
        ("no", "no such file or folder"),
        ("log.mcap", "nor a log of semantic-mapper"),
    ):
        with pytest.raises(ImportSourceError, match=complaint):
            detect_format(tmp_path / src)
    assert [detect_format(tmp_path / src) for src in ("bag", "day.bag")] == ["rosbag", "rosbag"]
    with pytest.raises(ImportSourceError, match="no format 'film'"):
        import_recording(folder, tmp_path / "x.mcap", "film")


def test_a_tum_sequence_gets_matched_depth_and_interpolated_poses(tum: Path) -> None:
    report, log = imported(tum)
    assert (report.format, report.frames, report.skipped) == ("tum", 6, ())
    assert report.info.label_set is None
    first = None
    for i, frame in enumerate(log):
        first = frame.stamp_ns if first is None else first
        assert np.array_equal(frame.rgb[..., ::-1], rec.color(i))
        assert frame.depth_m is not None and np.abs(frame.depth_m - rec.depth(i) / 1000).max() < 1e-6
        after_s = (frame.stamp_ns - first) / 1e9
        angle = rec.tum_angle(frame.stamp_ns - first)
        assert np.allclose(frame.T_world_camera[:3, 3], (after_s, 0, 1.5), atol=1e-6)
        assert np.allclose(frame.T_world_camera[:2, 0], (np.cos(angle), np.sin(angle)), atol=1e-6)
    assert first == 1_305_031_102_175_304_000  # to the nanosecond


@pytest.mark.parametrize("kind", ["folder", "tum"])
def test_depth_is_read_by_the_convention_of_its_format_where_no_scale_is_given(tmp_path: Path, kind: str) -> None:
    src = {"folder": rec.make_folder, "tum": rec.make_tum}[kind](tmp_path / kind)
    given, log = imported(src)
    expected = log.frame(0).depth_m
    plain = {key: value for key, value in rec.INTRINSICS.items() if key != "depth_scale"}
    (src / "intrinsics.json").write_text(json.dumps(plain))
    assumed, log = imported(src)
    assert np.array_equal(log.frame(0).depth_m, expected)
    assert given.depth_scale.units_per_m == assumed.depth_scale.units_per_m == {"folder": 1000, "tum": 5000}[kind]
    assert given.depth_scale.given_in == src / "intrinsics.json" and assumed.depth_scale.given_in is None
    assert assumed.with_depth == 6 and assumed.median_depth_m == pytest.approx(np.median(rec.depth(0)) / 1000)


def test_a_depth_image_that_is_missing_costs_the_depth_only(folder: Path) -> None:
    (folder / "depth" / "000003.png").unlink()
    report, log = imported(folder)
    assert (report.frames, report.with_depth, report.skipped) == (6, 5, ())
    assert [frame.seq for frame in log if frame.depth_m is None] == [3]


def test_a_tum_sequence_without_depth_is_imported(tum: Path) -> None:
    (tum / "depth.txt").unlink()
    report, log = imported(tum)
    assert (report.format, report.frames, report.with_depth) == ("tum", 6, 0)
    assert all(frame.depth_m is None for frame in log)
    assert any("no depth.txt" in notice for notice in report.notices)


def test_tum_frames_without_depth_are_kept_and_those_without_a_pose_left_out(tum: Path) -> None:
    depth = (tum / "depth.txt").read_text().splitlines()
    (tum / "depth.txt").write_text("\n".join([*depth[:2], "no time at all", *depth[3:]]))
    truth = (tum / "groundtruth.txt").read_text().splitlines()
    truth[5] = "1305031102.195304 nan 0 0 0 0 0 1"
    (tum / "groundtruth.txt").write_text("\n".join(truth[:15]))
    report, log = imported(tum)
    said = reasons(report)
    assert "groundtruth.txt has no pose near" in said[5]
    assert 1 not in said and [frame.seq for frame in log] == [n for n in range(6) if n not in said]
    assert [frame.seq for frame in log if frame.depth_m is None] == [1]
    assert report.with_depth == report.frames - 1
    assert any("depth.txt, line 3" in notice for notice in report.notices)
    assert any("groundtruth.txt, line 6" in notice for notice in report.notices)


def test_tum_calibrations_go_by_the_name_of_the_sequence(tmp_path: Path) -> None:
    for name, fx, notice in (
        ("freiburg1_desk", 546.755, ""),  # 517.3 before its lens is undone
        ("freiburg3_office", 535.4, ""),
        ("mine", 525.0, "ROS"),
    ):
        src = rec.make_tum(tmp_path / name, count=2)
        (src / "intrinsics.json").unlink()
        for file in (src / "rgb").iterdir():
            rec.write_image(file, rec.color(0, 640, 480))
        for file in (src / "depth").iterdir():
            rec.write_image(file, np.full((480, 640), 5000, np.uint16))
        report, _ = imported(src)
        assert report.info.cameras["camera"].fx == pytest.approx(fx, abs=1e-3)
        assert notice in " ".join(report.notices)


def test_windows_marks_and_line_ends_cost_nothing(tum: Path) -> None:
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (tum / name).read_text().splitlines()[1:]
        (tum / name).write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    report, _ = imported(tum)
    assert (report.frames, report.with_depth, report.notices) == (6, 6, ())


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        ("1305031102175304000 0 0 0 0 0 0 1", "divide nanoseconds by 1e9"),
        ("1305031102.1 0 0 0 0 0 0 2", "its quaternion has length 2, not 1"),
        ("noon,0,0,0,0,0,0,1", "is not a time in seconds"),
    ],
)
def test_a_trajectory_of_another_form_is_refused_with_its_first_mistake(tum: Path, pose: str, says: str) -> None:
    (tum / "groundtruth.txt").write_text(f"# stamp tx ty tz qx qy qz qw\n{pose}\n")
    with pytest.raises(ImportSourceError, match=f"holds no pose .*; line 2: .*{says}"):
        imported(tum)


def test_tum_lists_cannot_reach_outside_the_recording(tum: Path) -> None:
    lines = (tum / "rgb.txt").read_text().splitlines()
    lines[1] = "1305031102.175304 ../../etc/passwd"
    (tum / "rgb.txt").write_text("\n".join(lines))
    report, _ = imported(tum)
    assert report.frames == 5 and any("outside of it" in notice for notice in report.notices)


def test_each_depth_image_is_matched_once_to_its_nearest() -> None:
    a = np.array([0, 10, 20, 100], np.int64)
    assert match_nearest(a, np.array([9, 21], np.int64), 15) == [-1, 0, 1, -1]
    assert match_nearest(a, np.array([12], np.int64), 15) == [-1, 0, -1, -1]


def test_a_scannet_scene_is_brought_to_the_pixels_of_its_depth(scannet: Path) -> None:
    report, log = imported(scannet)
    assert (report.format, report.frames, report.labelled, report.skipped) == ("scannet", 6, 6, ())
    assert report.info.label_set == NYU40
    for i, frame in enumerate(log):
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
    _, log = imported(scannet)
    frame = log.frame(0)
    assert frame.label is not None
    assert np.array_equal(frame.label[:, 4:], rec.label(0)[:, :-4])
    assert not frame.label[:, :4].any()  # outside the colour image: unknown
    red = frame.rgb[:, 10, 2].astype(int)
    expected = cv2.imread(str(scannet / "color" / "0.jpg"))[::2, 12, 0].astype(int)
    assert np.abs(red - expected).max() <= 8


def test_lost_scannet_poses_and_odd_images_are_left_out(scannet: Path) -> None:
    (scannet / "pose" / "20.txt").write_text("-inf " * 16)
    (scannet / "pose" / "40.txt").unlink()
    (scannet / "depth" / "60.png").unlink()
    rec.write_image(scannet / "color" / "80.jpg", rec.color(4))
    rec.write_image(scannet / "label-filt" / "100.png", rec.label(5)[:5])
    report, log = imported(scannet)
    assert [frame.seq for frame in log] == [0, 3, 5]
    assert log.frame(1).depth_m is None and report.with_depth == 2
    said = reasons(report)
    for number, words in {
        1: "lost track of its pose here (-inf)",
        2: "40.txt: cannot be read",
        4: "the image is 32x24, the others 64x48",
        5: "neither the size of colour nor of depth",
    }.items():
        assert words in said[number], said[number]


def test_raw_scannet_ids_need_the_table_of_the_data_set(scannet: Path) -> None:
    for i in range(6):
        raw = np.repeat(np.repeat(rec.label(i), 2, 0), 2, 1).astype(np.uint16)
        raw[raw == 5] = 1163
        rec.write_image(scannet / "label-filt" / f"{i * 20}.png", raw)
    report, _ = imported(scannet)
    assert (report.frames, report.labelled) == (6, 0) and "scannetv2-labels.combined.tsv" in reasons(report)[0]
    table = "id\traw_category\tnyu40id\n1\twall\t1\n2\tfloor\t2\n1163\tobject\t40\n1164\tnothing\t\n"
    (scannet.parent / "scannetv2-labels.combined.tsv").write_text(table)
    report, log = imported(scannet)
    assert report.labelled == 6
    expected = np.where(rec.label(0) == 5, 40, rec.label(0))
    assert np.array_equal(log.frame(0).label, expected)


@pytest.mark.parametrize("which", ["color", "depth"])
def test_scannet_intrinsics_that_do_not_fit_are_refused_by_their_file(scannet: Path, which: str) -> None:
    (scannet / f"intrinsic/intrinsic_{which}.txt").write_text("0.8 0 0.5 0 0 1.1 0.5 0 0 0 1 0 0 0 0 1")
    with pytest.raises(ImportSourceError, match=f"intrinsic_{which}.txt: .*normalised"):
        imported(scannet)


@pytest.mark.parametrize("missing", ["intrinsic/intrinsic_depth.txt", "intrinsic/intrinsic_color.txt"])
def test_a_scannet_scene_without_intrinsics_is_refused(scannet: Path, missing: str) -> None:
    (scannet / missing).unlink()
    with pytest.raises(ImportSourceError, match=Path(missing).name):
        imported(scannet)


def test_the_kitchen_recording_is_imported_without_loss(redkitchen: Path, tmp_path: Path) -> None:
    dst = tmp_path / "kitchen.mcap"
    report = import_recording(redkitchen, dst, options=ImportOptions(max_frames=4))
    assert (report.frames, report.labelled, report.skipped) == (4, 4, ())
    with LogReader(dst) as log:
        labels = log.info.label_set
        assert labels is not None and len(labels) == 11 and labels.name == "nyu40"
        for i, frame in enumerate(log):
            assert np.array_equal(frame.rgb[..., ::-1], cv2.imread(str(redkitchen / "color" / f"{i:06d}.jpg")))
            raw = cv2.imread(str(redkitchen / "depth" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert frame.depth_m is not None and np.array_equal(frame.depth_m, raw.astype(np.float32) / 1000)
            own = cv2.imread(str(redkitchen / "label" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(frame.label, own)


@pytest.mark.parametrize("name", ["color/000001.jpg", "depth/000001.png", "label/000001.png"])
def test_an_image_that_is_a_pipe_or_a_device_is_left_out(folder: Path, tmp_path: Path, name: str) -> None:
    (folder / name).unlink()
    for make in (lambda: os.mkfifo(folder / name), lambda: (folder / name).symlink_to("/dev/zero")):
        make()
        report = import_recording(folder, tmp_path / "out.mcap")
        assert [(skipped.frame, skipped.file) for skipped in report.skipped] == [(1, folder / name)]
        assert "is no regular file" in report.skipped[0].reason
        (folder / name).unlink()
        (tmp_path / "out.mcap").unlink()


@pytest.mark.parametrize("name", ["poses.txt", "timestamps.txt", "labels.json", "intrinsics.json"])
def test_a_list_that_is_a_pipe_stops_the_import(folder: Path, tmp_path: Path, name: str) -> None:
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(ImportSourceError, match=f"{name}: is no regular file"):
        import_recording(folder, tmp_path / "out.mcap")
