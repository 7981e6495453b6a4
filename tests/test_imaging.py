from dataclasses import replace

import numpy as np
import pytest

from semantic_mapper.errors import FrameError
from semantic_mapper.geometry import check_pose, transform, unproject
from semantic_mapper.imaging import rotate_frame, rotate_intrinsics
from semantic_mapper.types import CameraIntrinsics, PosedFrame

INTRINSICS = CameraIntrinsics(20.0, 22.0, 9.0, 8.0, 20, 14)


def a_frame() -> PosedFrame:
    rng = np.random.default_rng(3)
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3] *= np.linalg.det(T[:3, :3])
    T[:3, 3] = (1.0, -2.0, 0.5)
    return PosedFrame(
        stamp_ns=1,
        seq=0,
        camera_id="side",
        rgb=rng.integers(0, 256, (14, 20, 3), np.uint8),
        depth_m=rng.uniform(1, 3, (14, 20)).astype(np.float32),
        label=rng.integers(0, 9, (14, 20), np.uint8),
        intrinsics=INTRINSICS,
        T_world_camera=T,
    )


def coloured_points(frame: PosedFrame) -> np.ndarray:
    """(H W, 7) world position, colour, label of each pixel, sorted."""
    assert frame.depth_m is not None and frame.label is not None
    points = transform(frame.T_world_camera, unproject(frame.depth_m, frame.intrinsics).reshape(-1, 3))
    rows = np.hstack((points, frame.rgb.reshape(-1, 3), frame.label.reshape(-1, 1)))
    return rows[np.lexsort(rows.T.round(6))]


@pytest.mark.parametrize("quarters", [0, 1, 2, 3, -1])
def test_every_pixel_keeps_its_place_in_the_world(quarters: int):
    frame = a_frame()
    turned = rotate_frame(frame, quarters)
    check_pose(turned.T_world_camera, "turned")
    np.testing.assert_allclose(coloured_points(turned), coloured_points(frame), atol=1e-6)


def test_a_quarter_clockwise_brings_the_left_edge_to_the_top():
    frame = a_frame()
    turned = rotate_frame(frame, 1)
    assert (turned.intrinsics.width, turned.intrinsics.height) == (14, 20)
    np.testing.assert_array_equal(turned.rgb[0], frame.rgb[::-1, 0])


def test_a_distorted_image_is_refused():
    with pytest.raises(FrameError, match="rectify"):
        rotate_intrinsics(replace(INTRINSICS, distortion=(0.1, 0.0, 0.0, 0.0)), 1)
