"""What programs write in many ways means the same in every importer: units, lenses, numbers, parts that are missing."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.nodes.cli.main import main
from semantic_mapper.replay.corrected_poses import read_corrections
from semantic_mapper.replay.importers import detect_format
from semantic_mapper.replay.importers.base import seconds_to_ns, split_row, unknown_keys
from semantic_mapper.replay.importers.transforms import _Transforms  # pyright: ignore[reportPrivateUsage]
from semantic_mapper.replay.log.format import LogWriter
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float64
from tests.small import tiny_frames

from . import bags
from . import recordings as rec
from .bags import CAMERA, COLOR, DEPTH, DEPTH_INFO, INFO, Event, Messages
from .test_import_gps import flight, make_opensfm
from .test_import_posed import H, W, add_depth, imported, make_colmap, make_record3d, make_transforms
from .test_import_rosbag import FRAMES, make


def change_json(file: Path, **more: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **more}))


def said(report: Any) -> str:
    return " ".join(report.notices)


# A key that changes what numbers mean.


def test_both_focal_angles_are_used(tmp_path: Path) -> None:
    angles = {"camera_angle_x": 2 * np.arctan(W / 2 / 50), "camera_angle_y": 2 * np.arctan(H / 2 / 60)}
    _, frames = imported(make_transforms(tmp_path / "nerf", fl_x=None, fl_y=None, **angles))
    assert (frames[0].intrinsics.fx, frames[0].intrinsics.fy) == pytest.approx((50, 60))


@pytest.mark.parametrize("flag", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_of_transforms_json_is_undone(tmp_path: Path, flag: dict[str, Any]) -> None:
    _, frames = imported(make_transforms(tmp_path / "nerf", k1=0.1, k4=0.01, **flag))
    assert frames[0].intrinsics.distortion == () and frames[0].intrinsics.fx != pytest.approx(50, rel=0.02)


def test_each_picture_of_record3d_has_its_own_intrinsics_and_time(tmp_path: Path) -> None:
    own = [[50.0 + n, 51.0 + n, 30.0 + n, 25.0 - n] for n in range(3)]
    folder = make_record3d(tmp_path / "phone", perFrameIntrinsicCoeffs=own, frameTimestamps=[7.0, 7.5, 8.25])
    for frame, (fx, fy, cx, cy) in zip(imported(folder)[1], own, strict=True):
        k = frame.intrinsics
        assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx((fx, fy, cx - 0.5, cy - 0.5))
    assert [frame.stamp_ns for frame in imported(folder)[1]] == [0, 500_000_000, 1_250_000_000]


def test_keys_that_tell_of_lens_axes_unit_or_time_and_are_not_read_are_named(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf", rolling_shutter=[0, 0, 0, 1.0], fisheye_crop_radius=0, aabb_scale=16)
    report, _ = imported(folder)
    assert "'rolling_shutter' is not read" in said(report)
    assert "aabb_scale" not in said(report) and "crop" not in said(report)
    tables = [{"unit": "metres", "flip_y": True, "pose_rotation": np.eye(3).tolist(), "lens": [0.0]}]
    assert unknown_keys(tables, _Transforms) == ["flip_y"]


def test_a_lens_in_intrinsics_json_is_undone_with_depth_and_labels(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    before = imported(folder)[1]
    change_json(folder / "intrinsics.json", distortion=[0.3], axes="x forward")
    report, frames = imported(folder)
    assert frames[0].intrinsics.distortion == () and frames[0].intrinsics.fx != before[0].intrinsics.fx
    assert not np.array_equal(frames[0].rgb, before[0].rgb)
    assert frames[0].depth_m is not None and frames[0].label is not None
    assert "'axes' is not read" in said(report)


def test_depth_of_instant_ngp_is_in_the_unit_of_the_poses(tmp_path: Path) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf"))
    found = json.loads((folder / "transforms.json").read_text())
    for frame in found["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path")
    (folder / "transforms.json").write_text(json.dumps({**found, "integer_depth_scale": 1 / 500}))
    report, frames = imported(folder, scale=2.0)
    depth = frames[0].depth_m
    assert report.info.scale_known and depth is not None and depth.max() == pytest.approx(1500 / 500 * 2, rel=1e-6)
    (folder / "transforms.json").write_text(json.dumps(found))
    with pytest.raises(ImportSourceError, match=r"depth_path needs integer_depth_scale.*--topic depth=none"):
        imported(folder)
    assert imported(folder, topics={"depth": "none"})[0].with_depth == 0


# Nothing is left out silently, and one bad value ends no import.


def test_the_largest_colmap_model_is_imported_and_the_rest_is_counted(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    small = folder / "sparse" / "0"
    shutil.copytree(small, folder / "sparse" / "1")
    lines = (small / "images.txt").read_text().splitlines()
    (small / "images.txt").write_text("\n".join(lines[:3]) + "\n")
    shutil.copy(folder / "images" / "0.png", folder / "images" / "unposed.png")
    (folder / "images" / "0.png").unlink()
    report, frames = imported(folder)
    assert len(frames) == 2 and len(report.skipped) == 1
    assert "largest of 2 models is imported, 1 of 3 pictures; left out: 0 of 1" in said(report)
    assert "1 picture in" in said(report) and "unposed.png" in said(report)


def test_a_bad_frame_of_transforms_json_and_a_picture_twice_are_told(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf", w=None, h=None)
    found = json.loads((folder / "transforms.json").read_text())
    found["frames"] += [found["frames"][0], {"file_path": "images/x.png", "transform_matrix": None}]
    (folder / "images" / "frame_00001.png").unlink()
    (folder / "transforms.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert len(frames) == 2 and "1 pictures are there twice" in said(report)
    assert "1 frame of 5 left out" in said(report) and "no transform_matrix" in said(report)


def test_poses_and_pictures_of_record3d_that_do_not_pair_are_told(tmp_path: Path) -> None:
    folder = make_record3d(tmp_path / "phone")
    rows = json.loads((folder / "metadata.json").read_text())["poses"]
    change_json(folder / "metadata.json", poses=[rows[0], None, rows[2], rows[2]])
    report, frames = imported(folder)
    assert len(frames) == 2 and "1 picture left out" in said(report) and "1 pose without a picture" in said(report)


@pytest.mark.parametrize(
    ("lines", "count", "says"),
    [
        ("1.0 0 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1", 1, "second pose of this stamp"),
        ("2.0 0 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1", 2, ""),
    ],
)
def test_poses_of_one_stamp_are_no_corrections(tmp_path: Path, lines: str, count: int, says: str) -> None:
    (tmp_path / "poses.txt").write_text(lines)
    if says:
        with pytest.raises(ImportSourceError, match=says):
            read_corrections(tmp_path / "poses.txt")
    else:
        assert len(read_corrections(tmp_path / "poses.txt").stamps_ns) == count


def test_stamps_that_go_back_and_lines_twice_are_told_of_tum(tmp_path: Path) -> None:
    folder = rec.make_tum(tmp_path / "desk")
    for name in ("rgb.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([*lines[::-1], lines[-1] if name == "rgb.txt" else lines[0]]))
    report, frames = imported(folder)
    assert len(frames) == 6 and [f.stamp_ns for f in frames] == sorted(f.stamp_ns for f in frames)
    assert "rgb.txt: stamps go back" in said(report) and "groundtruth.txt: stamps go back" in said(report)
    assert "is there already" in said(report)


def test_tf_that_tells_two_poses_of_one_stamp_and_an_empty_calibration_are_told(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        empty = m.info(bags.START_NS, CAMERA, FRAMES[0].intrinsics)
        empty.k[:], empty.p[:] = 0, 0
        other = np.eye(4)
        other[0, 3] = 5.0
        ns = bags.stamp_of(5)
        return [(INFO, bags.START_NS - 1, empty), *events, ("/tf", ns + 1, m.tf(ns, "odom", "base_link", other))]

    report, frames = imported(make(tmp_path, "mcap", change))
    assert len(frames) == 6 and frames[0].intrinsics == FRAMES[0].intrinsics
    assert "1 pose with the stamp of another one" in said(report)
    assert f"{INFO}: 1 message without a calibration" in said(report)


# Numbers and formats in every usual form.


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1.305031102175303936e+09", 1305031102175303936),
        ("1305031102.175304", 1305031102175304000),
        ("2E-3", 2_000_000),
    ],
)
def test_seconds_in_any_form_are_exact(text: str, ns: int) -> None:
    assert seconds_to_ns(text) == ns


@pytest.mark.parametrize(
    "row",
    ["1.5 2 -3e-1", "1.5,2,-3e-1", "1.5; 2; -3e-1", "1,5;2;-3e-1", "1.5\t2\t-3e-1", "1,5 2 -3e-1", "1.5, 2, -3e-1,"],
)
def test_rows_are_parted_by_what_programs_use(row: str) -> None:
    assert [float(word) for word in split_row(row)] == [1.5, 2.0, -0.3]


def test_json_with_a_mark_is_read(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    for encoding in ("utf-8-sig", "utf-16"):
        text = (folder / "transforms.json").read_bytes()
        (folder / "transforms.json").write_text(json.dumps(json.loads(text)), encoding=encoding)
        assert imported(folder)[0].frames == 3


def packed(src: Path, dst: Path) -> Path:
    dst.write_bytes(zstandard.ZstdCompressor().compress(src.read_bytes()))
    return dst


def without_profile(src: Path, dst: Path) -> Path:
    with src.open("rb") as source, dst.open("wb") as out:
        writer = Writer(out)
        writer.start(profile="")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                of = schemas[schema.id]
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return dst


@pytest.mark.parametrize(
    ("kind", "name", "make_file"),
    [
        ("mcap", "merged.mcap", without_profile),
        ("sqlite3", "day.db3.zstd", packed),
        ("mcap", "day.zstd", packed),
        ("ros1", "renamed.data", shutil.copy),
        ("sqlite3", "renamed.db", shutil.copy),
    ],
)
def test_bags_are_known_by_their_content(
    tmp_path: Path, kind: bags.Kind, name: str, make_file: Callable[[Path, Path], Path]
) -> None:
    src = make(tmp_path, kind)
    file = src if src.is_file() else next(f for f in src.iterdir() if f.suffix != ".yaml")
    made = Path(make_file(file, tmp_path / name))
    assert detect_format(made) == "rosbag"
    report, frames = imported(made)
    assert report.frames == 6 and np.array_equal(frames[3].rgb, FRAMES[3].rgb)


def test_a_recording_of_the_realsense_viewer_is_known_and_says_what_it_lacks(tmp_path: Path) -> None:
    names = {
        COLOR: "/device_0/sensor_1/Color_0/image/data",
        INFO: "/device_0/sensor_1/Color_0/info/camera_info",
        DEPTH: "/device_0/sensor_0/Depth_0/image/data",
        DEPTH_INFO: "/device_0/sensor_0/Depth_0/info/camera_info",
    }

    def change(_: Messages, events: list[Event]) -> list[Event]:
        return [(names[topic], ns, message) for topic, ns, message in events if topic in names]

    with pytest.raises(ImportSourceError, match=r"has no poses.*RealSense Viewer have none"):
        imported(make(tmp_path, "ros1", change))


def test_links_of_the_users_own_are_followed(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    shutil.move(folder / "images", tmp_path / "far")
    os.symlink(tmp_path / "far", folder / "images")
    assert imported(folder)[0].frames == 3
    desk = rec.make_tum(tmp_path / "desk")
    shutil.move(desk / "rgb", tmp_path / "rgb")
    os.symlink(tmp_path / "rgb", desk / "rgb")
    assert imported(desk)[0].frames == 6


# Calibrations that contradict each other, and depth of another form.


def other_lens(topic: str) -> Callable[[Messages, list[Event]], list[Event]]:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        k = FRAMES[0].intrinsics
        other = type(k)(0.9 * k.fx, 0.9 * k.fy, k.cx, k.cy, k.width, k.height)
        kept = [event for event in events if event[0] != topic]
        return [*kept, (topic, bags.START_NS, m.info(bags.START_NS, CAMERA, other))]

    return change


def test_depth_of_one_frame_and_another_lens_is_asked_about(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap", other_lens(DEPTH_INFO))
    with pytest.raises(ImportSourceError, match=rf"other intrinsics.*--topic depth_info={INFO}"):
        imported(src)
    _, frames = imported(src, topics={"depth_info": INFO})
    assert frames[0].depth_m is not None
    assert np.array_equal(frames[0].depth_m, bags.millimetres(FRAMES[0]).astype(np.float32) / np.float32(1000))
    _, warped = imported(src, topics={"depth_info": DEPTH_INFO})
    assert warped[0].depth_m is not None and not np.array_equal(warped[0].depth_m, frames[0].depth_m)


def test_two_calibrations_of_one_camera_frame_are_asked_about(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap", other_lens("/camera/rgb/camera_info"))
    with pytest.raises(ImportSourceError, match=rf"two calibrations.*--topic info={INFO}"):
        imported(src)
    assert imported(src, topics={"info": INFO})[1][0].intrinsics == FRAMES[0].intrinsics


def test_depth_of_another_form_is_refused_and_not_stretched(tmp_path: Path) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf"))
    for file in (folder / "depths").iterdir():
        cv2.imwrite(str(file), np.full((H, W // 2), 1500, np.uint16))
    with pytest.raises(ImportSourceError, match=r"another form.*--topic depth=none"):
        imported(folder)
    assert imported(folder, topics={"depth": "none"})[0].frames == 3


# Long captures, and errors that say what to do.


def test_captures_of_half_an_hour_and_long_trajectories_open(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf", count=1)
    found = json.loads((folder / "transforms.json").read_text())
    row = found["frames"][0]
    many = [{**row, "file_path": f"images/frame_1{n:06d}.png"} for n in range(30_000)]
    text = json.dumps({**found, "frames": [row, *many], "padding": "x" * 60_000_000})  # as large as 30 minutes at 60 Hz
    (folder / "transforms.json").write_text(text)
    assert imported(folder, max_frames=1)[0].frames == 1
    kitchen = rec.make_folder(tmp_path / "kitchen")
    rows = (kitchen / "poses.txt").read_text().splitlines()
    (kitchen / "poses.txt").write_text("\n".join(rows + rows[:1] * 100_000))
    report, frames = imported(kitchen)
    assert len(frames) == 6 and "100000 rows of poses.txt without an image" in said(report) and not report.skipped


@pytest.mark.parametrize("kind", ["transforms", "folder"])
def test_depth_as_numpy_writes_it_is_read(tmp_path: Path, kind: str) -> None:
    depth = np.full((H, W), 1.25, np.float32)
    depth[0] = np.nan
    if kind == "transforms":
        folder = add_depth(make_transforms(tmp_path / "nerf"))
        found = json.loads((folder / "transforms.json").read_text())
        for n, frame in enumerate(found["frames"]):
            np.save(folder / "depths" / f"{n}.npy", depth)
            frame["depth_file_path"] = f"depths/{n}.npy"
        (folder / "transforms.json").write_text(json.dumps(found))
    else:
        folder = rec.make_folder(tmp_path / "kitchen")
        first = imported(folder)[1][0].rgb
        depth = np.full(first.shape[:2], 1.25, np.float32)
        depth[0] = np.nan
        for file in (folder / "depth").iterdir():
            np.save(file.with_suffix(".npy"), depth)
            file.unlink()
    report, frames = imported(folder)
    got = frames[1].depth_m
    assert report.with_depth == report.frames and got is not None
    assert (got[0] == 0).all() and np.allclose(got[1:], 1.25)


def test_clocks_that_differ_are_named_with_both_ranges(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] != "/tf"]
        return [*kept, *(("/tf", bags.stamp_of(n), m.tf(10**9 * n, "odom", "base_link", np.eye(4))) for n in range(3))]

    with pytest.raises(ImportSourceError, match=r"images of .* are from .*'odom' to 'base_link' from 0.000 to 2.000 s"):
        imported(make(tmp_path, "mcap", change))


def test_what_is_no_recording_says_what_to_do(tmp_path: Path) -> None:
    room = tmp_path / "room0"
    (room / "results").mkdir(parents=True)
    (room / "traj.txt").touch()
    (tmp_path / "scan.r3d").write_bytes(b"PK\3\4")
    (tmp_path / "empty").mkdir()
    for src, says in (
        (room, "NICE-SLAM"),
        (tmp_path / "scan.r3d", "EXR"),
        (tmp_path / "empty", "colmap.*opensfm.*rosbag"),
    ):
        with pytest.raises(ImportSourceError, match=says):
            detect_format(src)


def turned(T: Float64) -> Float64:
    """A camera's pose, wrongly told as that of a body with x forward."""
    T_body_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return T @ np.linalg.inv(T_body_camera)


