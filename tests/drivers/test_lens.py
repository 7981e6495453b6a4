"""Lenses by their names and values; a fisheye's image becomes a pinhole camera's; calibrations of ROS and Kalibr."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibration import Rectifier, load_calibration, save_calibration
from semantic_mapper.drivers.lens import lens_intrinsics
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import camera_matrix, project, scale_intrinsics
from semantic_mapper.types import CameraIntrinsics, FisheyeIntrinsics
from tests.small import tiny_frames

K, SIZE = (150.0, 152.0, 158.0, 121.0), (320, 240)
BENT = CameraIntrinsics(300.0, 305.0, 158.0, 122.0, *SIZE, (-0.28, 0.09, 0.001, -0.0005, 0.0))
FISHEYE = FisheyeIntrinsics(*K, *SIZE, (0.06, -0.02, 0.008, -0.002))


@pytest.mark.parametrize(
    ("model", "given", "lens"),
    [
        ("plumb_bob", (0.0,) * 8, ()),
        ("plumb_bob", (-0.05, 0.02, 0.001, -0.001, 0, 0, 0, 0), (-0.05, 0.02, 0.001, -0.001)),
        ("plumb_bob", (0.1,), (0.1, 0.0, 0.0, 0.0)),
        ("radtan", (0.1, 0.2, 0, 0, 0.3), (0.1, 0.2, 0.0, 0.0, 0.3)),
        ("rational_polynomial", (*(0.1,) * 8, 0, 0, 0, 0, 0, 0), (0.1,) * 8),
        ("rational_polynomial", (*(0.1,) * 9, 0, 0, 0), (*(0.1,) * 9, 0.0, 0.0, 0.0)),
        ("Brown-Conrady", (0.0,) * 5, ()),
    ],
)
def test_a_lens_is_judged_by_its_values(model: str, given: tuple[float, ...], lens: tuple[float, ...]) -> None:
    assert lens_intrinsics(model, given, K, SIZE) == CameraIntrinsics(*K, *SIZE, lens)


def test_a_fisheye_without_coefficients_is_one_all_the_same() -> None:
    lens = lens_intrinsics("equidistant", (), K, SIZE)
    assert isinstance(lens, FisheyeIntrinsics) and lens.distorted and lens.distortion == (0.0,) * 4
    assert isinstance(scale_intrinsics(lens, 160, 120), FisheyeIntrinsics)


@pytest.mark.parametrize(
    ("model", "given", "says"),
    [
        ("inverse_brown_conrady", (0.1,), "'inverse_brown_conrady' is not undone"),
        ("omni", (), "'omni' is not undone"),
        ("", (0.1,), "no model"),
        ("equidistant", (0.1,) * 5, "with 5 coefficients"),
    ],
)
def test_other_lenses_are_refused_by_name(model: str, given: tuple[float, ...], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        lens_intrinsics(model, given, K, SIZE)


def test_points_lie_where_the_rectified_camera_projects_them() -> None:
    """Each is drawn as a spot where the lens shows it, found in the rectified image, and compared."""
    points = np.array([(x, y, 2.0) for x in (-0.9, 0.1, 0.85) for y in (-0.65, 0.2, 0.6)])
    eye = np.zeros(3)
    plain, fisheye = (camera_matrix(lens) for lens in (BENT, FISHEYE))
    seen_plain, _ = cv2.projectPoints(points, eye, eye, plain, np.array(BENT.distortion))
    seen_fisheye, _ = cv2.fisheye.projectPoints(points[:, None], eye, eye, fisheye, np.array(FISHEYE.distortion))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    for lens, seen in ((BENT, seen_plain), (FISHEYE, seen_fisheye)):
        rectify = Rectifier(lens)
        assert rectify.intrinsics.distortion == ()
        for pixel, point in zip(np.asarray(seen).reshape(-1, 2), points, strict=True):
            spot = 255 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 18)
            light = rectify(np.repeat(spot[..., None], 3, axis=2).astype(np.uint8))[..., 0].astype(np.float64)
            found = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
            assert np.abs(found - project(point[None], rectify.intrinsics)[0]).max() < 0.3
        inside = [rectify.nearest(np.ones(SIZE[::-1], np.float32))[y, x] for y in (0, -1) for x in (0, -1)]
        assert inside == [1.0] * 4  # no pixel is made up


def test_a_frame_with_a_fisheye_is_refused() -> None:
    frame = tiny_frames(1)[0]
    k = frame.intrinsics
    lens = FisheyeIntrinsics(k.fx, k.fy, k.cx, k.cy, k.width, k.height, (0.0,) * 4)
    with pytest.raises(FrameError, match="fisheye lens has to be rectified"):
        replace(frame, intrinsics=lens)


ROS = """image_width: 320
image_height: 240
camera_name: front
camera_matrix: {{rows: 3, cols: 3, data: [150, 0, 158, 0, 152, 121, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {count}, data: {lens}}}
"""
ECHOED = "height: 240\nwidth: 320\ndistortion_model: plumb_bob\nd: [0.1, 0, 0, 0, 0]\n" + (
    "k: [150, 0, 158, 0, 152, 121, 0, 0, 1]\n"
)
KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [150.0, 152.0, 158.0, 121.0]
  distortion_model: equidistant
  distortion_coeffs: [0.06, -0.02, 0.008, -0.002]
  resolution: [320, 240]
  rostopic: /cam0/image_raw
"""


@pytest.mark.parametrize(
    ("text", "lens"),
    [
        (ROS.format(model="plumb_bob", count=5, lens="[0.1, 0, 0, 0, 0]"), CameraIntrinsics(*K, *SIZE, (0.1, 0, 0, 0))),
        (ROS.format(model="equidistant", count=4, lens="[0.06, -0.02, 0.008, -0.002]"), FISHEYE),
        (ECHOED, CameraIntrinsics(*K, *SIZE, (0.1, 0, 0, 0))),
        (ECHOED.replace("d: [", "D: [").replace("k: [", "K: ["), CameraIntrinsics(*K, *SIZE, (0.1, 0, 0, 0))),
        (ECHOED + "---\n", CameraIntrinsics(*K, *SIZE, (0.1, 0, 0, 0))),
        (KALIBR, FISHEYE),
    ],
)
def test_calibrations_of_ros_and_kalibr_are_read(tmp_path: Path, text: str, lens: CameraIntrinsics) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    assert load_calibration(tmp_path / "camera.yaml") == lens


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (KALIBR + KALIBR.replace("cam0", "cam1"), "cameras cam0, cam1"),
        (KALIBR.replace("model: pinhole", "model: omni"), "camera_model 'omni'"),
        (KALIBR.replace("resolution", "size"), "resolution.*fx fy cx cy"),
        (KALIBR.replace("intrinsics: [", "intrinsics: {"), "while parsing.*fx fy cx cy"),
        ("a: &a [1]\nb: *a\n", "aliases"),
        ("- 1\n", "no calibration"),
        (ECHOED + "binning_x: 2\n", "binning"),
        (ECHOED + "---\n" + ECHOED.replace("150", "151"), "several calibrations"),
    ],
)
def test_what_is_wrong_with_a_yaml_calibration_is_told(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        load_calibration(tmp_path / "camera.yaml")


def test_a_fisheye_calibration_is_written_and_read_back(tmp_path: Path) -> None:
    save_calibration(tmp_path / "camera.toml", FISHEYE, None, {})
    assert load_calibration(tmp_path / "camera.toml") == FISHEYE


def test_a_calibration_of_opencv_is_read(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("camera_matrix", np.array([[50.0, 0, 31], [0, 51, 23], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[0.1, 0.01, 0, 0, 0]]))
    storage.release()
    k = load_calibration(tmp_path / "camera.yml")
    assert (k.fx, k.fy, k.cx, k.cy, k.width, k.height) == (50, 51, 31, 23, 64, 48)
    assert k.distortion == (0.1, 0.01, 0.0, 0.0)
