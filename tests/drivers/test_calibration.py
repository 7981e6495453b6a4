"""Calibration files of ours, ROS, Kalibr and OpenCV; lenses by their names; images without lens distortion."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibrating.camera import ideal_pixels
from semantic_mapper.drivers.calibration import (
    Rectifier,
    guess_intrinsics,
    load_calibration,
    load_mount,
    save_calibration,
)
from semantic_mapper.drivers.lens import lens_intrinsics, undistort
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import camera_matrix, project, scale_intrinsics
from semantic_mapper.types import CameraIntrinsics, FisheyeIntrinsics
from tests.drivers.poses.images import rigid
from tests.small import tiny_frames

K, SIZE = (150.0, 152.0, 158.0, 121.0), (320, 240)
BENT = CameraIntrinsics(300.0, 305.0, 158.0, 122.0, *SIZE, (-0.28, 0.09, 0.001, -0.0005, 0.0))
FISHEYE = FisheyeIntrinsics(*K, *SIZE, (0.06, -0.02, 0.008, -0.002))
TEXT = """
fx = 300
fy = 305
cx = 158
cy = 122
width = 320
height = 240
distortion = [-0.28, 0.09, 0.001, -0.0005, 0.0]
"""


def test_toml_and_json_hold_the_same_and_what_is_written_reads_back_to_the_bit(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(TEXT + '[about]\nrms_px = 0.3\ndate = "today"\n')
    (tmp_path / "a.json").write_text(
        '{"fx": 300, "fy": 305, "cx": 158, "cy": 122, "width": 320, "height": 240, '
        '"distortion": [-0.28, 0.09, 0.001, -0.0005, 0]}'
    )
    assert load_calibration(tmp_path / "a.toml") == load_calibration(tmp_path / "a.json") == BENT
    path, T = tmp_path / "made" / "left.toml", rigid((0.02, -0.4, 0.1), (0.12, -0.03, 0.05))
    for lens in (replace(BENT, fx=321.123456789012, distortion=(-0.21, 0.06, 1e-17, -0.0006, 0.0)), FISHEYE):
        save_calibration(path, lens, T, {"board": 'the "big" one', "rms_px": 0.1})
        assert load_calibration(path) == lens
        np.testing.assert_array_equal(load_mount(path), T)
    save_calibration(path, BENT, None, {})
    assert load_mount(path) is None and not list(path.parent.glob("*.part"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("fx = 300", "fx = -300"), "fx"),
        (("fx = 300", "focal = 300"), "focal"),
        (("width = 320", ""), "width"),
        (("cx = 158", "cx = 400"), "outside of the 320x240"),
        (("cx = 158", "cx = nan"), "cx = nan"),
        (("fx = 300", "fx = 1e-3"), "do not fit a 320x240"),
        (("-0.28", "1e12"), "distortion"),
        (("-0.0005, 0.0]", "-0.0005, 0.0" + 10 * ", 1.0" + "]"), "15 coefficients"),
        (("fx = 300", "fx = "), "not valid TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    path = tmp_path / "lens.toml"
    path.write_text(TEXT.replace(*change))
    with pytest.raises(ConfigError, match=rf"lens\.toml.*{says}"):
        load_calibration(path)


def test_without_distortion_an_image_stays_as_it_is(rng: np.random.Generator) -> None:
    guess = guess_intrinsics(640, 480)
    assert guess.fx == pytest.approx(554.3, abs=0.1) and (guess.cx, guess.cy) == (319.5, 239.5)
    bgr = rng.integers(0, 255, (480, 640, 3), np.uint8)
    rectify = Rectifier(replace(guess, distortion=(0.0, 0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(rectify(bgr), bgr[..., ::-1])
    assert rectify.intrinsics.fx == guess.fx


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


def test_other_lenses_are_refused_and_a_fisheye_without_coefficients_is_one_all_the_same() -> None:
    for model, given, says in (
        ("inverse_brown_conrady", (0.1,), "'inverse_brown_conrady' is not undone"),
        ("omni", (), "'omni' is not undone"),
        ("", (0.1,), "no model"),
        ("equidistant", (0.1,) * 5, "with 5 coefficients"),
    ):
        with pytest.raises(ConfigError, match=says):
            lens_intrinsics(model, given, K, SIZE)
    lens = lens_intrinsics("equidistant", (), K, SIZE)
    assert isinstance(lens, FisheyeIntrinsics) and lens.distorted and lens.distortion == (0.0,) * 4
    assert isinstance(scale_intrinsics(lens, 160, 120), FisheyeIntrinsics)
    frame = tiny_frames(1)[0]
    k = frame.intrinsics
    with pytest.raises(FrameError, match="fisheye lens has to be rectified"):
        replace(frame, intrinsics=FisheyeIntrinsics(k.fx, k.fy, k.cx, k.cy, k.width, k.height, (0.0,) * 4))


@pytest.mark.parametrize(
    "lens",
    [
        CameraIntrinsics(800.0, 800.0, 639.5, 479.5, 1280, 960),
        CameraIntrinsics(800.0, 800.0, 639.5, 479.5, 1280, 960, (-0.3, 0.1, 0.0, 0.0, -0.015)),
        CameraIntrinsics(800.0, 800.0, 639.5, 479.5, 1280, 960, (-0.45, 0.1, 0.0, 0.0, 0.0)),
        FisheyeIntrinsics(545.0, 545.0, 639.5, 479.5, 1280, 960, (0.02, 0.01, -0.002, 0.0003)),
    ],
)
def test_a_lens_is_inverted_to_its_corners(lens: CameraIntrinsics) -> None:
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, 9), np.linspace(0, lens.height - 1, 7))
    slopes = undistort(np.stack((u.ravel(), v.ravel()), axis=1), lens)
    # Written out: OpenCV's documentation of both models.
    r = np.linalg.norm(slopes, axis=1)
    if isinstance(lens, FisheyeIntrinsics):
        theta = np.arctan(r)
        bent = theta * (1 + sum(k * theta ** (2 * n) for n, k in enumerate(lens.distortion, 1))) / np.maximum(r, 1e-9)
    else:
        k1, k2, _, _, k3 = lens.distortion or (0.0,) * 5
        bent = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    seen = slopes * bent[:, None] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    np.testing.assert_allclose(seen, np.stack((u.ravel(), v.ravel()), axis=1), atol=1e-6)
    assert undistort(np.zeros((0, 2)), lens).shape == (0, 2)


def test_a_pixel_that_a_lens_gives_to_no_ray_has_none() -> None:
    folded = CameraIntrinsics(800.0, 800.0, 639.5, 479.5, 1280, 960, (-0.6, 0.0, 0.0, 0.0))
    slopes = undistort(np.array([(0.0, 0.0), (700.0, 500.0)]), folded)
    assert np.isnan(slopes[0]).all() and np.abs(slopes[1]).max() < 0.1
    fisheye = FisheyeIntrinsics(207.0, 207.0, 319.5, 239.5, 640, 480, (-0.0093, 0.0058, -0.0544, -0.0345))
    assert np.isnan(undistort(np.array([(0.0, 207.6)]), fisheye)).all()  # or it is on the other side of the picture
    with pytest.raises(FrameError, match="gives pixel 0, 0 to no ray; calibrate again"):
        ideal_pixels(np.zeros((1, 2)), folded)


@pytest.mark.parametrize("focal", [300.0, 500.0, 800.0])
@pytest.mark.parametrize(
    "distortion", [BENT.distortion, (-0.2, 0.05, 0.001, 0.001), (0.5, 0.0, 0.0, 0.0), (-0.3, 0.0, 0.0, 0.0)]
)
def test_rectified_images_show_nothing_from_beside_the_image(focal: float, distortion: tuple[float, ...]) -> None:
    """The last lens folds before its corners; OpenCV's own view of the first two has up to 9 % black pixels."""
    lens = CameraIntrinsics(focal, focal, 639.5, 479.5, 1280, 960, distortion)
    rectify, white = Rectifier(lens), np.full((960, 1280, 3), 255, np.uint8)
    assert rectify(white).min() > 250
    folds = bool(np.isnan(undistort(np.zeros((1, 2)), lens)).any())
    assert folds == (distortion[0] == -0.3)
    if folds:  # square pixels, out to where it folds
        reach = np.hypot(639.5 / rectify.intrinsics.fx, 479.5 / rectify.intrinsics.fy)
        assert rectify.intrinsics.fx == pytest.approx(rectify.intrinsics.fy) and reach > 0.95 / np.sqrt(3 * 0.3)
    if not folds:  # and no more is cut off than has to be
        x, y = np.meshgrid(*(np.linspace(0, size - 1, 65) for size in (1280, 960)))
        rays = (np.stack((x, y), -1).reshape(-1, 2) - camera_matrix(rectify.intrinsics)[:2, 2]) / (
            rectify.intrinsics.fx,
            rectify.intrinsics.fy,
        )
        eye = np.zeros(3)
        seen, _ = cv2.projectPoints(
            np.pad(rays, ((0, 0), (0, 1)), constant_values=1), eye, eye, camera_matrix(lens), np.array(distortion)
        )
        found = np.reshape(seen, (-1, 2))
        np.testing.assert_allclose((*found.min(axis=0), *found.max(axis=0)), (0, 0, 1279, 959), atol=0.5)


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
        assert rectify.nearest(np.ones(SIZE[::-1], np.float32)).all()  # no pixel is made up


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


def test_calibrations_of_ros_kalibr_and_opencv_are_read(tmp_path: Path) -> None:
    path, bent = tmp_path / "camera.yaml", CameraIntrinsics(*K, *SIZE, (0.1, 0, 0, 0))
    for text, lens in (
        (ROS.format(model="plumb_bob", count=5, lens="[0.1, 0, 0, 0, 0]"), bent),
        (ROS.format(model="equidistant", count=4, lens="[0.06, -0.02, 0.008, -0.002]"), FISHEYE),
        (ECHOED, bent),
        (ECHOED.replace("d: [", "D: [").replace("k: [", "K: ["), bent),
        (ECHOED + "---\n", bent),
        (KALIBR, FISHEYE),
    ):
        path.write_text(text)
        assert load_calibration(path) == lens
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("camera_matrix", camera_matrix(bent))
    storage.write("distortion_coefficients", np.array([[0.1, 0, 0, 0, 0]]))
    storage.release()
    assert load_calibration(path) == bent


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
