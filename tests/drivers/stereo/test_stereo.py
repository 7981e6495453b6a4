"""Stereo pairs: rendered rooms through a real video file, and a webcam that goes away."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from research.scenes import TEST_SEEDS, camera_path, make_room, render_view
from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibration import StereoCalibration, load_stereo, save_calibration
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.drivers.stereo.depth import StereoDepth
from semantic_mapper.errors import CameraError, ConfigError
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8
from tests.drivers.fake_v4l2 import Machine, Sensor, make_machine
from tests.drivers.support import PATIENCE_S, write_calibration, write_film

COUNT = 3
LEFT = CameraIntrinsics(330.0, 330.0, 239.5, 179.5, 480, 360)
RIGHT = CameraIntrinsics(334.0, 334.0, 242.0, 177.0, 480, 360)
BASELINE_M = 0.12


def T_left_right() -> Float64:  # noqa: N802 - a transform
    """The right camera stands 12 cm aside, a little lower, and is turned by a degree, as cheap pairs are."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians((0.6, -1.0, 0.4)))[0]
    T[:3, 3] = (BASELINE_M, 0.002, -0.001)
    return T


def the_pair() -> StereoCalibration:
    return StereoCalibration(LEFT, RIGHT, np.linalg.inv(T_left_right()))


def write_pair(folder: Path, pair: StereoCalibration | None = None, *, swapped: bool = False) -> str:
    pair = pair or the_pair()
    cameras = [(pair.left, np.eye(4)), (pair.right, np.linalg.inv(pair.T_right_left))]
    for name, (lens, mount) in zip(("left", "right"), cameras[::-1] if swapped else cameras, strict=True):
        save_calibration(folder / f"{name}.toml", lens, mount, {"made_by": "a test"})
    return str(folder)


def room_pairs(scene: object, poses: Sequence[Float64]) -> list[UInt8]:
    """(H, 2 W, 3) RGB of each pose of the left camera; a little noise, as sensors have."""
    rng = np.random.default_rng(5)
    found: list[UInt8] = []
    for T in poses:
        left = render_view(scene, LEFT, T).rgb  # type: ignore[arg-type]
        right = render_view(scene, RIGHT, T @ T_left_right()).rgb  # type: ignore[arg-type]
        both = np.hstack((left, right)).astype(np.float32)
        found.append(np.clip(both + rng.normal(0, 1.5, both.shape), 0, 255).astype(np.uint8))
    return found


@dataclasses.dataclass(frozen=True)
class Film:
    path: Path
    scene: Any
    poses: list[Float64]


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Film:
    scene = make_room(TEST_SEEDS[0])
    poses = list(camera_path(scene, COUNT, TEST_SEEDS[0]))
    path = write_film(tmp_path_factory.mktemp("film") / "pair.avi", room_pairs(scene, poses))
    return Film(path, scene, poses)


def stereo(film: Path, file: str, **settings: Any) -> Camera:
    config = {"device": str(film), "calibration": file, "width": 480} | settings
    return open_camera("stereo", config, "front", "test")


def images_of(film: Film, calibration: str, **settings: Any) -> list[CameraImage]:
    with stereo(film.path, calibration, source={"pace": "fast"}, **settings) as camera:
        assert camera.warnings == () and camera.can_wait
        images = list(camera)
        assert camera.info.cameras == {"front": images[0].intrinsics}
        assert camera.info.metadata["baseline_m"] == "0.1200" and camera.info.source == "stereo video pair.avi"
    return images


def test_the_depth_of_a_room_is_that_of_the_rectified_left_camera(film: Film, tmp_path: Path) -> None:
    """The errors that a third of a pixel makes: the room is 2 m away in the median, a pixel is 2.4 cm there."""
    images = images_of(film, write_pair(tmp_path / "pair"))
    rectified = StereoDepth(the_pair(), 480, 0.4, 8.0)
    assert len(images) == COUNT and [image.seq for image in images] == list(range(COUNT))
    for image, T_world_left in zip(images, film.poses, strict=True):
        truth = render_view(film.scene, image.intrinsics, T_world_left @ rectified.T_left_rectified)
        assert image.depth_m is not None and image.depth_m.shape == image.rgb.shape[:2] == (360, 480)
        assert np.abs(image.rgb.astype(int) - truth.rgb).mean() < 3
        seen = (image.depth_m > 0) & (truth.exact_depth_m > 0)
        error = image.depth_m[seen] / truth.exact_depth_m[seen] - 1
        assert seen.mean() > 0.85
        assert float(np.median(np.abs(error))) < 0.03 and abs(float(np.median(error))) < 0.005
        assert float((np.abs(error) > 0.1).mean()) < 0.08


