"""What of the device's part can be had without a device: its names in DepthAI, and calibrations."""

import json
from pathlib import Path
from typing import get_args

import depthai as dai
import numpy as np
import pytest

from semantic_mapper.drivers.oak.camera import read_intrinsics
from semantic_mapper.drivers.oak.config import Config, Preset, Socket
from semantic_mapper.drivers.oak.device import load_calibration, rgb_to_left
from semantic_mapper.errors import CameraError
from tests.drivers.oak.host import RGB_IN_LEFT_CM


def test_every_setting_has_its_name_in_depthai() -> None:
    for preset in get_args(Preset):
        assert getattr(dai.node.StereoDepth.PresetMode, preset.upper())
    for socket in get_args(Socket):
        assert getattr(dai.CameraBoardSocket, socket) is not None


def test_intrinsics_follow_the_size_and_extrinsics_are_metres(calibration: Path) -> None:
    handler = load_calibration(None, str(calibration))
    # Of 1280x960: as it is, cut above and below, and cut at the sides.
    for size, expected in (
        ((640, 480), (500, 510, 325, 235)),
        ((640, 400), (500, 510, 325, 195)),
        ((600, 600), (625, 637.5, 306.25, 293.75)),
    ):
        k = read_intrinsics(handler, "CAM_A", *size)
        assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx(expected)
    np.testing.assert_allclose(rgb_to_left(handler, Config())[:3, 3], np.array(RGB_IN_LEFT_CM) / 100, atol=1e-6)
    np.testing.assert_allclose(rgb_to_left(handler, Config(rgb="CAM_B")), np.eye(4))
    with pytest.raises((RuntimeError, IndexError)):
        read_intrinsics(handler, "CAM_D", 640, 480)
    with pytest.raises(RuntimeError):
        rgb_to_left(handler, Config(left="CAM_D"))


@pytest.mark.parametrize("text", [None, "no JSON", json.dumps({"cameraData": 3})])
def test_a_file_that_is_no_calibration_is_an_error(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "calibration.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(CameraError, match=r"calibration\.json: .*; give a calibration as DepthAI writes it"):
        load_calibration(None, str(path))
