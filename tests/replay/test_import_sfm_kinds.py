"""One bad value of COLMAP, OpenSfM, Record3D or Polycam costs what it is of, and is named."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.colmap_model import MODELS, intrinsics_of
from semantic_mapper.transport.messages import SCENE_DEPTH_KEY

from .test_import_gps import flight, make_opensfm
from .test_import_kinds import change_json, said
from .test_import_posed import (
    POINTS,
    F,
    H,
    W,
    imported,
    make_colmap,
    make_polycam,
    make_record3d,
    poses,
    write_pictures,
)


def replace_in(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


@pytest.mark.parametrize("within", ["", "room"])
def test_pictures_beside_a_model_without_a_pose_are_counted(tmp_path: Path, within: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    (folder / within).mkdir(exist_ok=True)
    for file in (folder / "images").iterdir():
        file.rename(folder / within / file.name)
    replace_in(folder / "sparse" / "0" / "images.txt", " 1 ", f" 1 {within}/" if within else " 1 ")
    write_pictures(folder / within, ["unposed.png"])
    report, frames = imported(folder)
    assert len(frames) == 3 and "1 picture in" in said(report) and "the first: unposed.png" in said(report)


def test_a_cut_file_of_points_costs_points(tmp_path: Path) -> None:
    for kind in ("txt", "bin"):
        folder = make_colmap(tmp_path / kind, kind)
        file = folder / "sparse" / "0" / f"points3D.{kind}"
        file.write_bytes(file.read_bytes()[:-9])
        report, frames = imported(folder)
        assert len(frames) == 3 and "points, but for the first 2" in said(report)
        assert "image left out" not in said(report)


def test_a_point_without_a_position_and_points_that_cannot_be_read_keep_the_scale(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    points = folder / "sparse" / "0" / "points3D.txt"
    replace_in(points, "\n2 2.5", "\n2 nan")
    report, frames = imported(folder)
    assert "1 point without a finite position" in said(report)
    left = POINTS[[0, 2]]
    factor = 2.0 / np.median([(left - T[:3, 3]) @ T[:3, 2] for T in poses()[1:]])
    step = np.linalg.norm(frames[1].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3])
    assert step == pytest.approx(0.2 * factor)
    points.unlink()
    os.mkfifo(points)
    report, frames = imported(folder)
    assert len(frames) == 3 and "is no regular file" in said(report)


@pytest.mark.parametrize(
    ("row", "kept", "says"), [(1, 2, "1 image left out"), (4, 3, "'1.png' is without its features")]
)
def test_a_bad_row_of_images_txt_costs_its_image_or_features(tmp_path: Path, row: int, kept: int, says: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    lines[row] = "x " + lines[row].partition(" ")[2].replace(" ", " x ", 1)
    file.write_text("\n".join(lines) + "\n")
    report, frames = imported(folder)
    assert len(frames) == kept and f"images.txt, line {row + 1}" in said(report) and says in said(report)


@pytest.mark.parametrize("name", ["../{}.png", "a" * 300 + "{}.png"])
def test_a_name_that_cannot_be_a_file_of_the_folder_costs_its_image(tmp_path: Path, name: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    replace_in(folder / "sparse" / "0" / "images.txt", " 1.png", " " + name.format(1))
    report, frames = imported(folder)
    assert len(frames) == 2 and "1 picture in" in said(report)
    assert "lies outside of it" in said(report) or report.skipped


def test_names_as_windows_parts_folders_are_found(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    (folder / "images").rename(folder / "left")
    (folder / "images").mkdir()
    (folder / "left").rename(folder / "images" / "left")
    replace_in(folder / "sparse" / "0" / "images.txt", " 1 ", " 1 left\\")
    assert len(imported(folder)[1]) == 3


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_with_a_mark_and_numbers_of_other_forms_are_read(tmp_path: Path, encoding: str) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    for name in ("cameras", "images", "points3D"):
        file = folder / "sparse" / "0" / f"{name}.txt"
        text = file.read_text().replace(f" {W} {H} {F} ", f", {W}.0, {H}.0, {F}, ".replace("0.0,", "0,0,"))
        file.write_bytes(text.replace("10.5 ", "10,5 ").encode(encoding))
    _, frames = imported(folder)
    assert [frame.intrinsics.fx for frame in frames] == [F] * 3


@pytest.mark.parametrize(("model", "count"), [(11, 16), (18, 5), (99, 5)])
def test_an_unused_camera_of_another_model_does_no_harm(tmp_path: Path, model: int, count: int) -> None:
    folder = make_colmap(tmp_path / "scan", "bin")
    file = folder / "sparse" / "0" / "cameras.bin"
    other = struct.pack(f"<iiQQ{count}d", 2, model, W, H, *range(1, count + 1))
    file.write_bytes(struct.pack("<Q", 2) + file.read_bytes()[8:] + other)
    report, frames = imported(folder)
    assert len(frames) == 3 and ("camera 2 has model 99" in said(report)) == (model == 99)


def test_a_camera_of_an_unknown_model_that_is_used_is_named(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "bin")
    file = folder / "sparse" / "0" / "cameras.bin"
    file.write_bytes(file.read_bytes().replace(struct.pack("<ii", 1, 2), struct.pack("<ii", 1, 99), 1))
    with pytest.raises(ImportSourceError, match=r"camera 1 has model 99, .*image_undistorter"):
        imported(folder)


def test_a_bad_row_of_cameras_txt_costs_its_camera(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    replace_in(folder / "sparse" / "0" / "cameras.txt", "1 SIMPLE", f"2 PINHOLE {W} ? 1 1\n1 SIMPLE")
    report, frames = imported(folder)
    assert len(frames) == 3 and "cameras.txt, line 2" in said(report)


def test_models_of_colmap_are_those_of_pycolmap() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    known = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items() if int(value) >= 0}
    assert known.items() <= {number: name for number, (name, _) in MODELS.items()}.items()
    for number, name in known.items():
        count = MODELS[number][1]
        camera = pycolmap.Camera.create_from_model_name(1, name, 100.0, 640, 480)
        assert len(camera.params) == count, number


@pytest.mark.parametrize(
    ("model", "params", "pinhole"),
    [
        ("SIMPLE_DIVISION", [50, 32, 24, 0], True),
        ("DIVISION", [50, 50, 32, 24, 0], True),
        ("EUCM", [50, 50, 32, 24, 0, 1.0], True),
        ("SIMPLE_FISHEYE", [50, 32, 24], False),
        ("FISHEYE", [50, 50, 32, 24], False),
        ("SKEWED_PINHOLE", [50, 50, 32, 24, 0], True),
        ("BROWN_CONRADY", [50, 32, 24, 0, 0, 0, 0, 0], True),
    ],
)
def test_newer_models_of_colmap_are_judged_by_their_values(model: str, params: list[float], pinhole: bool) -> None:
    found = intrinsics_of(model, 64, 48, params, "camera 1")
    assert (found.fx, found.cx) == (50, 31.5) and found.distorted != pinhole
    for other in ("EQUIRECTANGULAR", "DIVISION", "RAD_TAN_THIN_PRISM_FISHEYE", "SKEWED_PINHOLE"):
        count = dict(MODELS.values())[other]
        with pytest.raises(ImportSourceError, match="image_undistorter"):
            intrinsics_of(other, 64, 48, [1.0] * count, "camera 1")


def test_coefficients_of_brown_conrady_come_in_the_order_of_opencv() -> None:
    """COLMAP has k1 k2 k3 p1 p2, OpenCV k1 k2 p1 p2 k3."""
    found = intrinsics_of("BROWN_CONRADY", 64, 48, [50, 32, 24, 0.1, 0.2, 0.3, 0.01, 0.02], "camera 1")
    assert found.distortion[:5] == (0.1, 0.2, 0.01, 0.02, 0.3) and found.fy == 50


def test_values_of_opensfm_that_are_no_numbers_cost_what_they_are_of(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight(4))
    file = folder / "reconstruction.json"
    (model,) = json.loads(file.read_text())
    model["points"] = {"1": {"coordinates": [float("nan"), 0, 0]}, "2": {"coordinates": [1, 2, 3]}, "3": {}}
    for camera in model["cameras"].values():
        camera["width"] = float(camera["width"])
    next(iter(model["shots"].values()))["capture_time"] = "yesterday"
    file.write_text(json.dumps([model, {"cameras": {}}]))
    report, frames = imported(folder)
    assert len(frames) == 4 and "made up" in said(report)


def changed_opensfm(folder: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """A flight of 4 pictures; what ``change`` returns are further models."""
    file = make_opensfm(folder, flight(4)) / "reconstruction.json"
    (model,) = json.loads(file.read_text())
    file.write_text(json.dumps([model, *(change(model) or ())]))
    return folder


@pytest.mark.parametrize("point", [None, {}, {"coordinates": None}, {"coordinates": [1, "x", 2]}, 3])
def test_a_bad_point_of_opensfm_is_passed_over(tmp_path: Path, point: Any) -> None:
    folder = changed_opensfm(tmp_path / "flight", lambda model: model["points"].update({"3": point}))
    report, frames = imported(folder)
    assert len(frames) == 4 and SCENE_DEPTH_KEY in report.info.metadata


@pytest.mark.parametrize("small", [{}, None, {"shots": None}, {"shots": {}, "cameras": 3}, {"reference_lla": "x"}])
def test_a_small_second_model_of_any_content_ends_no_import(tmp_path: Path, small: Any) -> None:
    report, frames = imported(changed_opensfm(tmp_path / "flight", lambda model: [small]))
    assert len(frames) == 4 and "2 parts" in said(report)


@pytest.mark.parametrize(
    ("name", "shot", "says"),
    [
        ("DJI_0.JPG", None, "shot 'DJI_0.JPG'"),
        ("DJI_0.JPG", {"rotation": [0, 0, 0], "translation": [0, 0, None], "camera": "v2 dji"}, "translation"),
        ("../a.jpg", {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "v2 dji"}, "outside"),
        ("DJI_0.JPG", {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "none"}, "camera 'none'"),
    ],
)
def test_a_bad_shot_of_opensfm_costs_its_picture(tmp_path: Path, name: str, shot: Any, says: str) -> None:
    def change(model: dict[str, Any]) -> None:
        del model["shots"]["DJI_0.JPG"]
        model["shots"][name] = shot
        model["cameras"]["none"] = None

    report, frames = imported(changed_opensfm(tmp_path / "flight", change))
    assert len(frames) == 3 and "1 picture left out" in said(report) and says in said(report)


def test_a_fisheye_with_tangential_coefficients_is_refused(tmp_path: Path) -> None:
    lens = {"projection_type": "fisheye_opencv", "focal_x": 0.8, "focal_y": 0.8, "k1": 0.01, "p1": 0.1}
    with pytest.raises(ImportSourceError, match="p1 and p2 is not read"):
        imported(make_opensfm(tmp_path / "flight", flight(4), **lens))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"w": None, "h": None}, ""),
        ({"w": float(W)}, ""),
        ({"w": str(W), "h": f"{H}.0"}, ""),
        ({"w": 0}, ""),
        ({"fps": "x"}, "made up at 60"),
        ({"frameTimestamps": "x"}, ""),
        ({"perFrameIntrinsicCoeffs": [[50.0, "x", 32.0, 24.0], None, 3]}, ""),
        ({"fps": None, "frameTimestamps": None}, "made up at 60"),
        ({"fps": 0}, "made up at 60"),
        ({"K": [], "perFrameIntrinsicCoeffs": [[50.0, 50.0, 32.0, 24.0]] * 3}, ""),
        ({"perFrameIntrinsicCoeffs": None}, ""),
    ],
)
def test_missing_values_of_record3d_end_no_import(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    folder = make_record3d(tmp_path / "phone")
    change_json(folder / "metadata.json", **changes)
    report, frames = imported(folder)
    assert len(frames) == 3 and says in said(report)


@pytest.mark.parametrize("value", [float("nan"), None, "x"])
def test_a_broken_pose_of_record3d_costs_its_picture(tmp_path: Path, value: Any) -> None:
    folder = make_record3d(tmp_path / "phone")
    found = json.loads((folder / "metadata.json").read_text())
    found["poses"][0] = value
    found["poses"][1][4] = value
    (folder / "metadata.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert [frame.stamp_ns for frame in frames] == [500_000_000] and "2 pictures left out" in said(report)


@pytest.mark.parametrize(
    ("times", "fps", "stamps_ms", "says"),
    [
        ([5.0, 5.5], 10, [0, 500, 600], "lack 1 picture; "),
        ([5.0], 10, [0, 100, 200], "lack 2 pictures; "),
        ([None, 5.0, 5.5], 10, [0, 100, 600], "follow at 10 frames a second"),
        ([5.0, "x", 6.0], 10, [0, 500, 1000], "lack 1 picture; "),
        ([5.0, 5.5], None, [0, 500, 517], "follow at 60 frames a second (assumed)"),
    ],
)
def test_times_that_record3d_lacks_follow_at_its_rate(
    tmp_path: Path, times: list[Any], fps: float | None, stamps_ms: list[int], says: str
) -> None:
    report, frames = imported(make_record3d(tmp_path / "phone", frameTimestamps=times, fps=fps))
    assert [round(frame.stamp_ns / 1e6) for frame in frames] == stamps_ms and says in said(report)


def test_a_pose_of_record3d_without_its_picture_is_counted(tmp_path: Path) -> None:
    folder = make_record3d(tmp_path / "phone")
    (folder / "rgb" / "1.jpg").rename(folder / "rgb" / "7.jpg")
    report, frames = imported(folder)
    assert len(frames) == 2 and "1 pose without a picture" in said(report) and "7.jpg" in said(report)


def test_what_polycam_leaves_unpaired_is_told(tmp_path: Path) -> None:
    keyframes = make_polycam(tmp_path / "scan") / "keyframes"
    sorted((keyframes / "corrected_images").iterdir())[0].unlink()
    report, frames = imported(tmp_path / "scan")
    assert len(frames) == 2 and "1 camera without a picture" in said(report)
    assert "1 picture of images/ that corrected_images/ lacks left out; the first: 5000000.jpg" in said(report)


def test_polycam_without_corrected_pictures_takes_the_others(tmp_path: Path) -> None:
    keyframes = make_polycam(tmp_path / "scan") / "keyframes"
    for file in (keyframes / "corrected_images").iterdir():
        file.unlink()
    for file in (keyframes / "corrected_cameras").iterdir():
        file.rename(keyframes / "cameras" / file.name)
    report, frames = imported(tmp_path / "scan")
    assert len(frames) == 3 and "corrected_images is empty" in said(report)
