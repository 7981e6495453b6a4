"""Rows that are empty, keys of other programs and units mean what they mean, or are named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers.base import ImportOptions, unknown_keys
from semantic_mapper.replay.importers.run import detect_format
from semantic_mapper.replay.importers.transforms import _Transforms, open_transforms  # pyright: ignore[reportPrivateUsage]

from . import recordings as rec
from .test_import_kinds import change_json, said
from .test_import_posed import W, add_depth, imported, make_transforms, poses


def rows_of(file: Path) -> list[str]:
    return file.read_text().splitlines()


@pytest.mark.parametrize("lost", ["", "# lost"])
def test_a_row_that_is_lost_is_a_bad_frame_and_shifts_no_other(tmp_path: Path, lost: str) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    before = imported(folder)[1]
    rows = rows_of(folder / "poses.txt")
    rows[3] = lost
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    report, frames = imported(folder)
    assert [frame.seq for frame in frames] == [0, 1, 2, 4, 5]
    assert [skipped.reason for skipped in report.skipped] == ["line 4: is empty or a comment"]
    assert all((frame.T_world_camera == before[frame.seq].T_world_camera).all() for frame in frames)


def test_empty_lines_between_all_rows_part_them(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    before = imported(folder)[1]
    (folder / "poses.txt").write_text("\n\n".join(rows_of(folder / "poses.txt")))
    report, frames = imported(folder)
    assert len(frames) == 6 and "passed over" in said(report)
    assert (frames[5].T_world_camera == before[5].T_world_camera).all()


def test_a_header_of_timestamps_is_no_row(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    (folder / "timestamps.txt").write_text("timestamp\n" + "\n".join(f"{1 + n / 10}" for n in range(6)))
    report, frames = imported(folder)
    assert [frame.stamp_ns for frame in frames] == [10**9 + n * 10**8 for n in range(6)]
    assert "is a header" in said(report)


@pytest.mark.parametrize("key", ["dist_coeffs", "D", "coeffs", "distortion_coefficients"])
def test_coefficients_of_a_lens_are_read_however_they_are_called(tmp_path: Path, key: str) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    change_json(folder / "intrinsics.json", distortion=[0.1, 0.02, 0, 0, 0])
    expected = imported(folder)[1][0].intrinsics
    found = json.loads((folder / "intrinsics.json").read_text())
    found[key] = found.pop("distortion")
    (folder / "intrinsics.json").write_text(json.dumps(found))
    assert imported(folder)[1][0].intrinsics == expected


def test_a_size_that_is_missing_is_that_of_the_first_image(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    expected = imported(folder)[1][0].intrinsics
    found = json.loads((folder / "intrinsics.json").read_text())
    del found["width"], found["height"]
    (folder / "intrinsics.json").write_text(json.dumps({**found, "distortion": None}))
    assert imported(folder)[1][0].intrinsics == expected


def test_metres_per_unit_are_no_units_per_metre(tmp_path: Path) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    change_json(folder / "intrinsics.json", depth_scale=0.001)
    with pytest.raises(
        ImportSourceError, match="no number of units per metre; where it is metres per unit, write 1000"
    ):
        imported(folder)


@pytest.mark.parametrize(
    "key",
    ["dist_coeffs", "radial", "K", "camera_matrix", "sensor_width", "pose_type", "is_w2c", "readout_ms", "alpha"],
)
def test_keys_that_tell_are_named(key: str) -> None:
    assert unknown_keys([{key: 0.5}], _Transforms) == [key]
    ordinary = {"ply_file_path": "x.ply", "sharpness": 30.0, "colmap_im_id": 3, "mask_path": "m.png", "n_frames": 7}
    assert unknown_keys([ordinary], _Transforms) == []


@pytest.mark.parametrize(
    ("keys", "factor"),
    [
        ({"applied_scale": 0.5}, 2.0),
        ({"applied_transform": [[0, 2, 0, 0], [-2, 0, 0, 0], [0, 0, 2, 0]]}, 0.5),
        ({"units": "cm"}, 0.01),
        ({"unit": "metres", "applied_transform": np.eye(4)[:3].tolist()}, 1.0),
    ],
)
def test_positions_are_what_they_were_before_they_were_scaled(
    tmp_path: Path, keys: dict[str, Any], factor: float
) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf", **keys))
    report, frames = imported(folder)
    assert np.allclose(frames[2].T_world_camera[:3, 3], factor * poses()[2][:3, 3])
    assert ("positions are multiplied" in said(report)) == (factor != 1) and report.info.scale_known


def test_a_unit_that_is_not_known_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportSourceError, match="unit 'furlong' is not known"):
        imported(make_transforms(tmp_path / "nerf", units="furlong"))


@pytest.mark.parametrize(
    ("first", "gap", "unit_ns"),
    [
        (5e9, 33_333_333, 1),
        (1.08e13, 33_333_333, 1),
        (2e8, 33_333, 1000),
        (172_800_000, 33, 1_000_000),
        (1.7e9, 20, 10**9),
        (0.0, 0.5, 10**9),
    ],
)
def test_the_unit_of_times_is_one_in_which_frames_follow_each_other(
    tmp_path: Path, first: float, gap: float, unit_ns: int
) -> None:
    folder = make_transforms(tmp_path / "nerf")
    found = json.loads((folder / "transforms.json").read_text())
    for n, frame in enumerate(found["frames"]):
        frame["timestamp"] = str(first + gap * n)
    (folder / "transforms.json").write_text(json.dumps(found))
    stamps = [frame.stamp_ns for frame in imported(folder)[1]]
    assert np.allclose(np.diff(stamps), gap * unit_ns, rtol=1e-6)


def test_the_field_of_view_of_instant_ngp_is_in_degrees(tmp_path: Path) -> None:
    degrees = float(np.degrees(2 * np.arctan(W / 2 / 50)))
    folder = make_transforms(tmp_path / "nerf", fl_x=None, fl_y=None, x_fov=degrees)
    assert imported(folder)[1][0].intrinsics.fx == pytest.approx(50)


def test_a_lens_a_picture_keeps_memory_bounded(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf", count=20)
    found = json.loads((folder / "transforms.json").read_text())
    for n, frame in enumerate(found["frames"]):
        frame |= {"fl_x": 50 + n / 10, "k1": 0.1}
    (folder / "transforms.json").write_text(json.dumps(found))
    opened = open_transforms(folder, ImportOptions())
    for number in (*range(20), 0):
        assert opened.load(number).frame.intrinsics.fx > 40
    assert len(opened._rectifiers) <= 8  # pyright: ignore[reportPrivateUsage]


def test_a_pose_without_a_picture_is_told_of_scannet(tmp_path: Path) -> None:
    folder = rec.make_scannet(tmp_path / "scene0000_00")
    sorted((folder / "color").iterdir())[3].unlink()
    report, frames = imported(folder)
    assert len(frames) == 5 and "1 pose without a picture" in said(report)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("transforms_train.json", "one transforms.json"),
        ("associations.txt", "ICL-NUIM"),
        ("database.db", "no model"),
        ("rgbd", "Record3D"),
    ],
)
def test_folders_that_are_nearly_a_recording_say_what_is_missing(tmp_path: Path, name: str, says: str) -> None:
    (tmp_path / name).write_text("")
    with pytest.raises(ImportSourceError, match=says):
        detect_format(tmp_path)


@pytest.mark.parametrize(
    ("name", "says"), [("a.sens", "SensReader"), ("transforms.json", "name its folder"), ("a.klg", "poses")]
)
def test_files_say_what_to_name(tmp_path: Path, name: str, says: str) -> None:
    (tmp_path / name).write_text("{}")
    with pytest.raises(ImportSourceError, match=says):
        detect_format(tmp_path / name)


def test_depth_in_the_unit_of_the_poses_is_scaled_with_them(tmp_path: Path) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf", applied_scale=0.5, integer_depth_scale=0.001))
    found = json.loads((folder / "transforms.json").read_text())
    for frame in found["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path")
    (folder / "transforms.json").write_text(json.dumps(found))
    frame = imported(folder)[1][1]
    assert np.allclose(frame.T_world_camera[:3, 3], 2 * poses()[1][:3, 3])
    assert frame.depth_m is not None and np.allclose(frame.depth_m[frame.depth_m > 0], 2 * 1.501)
