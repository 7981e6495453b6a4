import dataclasses

import numpy as np
import pytest

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(fx=50, fy=50, cx=3.5, cy=2.5, width=8, height=6)


def frame(**changed: object) -> PosedFrame:
    parts: dict[str, object] = {
        "stamp_ns": 1,
        "seq": 7,
        "camera_id": "front",
        "rgb": np.zeros((6, 8, 3), np.uint8),
        "depth_m": np.ones((6, 8), np.float32),
        "label": np.ones((6, 8), np.uint8),
        "intrinsics": CAMERA,
        "T_world_camera": np.eye(4),
    }
    return PosedFrame(**(parts | changed))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("rgb", np.zeros((8, 6, 3), np.uint8)),  # width and height swapped
        ("rgb", np.zeros((6, 8), np.uint8)),
        ("rgb", np.zeros((6, 8, 3), np.float32)),
        ("depth_m", np.ones((6, 8), np.uint16)),  # millimetres as the sensor gives them
        ("depth_m", np.ones((6, 8), np.float64)),
        ("depth_m", np.ones((3, 4), np.float32)),
        ("depth_sigma_m", np.ones((3, 4), np.float32)),
        ("label", np.ones((6, 8), np.int64)),
        ("label", np.ones((6, 9), np.uint8)),
        ("T_world_camera", np.eye(4, dtype=np.float32)),
        ("T_world_camera", np.eye(3)),
    ],
)
def test_a_part_of_another_shape_or_dtype_is_refused_by_name(part: str, value: np.ndarray) -> None:
    with pytest.raises(FrameError) as caught:
        frame(**{part: value})
    message = str(caught.value)
    assert "seq=7" in message and "'front'" in message and part in message
    assert str(value.shape) in message and value.dtype.name in message


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
def test_intrinsics_that_are_not_finite_are_refused(name: str, bad: float) -> None:
    with pytest.raises(FrameError, match="finite"):
        dataclasses.replace(CAMERA, **{name: bad})


VGA = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)


@pytest.mark.parametrize(
    "change",
    [
        {"cy": 1e19},
        {"cx": 1e5},
        {"cx": -700.0},
        {"cx": 1300.0},
        {"fx": 0.01, "fy": 0.01},
        {"fx": 1e-320},
        {"fx": 60.0},  # wider than a pinhole image can be
        {"fy": 1e6},
        {"width": 1 << 15, "height": 1},
        {"width": 1 << 14, "height": 1 << 14, "fx": 1e4, "fy": 1e4},
        {"distortion": (0.1, 0.0, 0.0)},
        {"distortion": (1e9, 0.0, 0.0, 0.0)},
    ],
)
def test_intrinsics_that_no_camera_has_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(FrameError, match=r"fit a 640x480|too large|distortion"):
        dataclasses.replace(VGA, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 90.0, "fy": 90.0},  # rectified fisheye, 148 degrees
        {"fx": 30000.0, "fy": 30000.0},  # tele lens
        {"cx": -300.0, "cy": 700.0},  # crop away from the optical axis
        {"distortion": (-12.0, 45.0, 0.001, 0.001, -80.0, -12.0, 44.0, -79.0)},  # rational model
    ],
)
def test_unusual_but_real_cameras_are_accepted(change: dict[str, float]) -> None:
    assert dataclasses.replace(VGA, **change) != VGA


def test_normalised_intrinsics_are_named_and_the_pixels_given() -> None:
    with pytest.raises(FrameError, match=r"normalised.*multiply fx and cx by the width.*fx=512 .*cx=320 cy=240"):
        CameraIntrinsics(0.8, 1.07, 0.5, 0.5, 640, 480)


@pytest.mark.parametrize(
    ("name", "value"),
    [("stamp_ns", -1), ("stamp_ns", 2**62 + 1), ("seq", -1), ("seq", 2**63), ("pose_sigma", float("nan"))],
)
def test_a_number_out_of_its_range_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(FrameError, match=name):
        frame(**{name: value})


@pytest.mark.parametrize("width", [32, 640, 641, 1280, 1920])
def test_intrinsics_on_the_bound_stay_within_it_when_resized(width: int) -> None:
    widest = CameraIntrinsics(0.1 * width, 0.1 * 480, width / 2, 240, width, 480)
    for small in range(8, width + 1, 7):
        assert scale_intrinsics(widest, small, 96).width == small
