"""A known camera is found again from pictures of a board; what cannot be believed is refused."""

import dataclasses

import numpy as np
import pytest

from semantic_mapper.drivers.calibrating import camera
from semantic_mapper.drivers.calibrating.camera import calibrate_camera, compare_camera, ideal_pixels
from semantic_mapper.drivers.calibrating.views import BoardView, CalibrationConfig, ViewGatherer
from semantic_mapper.errors import CameraError
from semantic_mapper.types import CameraIntrinsics, Float64

from .boards import BOARD, LENS, image, made_up, shown, views

SIZE = (LENS.width, LENS.height)
CONFIG = CalibrationConfig()


@pytest.fixture(scope="module")
def gathered() -> ViewGatherer:
    gatherer = ViewGatherer(BOARD, CONFIG, stream=False)
    for seq, (_, picture) in enumerate(shown()):
        gatherer.take(picture, f"{seq}.png")
    return gatherer


def all_of(poses: list[Float64], noise_px: float = 0.1) -> list[BoardView]:
    rng = np.random.default_rng(0)
    found = [made_up(T, number, noise_px, rng) for number, T in enumerate(poses)]
    return [view for view in found if view is not None]


def rays(intrinsics: CameraIntrinsics) -> Float64:
    """Where pixels all over the image look, (N, 2) at depth 1."""
    u, v = np.meshgrid(np.linspace(20, 619, 9), np.linspace(20, 459, 7))
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    ideal = ideal_pixels(pixels, intrinsics)
    return (ideal - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)


def test_a_known_camera_is_found_from_pictures(gathered: ViewGatherer) -> None:
    assert gathered.seen == 20 and gathered.lacks() == []
    found = calibrate_camera("cam", gathered.kept, SIZE, CONFIG)
    assert found.rms_px < 0.15
    for name, truth in (("fx", LENS.fx), ("fy", LENS.fy)):
        value = getattr(found.intrinsics, name)
        assert abs(value / truth - 1) < 0.005
        assert abs(value - truth) < 5 * found.sigmas[name] and found.sigmas[name] / truth < 0.002
    # Focal length, centre and distortion may trade against each other; where pixels look is what counts.
    off_px = np.linalg.norm(rays(found.intrinsics) - rays(LENS), axis=1) * LENS.fx
    turned = off_px.mean()  # a shift of the centre is a small turn of the camera
    assert off_px.max() < 1.5 and turned < 0.8
    assert list(found.sigmas) == ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
    assert len(found.errors_px) == len(found.views) == len(found.tilts)


@pytest.mark.parametrize("coefficients", [4, 5, 8])
def test_as_many_coefficients_as_requested(coefficients: int) -> None:
    config = CalibrationConfig(coefficients=coefficients)  # type: ignore[arg-type]
    found = calibrate_camera("cam", all_of(views(20), 0.02), SIZE, config)
    assert len(found.intrinsics.distortion) == coefficients
    assert np.abs(rays(found.intrinsics) - rays(LENS)).max() * LENS.fx < (1.0 if coefficients == 8 else 0.6)


def test_a_blurred_view_is_left_out_and_named() -> None:
    good = all_of(views(20))
    rng = np.random.default_rng(5)
    bad = dataclasses.replace(
        good[3], name="blurred.png", pixels=good[3].pixels + rng.normal(0, 3, (len(good[3].pixels), 2))
    )
    found = calibrate_camera("cam", [*good[:3], bad, *good[4:]], SIZE, CONFIG)
    assert found.left_out == ("blurred.png",) and found.rms_px < 0.2


def test_what_cannot_be_believed_is_refused_with_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    good = all_of(views(20))
    left = [v for v in all_of(views(24)) if v.pixels[:, 0].max() < 420]
    bent = [dataclasses.replace(v, pixels=v.pixels + 4 * np.sin(v.points[:, :1] * 60)) for v in good]
    few = CalibrationConfig(min_views=4)
    for seen, config, says in (
        (all_of(views(20, aside=0.0)), CONFIG, "camera 'front'.*not seen in these parts of the image: top left, "),
        (left, few, "parts of the image: top right, right, bottom right;"),
        (all_of(views(20, tilted=False), 0.02), CONFIG, "never leaned up or down by 15 degrees"),
        (good[:5], CONFIG, "5 views that differ from each other, 10 are needed"),
        (bent, CONFIG, r"corners are off by \d.*check the sizes"),
    ):
        with pytest.raises(CameraError, match=says):
            calibrate_camera("front", seen, SIZE, config)
    monkeypatch.setattr(camera, "MAX_FOCAL_SIGMA", 1e-4)
    with pytest.raises(CameraError, match=r"known to \d.\d\d % only"):
        calibrate_camera("cam", all_of(views(20), 0.5), SIZE, CONFIG)


def test_a_camera_that_is_calibrated_is_compared_only() -> None:
    found = compare_camera("cam", all_of(views(12), 0.2), LENS, CONFIG)
    assert found.intrinsics is LENS and found.sigmas == {}
    assert found.rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.15)
    wrong = dataclasses.replace(LENS, distortion=())
    with pytest.raises(CameraError, match="corners are off by"):
        compare_camera("cam", all_of(views(12)), wrong, CONFIG)


def test_streams_give_a_view_only_where_the_board_is_held_still() -> None:
    first, second = views(2)
    moving = first.copy()
    moving[0, 3] += 0.02
    gatherer = ViewGatherer(BOARD, CONFIG, stream=True)
    shown = (first, moving, moving, moving, second, second)
    assert [gatherer.take(image(seq, T)) for seq, T in enumerate(shown)] == [False, False, True, False, False, True]
    assert gatherer.seen == 6 and len(gatherer.steady) == 3 and len(gatherer.kept) == 2


def test_images_without_a_board_and_of_another_size_are_told() -> None:
    gatherer = ViewGatherer(BOARD, CONFIG, stream=False)
    assert gatherer.lacks() == ["no image has come yet"]
    blank = dataclasses.replace(shown()[0][1], rgb=np.full((480, 640, 3), 90, np.uint8))
    assert not gatherer.take(blank) and gatherer.seen == 0
    assert len(gatherer.lacks()) == 4 and "0 views" in gatherer.lacks()[0]
    small = CameraIntrinsics(100.0, 100.0, 79.5, 59.5, 160, 120)
    with pytest.raises(CameraError, match="160x120 among those of"):
        gatherer.take(dataclasses.replace(blank, rgb=np.zeros((120, 160, 3), np.uint8), intrinsics=small))
