"""What of the device's part can be had without a device: its names in DepthAI, and calibrations."""

from __future__ import annotations

import json
import subprocess
import sys
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

ROOT = Path(__file__).resolve().parents[3]

ERROR_IN_A_READER = """
import sys
from pathlib import Path
from tests.drivers.oak import host
camera = host.camera(lambda: host.played(Path(sys.argv[1]), [host.rgb_message(0, host.long_ago(1))], None))
with camera:
    for image in camera:
        raise RuntimeError("of the reader")
"""


def test_every_setting_has_its_name_in_depthai() -> None:
    for preset in get_args(Preset):
        assert getattr(dai.node.StereoDepth.PresetMode, preset.upper())
    for socket in get_args(Socket):
        assert getattr(dai.CameraBoardSocket, socket) is not None


def test_intrinsics_follow_the_size_and_extrinsics_are_metres(calibration: Path) -> None:
    handler = load_calibration(None, str(calibration))
    for height, cy in ((480, 235), (400, 195)):  # cropped
        k = read_intrinsics(handler, "CAM_A", 640, height)
        assert (k.fx, k.fy, k.cx, k.cy) == pytest.approx((500, 510, 325, cy))
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


def test_an_exception_of_the_reader_ends_the_process_cleanly(calibration: Path) -> None:
    command = [sys.executable, "-c", ERROR_IN_A_READER, str(calibration)]
    env = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1  # no signal: DepthAI's threads have ended
    assert done.stderr.rstrip().endswith("RuntimeError: of the reader")