@pytest.mark.slow
def test_a_map_that_cannot_be_trusted_has_an_exit_code_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with LogWriter(tmp_path / "log.mcap", StreamInfo(source="test")) as log:
        for frame in tiny_frames(30, seed=13):
            log.write_frame(replace(frame, T_world_camera=turned(frame.T_world_camera)))
    words = [
        "semantic-mapper",
        "replay",
        str(tmp_path / "log.mcap"),
        "--out",
        str(tmp_path / "run"),
        "--quality",
        "fast",
    ]
    for more, code in (([], 3), (["--accept-contradictions"], 0)):
        monkeypatch.setattr(sys, "argv", [*words, *more])
        try:
            got = main() or 0
        except SystemExit as error:
            got = error.code
        assert got == code
    assert "x forward" in json.loads((tmp_path / "run" / "summary.json").read_text())["pose_check"]["warning"]


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"equirectangular": True}, "'equirectangular' is not read"),
        ({"ftheta_p1": 0.1}, "'ftheta_p1' is not read"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "'distortion_params' is not read"),
        ({"coordinate_system": "unity"}, "'coordinate_system' is 'unity'"),
        ({"lens_model": "omni"}, "'omni' is not undone"),
    ],
)
def test_lenses_and_axes_of_other_kinds_are_refused_by_name(tmp_path: Path, keys: dict[str, Any], says: str) -> None:
    with pytest.raises(ImportSourceError, match=says):
        imported(make_transforms(tmp_path / "nerf", **keys))