def test_what_the_right_camera_does_not_see_has_no_depth() -> None:
    """A near board before a far wall hides a strip of it from the right camera, on the board's left."""
    pair = the_pair()
    matcher = StereoDepth(dataclasses.replace(pair, right=pair.left, T_right_left=shift(-0.1)), 480, 0.4, 8.0)
    focal = matcher.intrinsics.fx
    rng = np.random.default_rng(1)
    wall, board = (rng.integers(0, 255, (360, 900), np.uint8) for _ in range(2))
    far, near = 16, 80  # disparities of wall and board
    left, right = wall[:, 100:580].copy(), wall[:, 100 + far : 580 + far].copy()
    left[100:260, 240:360] = board[100:260, :120]
    right[100:260, 240 - near : 360 - near] = board[100:260, :120]
    depth = matcher.depth(*(np.repeat(image[..., None], 3, axis=2) for image in (left, right)))
    inner = slice(110, 250)
    assert np.allclose(depth[inner, 250:350], focal * 0.1 / near, rtol=0.01)
    assert np.median(depth[inner, 100:160]) == pytest.approx(focal * 0.1 / far, rel=0.01)
    hidden = depth[inner, 240 - (near - far) + 6 : 240 - 6]
    assert (hidden == 0).mean() > 0.8
    assert (depth[inner, :far] == 0).all()  # left of the right camera's image


def test_rectified_images_of_wide_lenses_show_nothing_from_beside_them() -> None:
    wide = dataclasses.replace(LEFT, fx=200.0, fy=200.0, distortion=(-0.28, 0.09, 0.001, -0.0005, 0.0))
    white = np.full((360, 480, 3), 255, np.uint8)
    rectified = StereoDepth(StereoCalibration(wide, wide, np.linalg.inv(T_left_right())), 480, 0.4, 8.0)
    assert min(image.min() for image in rectified.rectify(white, white)) > 250


def shift(x: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_the_files_of_a_pair_read_back_to_the_same_numbers_and_swapped_halves_are_put_right(
    film: Film, tmp_path: Path
) -> None:
    lens = dataclasses.replace(LEFT, distortion=(-0.1, 0.02, 1e-4, -2e-4, 0.003))
    pair = dataclasses.replace(the_pair(), left=lens)
    read = load_stereo(Path(write_pair(tmp_path / "pair", pair, swapped=True)))
    assert (read.left, read.right, read.swapped) == (pair.left, pair.right, True)
    np.testing.assert_allclose(read.T_right_left, pair.T_right_left, atol=1e-12)
    both = room_pairs(film.scene, film.poses[:1])
    other = write_film(tmp_path / "pair.avi", [np.hstack(np.hsplit(image, 2)[::-1]) for image in both])
    (swapped,) = images_of(dataclasses.replace(film, path=other), write_pair(tmp_path / "p", swapped=True))
    plain = images_of(film, write_pair(tmp_path / "q"))[0]
    assert np.abs(swapped.rgb.astype(int) - plain.rgb).mean() < 2
    assert swapped.depth_m is not None and (swapped.depth_m > 0).mean() > 0.85


@pytest.mark.parametrize(
    ("settings", "error", "complaint"),
    [
        ({"device": ""}, CameraError, "no device is named; `doctor --cameras`"),
        ({"calibration": ""}, CameraError, "has no calibration; make one with `semantic-mapper calibrate --stereo`"),
        ({"calibration": "none"}, ConfigError, "none/left.toml: .*calibrate --stereo` makes the folder of a pair"),
        ({"calibration": "alone"}, ConfigError, "alone: T_rig_camera is missing; .*calibrate --stereo"),
        ({"min_depth_m": 0.05}, ConfigError, r"min_depth_m = 0.05 is too near for this pair: .* 0\.\d\d m is possible"),
        ({"min_depth_m": 9.0}, ConfigError, "must be below max_depth_m = 8"),
        ({"source": {"calibration": "x"}}, CameraError, "`calibration` cannot be a key of `source`"),
        ({"source": {"paze": "fast"}}, ConfigError, "did you mean `pace`"),
    ],
)
def test_what_cannot_work_is_refused_before_the_device_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], error: type[Exception], complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "alone").mkdir()
    for side in ("left", "right"):
        write_calibration(tmp_path / "alone" / f"{side}.toml")
    with pytest.raises(error, match=complaint):
        stereo(Path("film.avi"), write_pair(tmp_path / "pair"), **settings)


def test_a_pair_that_is_not_side_by_side_and_a_film_of_another_size_are_refused(film: Film, tmp_path: Path) -> None:
    above = np.eye(4)
    above[:2, 3] = -0.05, 0.1
    with pytest.raises(ConfigError, match="the right camera is not next to the left one"):
        stereo(film.path, write_pair(tmp_path / "above", dataclasses.replace(the_pair(), T_right_left=above)))
    small = write_film(tmp_path / "small.avi", [np.zeros((180, 480, 3), np.uint8)])
    camera = stereo(small, write_pair(tmp_path / "pair"))
    with pytest.raises(CameraError, match="gives images of 480x180, and the pair was calibrated at 960x360"), camera:
        pass


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return make_machine(tmp_path, monkeypatch)


def test_a_pair_of_a_webcam_is_read_without_its_rectification(machine: Machine, tmp_path: Path) -> None:
    device = machine.plug(Sensor(card="Stereo", sizes=((960, 360), (64, 48))), 0)
    with stereo(device, write_pair(tmp_path / "pair"), source={"stall_s": PATIENCE_S}) as camera:
        image = next(iter(camera))
        assert image.rgb.shape == (360, 480, 3) and image.depth_m is not None and not image.depth_m.any()
        assert camera.warnings == () and not camera.can_wait
