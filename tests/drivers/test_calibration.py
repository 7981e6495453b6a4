"""Calibration files, and images without lens distortion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics, load_calibration
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import CameraIntrinsics

LENS = CameraIntrinsics(300.0, 305.0, 158.0, 122.0, 320, 240, (-0.28, 0.09, 0.001, -0.0005, 0.0))
TEXT = """
fx = 300
fy = 305
cx = 158
cy = 122
width = 320
height = 240
distortion = [-0.28, 0.09, 0.001, -0.0005, 0.0]
"""


def test_toml_and_json_hold_the_same(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(TEXT + '[about]\nrms_px = 0.3\ndate = "today"\n')
    (tmp_path / "a.json").write_text(
        '{"fx": 300, "fy": 305, "cx": 158, "cy": 122, "width": 320, "height": 240, '
        '"distortion": [-0.28, 0.09, 0.001, -0.0005, 0]}'
    )
    assert load_calibration(tmp_path / "a.toml") == load_calibration(tmp_path / "a.json") == LENS


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
        (("-0.28", "nan"), "distortion"),
        (("fx = 300", "fx = "), "not valid TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_told(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    path = tmp_path / "lens.toml"
    path.write_text(TEXT.replace(*change))
    with pytest.raises(ConfigError, match=says) as caught:
        load_calibration(path)
    assert "lens.toml" in str(caught.value)


def test_without_distortion_an_image_stays_as_it_is(rng: np.random.Generator) -> None:
    ideal = CameraIntrinsics(60.0, 60.0, 31.5, 23.5, 64, 48, (0.0, 0.0, 0.0, 0.0))
    bgr = rng.integers(0, 255, (48, 64, 3), np.uint8)
    rectify = Rectifier(ideal)
    np.testing.assert_array_equal(rectify(bgr), bgr[..., ::-1])
    assert (rectify.intrinsics.fx, rectify.intrinsics.cx) == (60.0, 31.5)


def test_a_guess_is_that_of_a_usual_webcam() -> None:
    guess = guess_intrinsics(640, 480)
    assert guess.fx == pytest.approx(554.3, abs=0.1) and (guess.cx, guess.cy) == (319.5, 239.5)