def test_axes_that_are_told_are_used_and_nested_lenses_named(tmp_path: Path) -> None:
    plain = imported(make_transforms(tmp_path / "gl"))[1][0]
    folder = make_transforms(tmp_path / "cv", coordinate_system="opencv", camera={"k1": 0.1, "name": "front"})
    report, frames = imported(folder)
    turned_back = np.diag((1.0, -1.0, -1.0, 1.0))
    assert np.allclose(frames[0].T_world_camera @ turned_back, plain.T_world_camera)
    assert "'camera' is not read" in said(report)


def test_what_a_frame_tells_comes_before_what_all_tell(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    found = json.loads((folder / "transforms.json").read_text())
    found["frames"][0]["camera_angle_x"] = 2 * np.arctan(W / 2 / 40)
    found["frames"][1]["fl_x"] = "wide"
    (folder / "transforms.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert [round(frame.intrinsics.fx) for frame in frames] == [40, 50] and "1 frame of 3 left out" in said(report)


def test_the_model_of_a_lens_in_intrinsics_json_is_used(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    change_json(folder / "intrinsics.json", distortion=[0.1], distortion_model="equidistant")
    fisheye = imported(folder)[1][0].intrinsics
    change_json(folder / "intrinsics.json", distortion_model="plumb_bob")
    assert imported(folder)[1][0].intrinsics != fisheye
    change_json(folder / "intrinsics.json", distortion_model="omni")
    with pytest.raises(ImportSourceError, match="'omni' is not undone"):
        imported(folder)


def test_whole_seconds_among_others_are_seconds(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    (folder / "timestamps.txt").write_text("1\n1.5\n2\n2,5\n3e0\n4\n")
    assert [frame.stamp_ns for frame in imported(folder)[1]] == [10**9 * n // 2 for n in (2, 3, 4, 5, 6, 8)]


def test_record3d_falls_back_to_k_and_its_times_are_sorted(tmp_path: Path) -> None:
    own = [[50.0, 51.0, 30.0, 25.0], None, [0.0, 0.0, 0.0, 0.0]]
    folder = make_record3d(tmp_path / "phone", perFrameIntrinsicCoeffs=own, frameTimestamps=[7.5, 7.0, None])
    report, frames = imported(folder)
    assert len(frames) == 3 and sorted(frame.intrinsics.fy for frame in frames) == [50.0, 50.0, 51.0]
    assert "times of the pictures go back" in said(report)


def test_parts_of_a_bag_are_joined_however_their_suffix_is_written(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap")
    (src / "metadata.yaml").unlink()
    (file,) = src.iterdir()
    file.rename(src / "part.MCAP")
    assert imported(src)[0].frames == 6


def test_windows_paths_are_found_and_lead_nowhere_else(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    text = (folder / "transforms.json").read_text().replace("images/", "images\\\\")
    (folder / "transforms.json").write_text(text)
    assert imported(folder)[0].frames == 3
    (folder / "transforms.json").write_text(text.replace("images", ".."))
    with pytest.raises(ImportSourceError, match="outside of it"):
        imported(folder)


@pytest.mark.parametrize(
    ("times", "said_unit", "stamps_ms"),
    [
        ([1.7e9, 1.7e9 + 0.5, 1.7e9 + 1.5], "seconds, 1.33 frames", [1.7e12, 1.7e12 + 500, 1.7e12 + 1500]),
        ([0, 33, 66], "milliseconds, 30.3 frames", [0, 33, 66]),
        ([1_700_000_000_000_000, 1_700_000_000_500_000, 1_700_000_001_000_000], "microseconds, 2 frames", None),
        ([5.0, 4.0, 4.0], "seconds", [4000, 4001, 5000]),
    ],
)
def test_the_times_of_frames_are_used_and_their_unit_is_said(
    tmp_path: Path, times: list[float], said_unit: str, stamps_ms: list[float] | None
) -> None:
    folder = make_transforms(tmp_path / "nerf")
    found = json.loads((folder / "transforms.json").read_text())
    for frame, time in zip(found["frames"], times, strict=True):
        frame["timestamp"] = time
    (folder / "transforms.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert f"'timestamp' is read as {said_unit}" in said(report) and "made up" not in said(report)
    got = [frame.stamp_ns / 1e6 for frame in frames]
    assert got == (stamps_ms or [1.7e12, 1.7e12 + 500, 1.7e12 + 1000])
    assert ("time of another one" in said(report)) == (times[2] == times[1])


def test_a_time_that_is_missing_makes_all_stamps_up_and_says_so(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    found = json.loads((folder / "transforms.json").read_text())
    found["frames"][0]["timestamp"] = 3.0
    (folder / "transforms.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert "2 of 3 pictures have no time: stamps are made up" in said(report)
    assert [frame.stamp_ns for frame in frames] == [0, 500_000_000, 1_000_000_000]


def test_the_capture_times_and_broken_shots_of_opensfm(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight(5))
    file = folder / "reconstruction.json"
    (model,) = json.loads(file.read_text())
    for n, shot in enumerate(model["shots"].values()):
        shot["capture_time"] = 1.7e9 + n
    names = sorted(model["shots"])
    model["shots"][names[1]]["rotation"] = [float("nan"), 0, 0]
    model["shots"][names[2]]["camera"] = "another"
    model["cameras"]["unused"] = {"width": 10, "height": 10, "projection_type": "dual"}
    file.write_text(json.dumps([model]))
    report, frames = imported(folder)
    assert [frame.stamp_ns for frame in frames] == [1_700_000_000 * 10**9, 1_700_000_003 * 10**9, 1_700_000_004 * 10**9]
    assert "2 pictures left out" in said(report) and "made up" not in said(report)


@pytest.mark.parametrize("what", ["pose", "camera", "lens"])
def test_a_broken_image_or_camera_of_colmap_costs_its_images_only(tmp_path: Path, what: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    sparse = folder / "sparse" / "0"
    lines = (sparse / "images.txt").read_text().splitlines()
    words = lines[3].split(" ")
    words[1 if what == "pose" else 8] = "9.0" if what == "pose" else "2"
    lines[3] = " ".join(words)
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    if what == "lens":
        with (sparse / "cameras.txt").open("a") as file:
            file.write(f"2 FOV {W} {H} 50 50 {W / 2} {H / 2} 0.9\n")
    report, frames = imported(folder)
    assert len(frames) == 2 and "1 image left out" in said(report)
    assert {"pose": "no unit quaternion", "camera": "is missing", "lens": "'FOV' is not read"}[what] in said(report)


@pytest.mark.parametrize("row", ["FOV {} 50 50 32 24 0", "THIN_PRISM_FISHEYE {} 50 50 32 24 0.1 0 0 0 0 0.01 0 0"])
def test_lenses_of_colmap_are_judged_by_their_values(tmp_path: Path, row: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    (folder / "sparse" / "0" / "cameras.txt").write_text(f"1 {row.format(f'{W} {H}')}\n")
    frames = imported(folder)[1]
    assert len(frames) == 3 and (frames[0].intrinsics.fx == 50) == row.startswith("FOV")


def test_one_row_of_timestamps_that_is_no_time_costs_its_frame(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    (folder / "timestamps.txt").write_text("1.0\n1.5\nnan\n2.5\n3.0\n3.5\n")
    report, frames = imported(folder)
    assert [frame.stamp_ns for frame in frames] == [10**9 * n // 2 for n in (2, 3, 5, 6, 7)]
    assert "row 3 is no time" in report.skipped[0].reason


def test_the_number_that_tells_files_apart_counts(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    for part in ("color", "depth"):
        for file in list((folder / part).iterdir()):
            file.rename(file.with_name(f"cam0_{file.name}"))
    report, frames = imported(folder)
    assert len(frames) == report.with_depth == 6 and "left out" not in said(report)


def test_depth_in_npz_and_rows_in_brackets_are_read(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    before = imported(folder)[1][1]
    assert before.depth_m is not None
    for file in (folder / "depth").iterdir():
        np.savez(file.with_suffix(".npz"), depth=np.full(before.depth_m.shape, 1500, np.uint16))
        file.unlink()
    rows = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(f"[{', '.join(row.split())}]" for row in rows))
    report, frames = imported(folder)
    assert report.with_depth == 6 and "NumPy's files is taken as metres" in said(report)
    assert frames[1].depth_m is not None and (frames[1].depth_m == 1.5).all()
    assert (frames[1].T_world_camera == before.T_world_camera).all()


def test_depth_of_scannet_is_left_out_where_it_is_asked_for(tmp_path: Path) -> None:
    folder = rec.make_scannet(tmp_path / "scene0000_00")
    for file in (folder / "depth").iterdir():
        file.unlink()
    report, frames = imported(folder, topics={"depth": "none"})
    assert frames and report.with_depth == 0


def test_a_camera_info_without_a_size_takes_that_of_the_images(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        return [(topic, ns, replace(x, width=0, height=0) if topic == INFO else x) for topic, ns, x in events]

    report, frames = imported(make(tmp_path, "mcap", change))
    assert frames and "tells no size" in said(report)
    assert frames[0].intrinsics == FRAMES[0].intrinsics
