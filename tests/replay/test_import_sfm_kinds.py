"""One bad value of COLMAP, OpenSfM, Record3D or Polycam costs what it is of, and is named."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.colmap_model import MODELS, intrinsics_of

from .test_import_gps import flight, make_opensfm
from .test_import_kinds import change_json, said
from .test_import_posed import H, W, imported, make_colmap, make_polycam, make_record3d


def test_a_cut_file_of_points_costs_points(tmp_path: Path) -> None:
    for kind in ("txt", "bin"):
        folder = make_colmap(tmp_path / kind, kind)
        file = folder / "sparse" / "0" / f"points3D.{kind}"
        file.write_bytes(file.read_bytes()[:-9])
        report, frames = imported(folder)
        assert len(frames) == 3 and "points, but for the first" in said(report)


@pytest.mark.parametrize(("row", "kept"), [(1, 2), (4, 3)])
def test_a_bad_row_of_images_txt_costs_its_image_or_features(tmp_path: Path, row: int, kept: int) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    lines[row] = "x " + lines[row].partition(" ")[2].replace(" ", " x ", 1)
    file.write_text("\n".join(lines) + "\n")
    report, frames = imported(folder)
    assert len(frames) == kept and f"images.txt, line {row + 1}" in said(report)


def test_a_name_that_leads_out_of_the_folder_costs_its_image(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    file = folder / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace(" 1.png", " ../1.png"))
    report, frames = imported(folder)
    assert len(frames) == 2 and "lies outside of it" in said(report) and "1 picture in" in said(report)


def test_text_with_a_mark_and_sizes_with_a_point_are_read(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    for name in ("cameras", "images", "points3D"):
        file = folder / "sparse" / "0" / f"{name}.txt"
        text = file.read_text().replace(f" {W} {H} ", f" {W}.0 {H}.0 ")
        file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert len(imported(folder)[1]) == 3


def test_an_unused_camera_of_another_model_does_no_harm(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "bin")
    file = folder / "sparse" / "0" / "cameras.bin"
    other = struct.pack("<iiQQ16d", 2, 11, W, H, *range(1, 17))
    file.write_bytes(struct.pack("<Q", 2) + file.read_bytes()[8:] + other)
    assert len(imported(folder)[1]) == 3


def test_models_of_colmap_are_those_of_pycolmap() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    known = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items() if int(value) >= 0}
    assert known == {number: name for number, (name, _) in MODELS.items()}
    for number, (name, count) in MODELS.items():
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
    ],
)
def test_newer_models_of_colmap_are_judged_by_their_values(model: str, params: list[float], pinhole: bool) -> None:
    found = intrinsics_of(model, 64, 48, params, "camera 1")
    assert (found.fx, found.cx) == (50, 31.5) and found.distorted != pinhole
    for other in ("EQUIRECTANGULAR", "DIVISION", "RAD_TAN_THIN_PRISM_FISHEYE"):
        count = dict(MODELS.values())[other]
        with pytest.raises(ImportSourceError, match="image_undistorter"):
            intrinsics_of(other, 64, 48, [1.0] * count, "camera 1")


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


def test_a_fisheye_with_tangential_coefficients_is_refused(tmp_path: Path) -> None:
    lens = {"projection_type": "fisheye_opencv", "focal_x": 0.8, "focal_y": 0.8, "k1": 0.01, "p1": 0.1}
    with pytest.raises(ImportSourceError, match="p1 and p2 is not read"):
        imported(make_opensfm(tmp_path / "flight", flight(4), **lens))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"w": None, "h": None}, ""),
        ({"w": float(W)}, ""),
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


def test_a_broken_pose_of_record3d_costs_its_picture_and_times_go_on(tmp_path: Path) -> None:
    folder = make_record3d(tmp_path / "phone", frameTimestamps=[5.0, 5.5], fps=10)
    found = json.loads((folder / "metadata.json").read_text())
    found["poses"][1][4] = float("nan")
    (folder / "metadata.json").write_text(json.dumps(found))
    report, frames = imported(folder)
    assert [frame.stamp_ns for frame in frames] == [0, 600_000_000] and "1 picture left out" in said(report)


def test_what_polycam_leaves_unpaired_is_told(tmp_path: Path) -> None:
    keyframes = make_polycam(tmp_path / "scan") / "keyframes"
    sorted((keyframes / "corrected_images").iterdir())[0].unlink()
    report, frames = imported(tmp_path / "scan")
    assert len(frames) == 2 and "1 camera without a picture" in said(report)
    assert "1 picture of images/ that corrected_images/ lacks left out" in said(report)


def test_polycam_without_corrected_pictures_takes_the_others(tmp_path: Path) -> None:
    keyframes = make_polycam(tmp_path / "scan") / "keyframes"
    for file in (keyframes / "corrected_images").iterdir():
        file.unlink()
    for file in (keyframes / "corrected_cameras").iterdir():
        file.rename(keyframes / "cameras" / file.name)
    report, frames = imported(tmp_path / "scan")
    assert len(frames) == 3 and "corrected_images is empty" in said(report)
