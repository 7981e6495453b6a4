"""Posed picture collections: transforms.json, COLMAP, Polycam, Record3D, OpenSfM."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.replay.importers.run import detect_format
from semantic_mapper.replay.sfm.colmap import intrinsics_of
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY
from tests.replay import recordings as rec
from tests.replay.recordings import POINTS, F, H, W, flight, imported, poses, said


def change(folder: Path, frames: list[dict[str, Any]], **more: Any) -> None:
    """Of transforms.json: add to each of its frames, and to the file; None = leave out."""
    found = json.loads((folder / "transforms.json").read_text())
    found |= {"frames": [old | new for old, new in zip(found["frames"], frames, strict=True)], **more}
    found = {key: value for key, value in found.items() if value is not None}
    (folder / "transforms.json").write_text(json.dumps(found))


def test_poses_of_transforms_json_change_axes_and_keep_their_unit(tmp_path: Path) -> None:
    report, frames = imported(rec.make_transforms(tmp_path / "nerf", "frame_{}.png", 11))  # 10 comes behind 9
    assert (report.format, report.frames, report.info.scale_known) == ("transforms", 11, False)
    assert "stamps are made up at 2 frames a second" in said(report) and "scale is unknown" in said(report)
    for frame, T in zip(frames, poses(11), strict=True):
        assert np.allclose(frame.T_world_camera, T, atol=1e-12) and frame.stamp_ns == 500_000_000 * frame.seq
        assert (frame.intrinsics.fx, frame.intrinsics.cx, frame.intrinsics.cy) == (F, 31.5, 23.5)


def test_depth_of_transforms_json_makes_its_poses_metric_and_has_a_unit_of_its_own(tmp_path: Path) -> None:
    folder = rec.add_depth(rec.make_transforms(tmp_path / "nerf"))
    report, frames = imported(folder)
    assert report.info.scale_known and report.with_depth == 3 and "stamps are made up" in report.notices[0]
    depth = frames[1].depth_m
    assert depth is not None and np.allclose(depth[H // 2 + 1 :], 1.501) and (depth[: H // 2 - 1] == 0).all()
    report, frames = imported(folder, scale=2.0)
    assert np.array_equal(frames[1].depth_m, depth) and "depth images keep their own unit" in said(report)
    assert np.allclose(frames[2].T_world_camera[:3, 3], 2 * poses()[2][:3, 3])
    with pytest.raises(ImportSourceError, match="in metres"):
        imported(rec.make_record3d(tmp_path / "phone"), scale=2.0)


def test_depth_follows_its_picture_when_the_lens_is_undone(tmp_path: Path) -> None:
    folder = rec.add_depth(rec.make_transforms(tmp_path / "nerf", k1=0.5))
    picture, units = np.zeros((H, W, 3), np.uint8), np.full((H, W), 3000, np.uint16)
    picture[8:20, 6:18], units[8:20, 6:18] = 255, 1000
    cv2.imwrite(str(folder / "images" / "frame_00001.png"), picture)
    cv2.imwrite(str(folder / "depths" / "0.png"), units)
    frame = imported(folder)[1][0]
    assert frame.depth_m is not None
    white = frame.rgb[..., 0] > 127
    assert (white != (picture[..., 0] > 127)).sum() > 40  # the square has moved
    assert (white != (frame.depth_m < 2)).sum() < 30  # its depth with it, but for some of its edge


def test_a_field_of_view_names_without_suffix_and_a_lens_are_understood(tmp_path: Path) -> None:
    folder = rec.make_transforms(tmp_path / "nerf", k1=-0.2)
    names = [{"file_path": f"images/frame_{n + 1:05d}"} for n in range(3)]
    angles = {"camera_angle_x": 2 * np.arctan(W / 2 / F), "camera_angle_y": 2 * np.arctan(H / 2 / 60)}
    change(folder, names, **dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "w", "h")), **angles)
    _, frames = imported(folder)
    k = frames[0].intrinsics
    assert not k.distortion and k.fx != pytest.approx(F) and k.fy != pytest.approx(60)  # rectified
    assert k.fx / k.fy == pytest.approx(F / 60, rel=0.1)


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_a_colmap_model_is_imported_upright(tmp_path: Path, kind: str) -> None:
    folder = rec.make_colmap(tmp_path / "scan", kind)
    report, frames = imported(folder, scale=2.0)
    assert (report.format, report.frames, report.info.scale_known) == ("colmap", 3, True)
    moved = [frame.T_world_camera for frame in frames]
    for T, true in zip(moved, poses(), strict=True):
        assert np.allclose(T[:3, 1], (0, 0, -1), atol=1e-9)  # image down is down
        assert np.allclose(T[:3, 3] - moved[0][:3, 3], 2 * (true[:3, 3] - poses()[0][:3, 3]), atol=1e-9)
    assert (frames[0].intrinsics.fx, frames[0].intrinsics.cx) == (F, 31.5)
    report, frames = imported(folder)  # without a scale it is made of room size
    assert not report.info.scale_known
    depths = [(POINTS - T[:3, 3]) @ T[:3, 2] for T in poses()]
    factor = 2.0 / np.median(depths)
    step = np.linalg.norm(frames[1].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3])
    assert step == pytest.approx(0.2 * factor)


@pytest.mark.parametrize(("kind", "make"), [("polycam", rec.make_polycam), ("record3d", rec.make_record3d)])
def test_exports_of_phones_have_poses_times_and_trusted_depth(
    tmp_path: Path, kind: str, make: Callable[[Path], Path]
) -> None:
    report, frames = imported(make(tmp_path / "capture"))
    assert (report.format, report.frames, report.info.scale_known) == (kind, 3, True)
    for n, (frame, T) in enumerate(zip(frames, poses(), strict=True)):
        assert np.allclose(frame.T_world_camera, T, atol=1e-9) and frame.stamp_ns == 250_000_000 * n
        assert (frame.intrinsics.cx, frame.intrinsics.cy) == (31.5, 23.5)
        if kind == "polycam":
            assert frame.depth_m is not None and frame.depth_m.shape == (H, W)
            assert (frame.depth_m[:, :4] == 0).all() and np.allclose(frame.depth_m[:, 4:], 1.25)


@pytest.mark.parametrize("flag", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_of_transforms_json_is_undone(tmp_path: Path, flag: dict[str, Any]) -> None:
    _, frames = imported(rec.make_transforms(tmp_path / "nerf", k1=0.1, k4=0.01, **flag))
    assert frames[0].intrinsics.distortion == () and frames[0].intrinsics.fx != pytest.approx(50, rel=0.02)


def test_each_picture_of_record3d_has_its_own_intrinsics_and_time_or_else_k(tmp_path: Path) -> None:
    own = [[50.0 + n, 51.0 + n, 30.0 + n, 25.0 - n] for n in range(3)]
    folder = rec.make_record3d(tmp_path / "phone", perFrameIntrinsicCoeffs=own, frameTimestamps=[7.0, 7.5, 8.25])
    frames = imported(folder)[1]
    for frame, (fx, fy, cx, cy) in zip(frames, own, strict=True):
        k = frame.intrinsics
        assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx((fx, fy, cx - 0.5, cy - 0.5))
    assert [frame.stamp_ns for frame in frames] == [0, 500_000_000, 1_250_000_000]
    times = [7.5, 7.0, 8.0]
    folder = rec.make_record3d(
        tmp_path / "old", perFrameIntrinsicCoeffs=[own[0], None, [0.0] * 4], frameTimestamps=times
    )
    report, frames = imported(folder)
    assert sorted(frame.intrinsics.fy for frame in frames) == [50.0, 50.0, 51.0]
    assert "times of the pictures go back" in said(report)


def test_depth_of_instant_ngp_is_in_the_unit_of_the_poses(tmp_path: Path) -> None:
    folder = rec.add_depth(rec.make_transforms(tmp_path / "nerf"))
    change(folder, [{"depth_path": f"depths/{n}.png", "depth_file_path": None} for n in range(3)])
    with pytest.raises(ImportSourceError, match=r"depth_path needs integer_depth_scale.*--topic depth=none"):
        imported(folder)
    assert imported(folder, topics={"depth": "none"})[0].with_depth == 0
    change(folder, [{}] * 3, integer_depth_scale=1 / 500)
    report, frames = imported(folder, scale=2.0)
    depth = frames[0].depth_m
    assert report.info.scale_known and depth is not None and depth.max() == pytest.approx(1500 / 500 * 2, rel=1e-6)
    change(folder, [{}] * 3, applied_scale=0.5)
    depth = imported(folder)[1][0].depth_m
    assert depth is not None and depth.max() == pytest.approx(1500 / 500 * 2, rel=1e-6)


def test_the_largest_colmap_model_is_imported_and_the_rest_is_counted(tmp_path: Path) -> None:
    folder = rec.make_colmap(tmp_path / "scan", "txt")
    small = folder / "sparse" / "0"
    shutil.copytree(small, folder / "sparse" / "1")
    lines = (small / "images.txt").read_text().splitlines()
    (small / "images.txt").write_text("\n".join(lines[:3]) + "\n")
    (small / "points3D.txt").write_text("")  # whose tracks would name images that are gone
    shutil.copy(folder / "images" / "0.png", folder / "images" / "unposed.png")
    (folder / "images" / "0.png").unlink()
    report, frames = imported(folder)
    assert len(frames) == 2 and len(report.skipped) == 1
    assert "largest of 2 models is imported, 1 of 3 pictures; left out: 0 of 1" in said(report)
    assert "1 picture left out, without a pose" in said(report) and "unposed.png" in said(report)


def test_frames_are_sorted_by_their_times_and_one_time_is_parted(tmp_path: Path) -> None:
    report, frames = imported(rec.make_record3d(tmp_path / "phone", frameTimestamps=[5.0, 4.0, 4.0]))
    assert [frame.stamp_ns / 1e6 for frame in frames] == [0, 1, 1000] and "time of another one" in said(report)


@pytest.mark.parametrize(
    ("keys", "factor"),
    [
        ({"applied_scale": 0.5}, 2.0),
        ({"applied_transform": [[0, 2, 0, 0], [-2, 0, 0, 0], [0, 0, 2, 0]]}, 0.5),
        ({"unit": "metres", "applied_transform": np.eye(4)[:3].tolist()}, 1.0),
    ],
)
def test_positions_are_what_they_were_before_they_were_scaled(
    tmp_path: Path, keys: dict[str, Any], factor: float
) -> None:
    folder = rec.add_depth(rec.make_transforms(tmp_path / "nerf", **keys))
    report, frames = imported(folder)
    assert np.allclose(frames[2].T_world_camera[:3, 3], factor * poses()[2][:3, 3])
    assert ("positions are multiplied" in said(report)) == (factor != 1) and report.info.scale_known


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
    for other, count in (("EQUIRECTANGULAR", 2), ("DIVISION", 5), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)):
        with pytest.raises(ImportSourceError, match="image_undistorter"):
            intrinsics_of(other, 64, 48, [1.0] * count, "camera 1")
    found = intrinsics_of("BROWN_CONRADY", 64, 48, [50, 32, 24, 0.1, 0.2, 0.3, 0.01, 0.02], "camera 1")
    assert found.distortion[:5] == (0.1, 0.2, 0.01, 0.02, 0.3) and found.fy == 50  # COLMAP's: k1 k2 k3 p1 p2


@pytest.mark.parametrize(("times", "fps"), [([5.0, 5.5], 10), ([None, 5.0, 5.5], 10), ([5.0, "x", 6.0], None)])
def test_times_that_record3d_lacks_are_made_up_at_its_rate(tmp_path: Path, times: list[Any], fps: float | None) -> None:
    report, frames = imported(rec.make_record3d(tmp_path / "phone", frameTimestamps=times, fps=fps))
    assert [frame.stamp_ns for frame in frames] == [round(n * 1e9 / (fps or 60)) for n in range(3)]
    assert f"made up at {fps or 60} frames a second" in said(report)


def test_a_reconstruction_of_opensfm_is_imported_with_its_metres(tmp_path: Path) -> None:
    folder = rec.make_opensfm(tmp_path / "flight", flight())
    assert detect_format(folder) == "opensfm"
    report, frames = imported(folder)
    assert report.info.scale_known and report.info.metadata[ORIGIN_KEY].startswith("52.5")
    for frame, T in zip(frames, flight(), strict=True):  # 10 comes behind 9
        assert np.allclose(frame.T_world_camera, T, atol=1e-9)
    k = frames[0].intrinsics
    assert (k.fx, k.cx, k.cy) == (pytest.approx(F), (W - 1) / 2, (H - 1) / 2)
    with pytest.raises(ImportSourceError, match="in metres already"):
        imported(folder, scale=2.0)


def test_a_reconstruction_without_gps_is_made_of_room_size(tmp_path: Path) -> None:
    folder = rec.make_opensfm(tmp_path / "flight", flight())
    for reference in (None, {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}):
        (model,) = json.loads((folder / "reconstruction.json").read_text())
        (folder / "reconstruction.json").write_text(json.dumps([model | {"reference_lla": reference}]))
        report, frames = imported(folder)
        assert not report.info.scale_known
        ratio = np.linalg.norm(frames[6].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3]) / 40
        assert ratio == pytest.approx(2 / 36, rel=0.1)  # cameras are 36 m from the points
    assert imported(folder, scale=3.0)[0].info.scale_known


def test_a_lens_of_browns_model_is_undone(tmp_path: Path) -> None:
    """Where OpenSfM projects a point in the picture with distortion, a white dot is where the log's camera has it."""
    lens = {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003, "k3": 0.01}
    brown = {"projection_type": "brown", "focal_x": 0.7, "focal_y": 0.72, "c_x": 0.02, "c_y": -0.03}
    folder = rec.make_opensfm(tmp_path / "flight", flight(4), **brown, **lens)
    x, y = -0.3, 0.25  # on the plane at depth 1
    r2 = x * x + y * y
    radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
    u = 0.7 * (x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x * x)) + 0.02
    v = 0.72 * (y * radial + 2 * lens["p2"] * x * y + lens["p1"] * (r2 + 2 * y * y)) - 0.03
    pixel = np.array((u * W + W / 2 - 0.5, v * W + H / 2 - 0.5))
    rows, columns = np.mgrid[:H, :W]
    dot = 255 * np.exp(-((columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2) / 4)
    Image.fromarray(np.repeat(dot[..., None], 3, 2).astype(np.uint8)).save(folder / "images" / "DJI_0.JPG", quality=98)
    frame = imported(folder)[1][0]
    light = np.where(frame.rgb[..., 0] > 60, frame.rgb[..., 0], 0).astype(float)
    found = np.array(((light * columns).sum(), (light * rows).sum())) / light.sum()
    expected = (camera_matrix(frame.intrinsics) @ (x, y, 1))[:2]
    assert np.abs(found - expected).max() < 0.3 < np.abs(pixel - expected).max()
