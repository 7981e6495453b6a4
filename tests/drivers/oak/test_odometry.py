import itertools
import threading
from datetime import timedelta
from pathlib import Path

import depthai as dai
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.oak import camera as camera_module
from semantic_mapper.drivers.oak import odometry
from semantic_mapper.drivers.oak.device import Sources
from semantic_mapper.drivers.oak.odometry import T_BODY_LEFT, basalt_pose
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import Float64
from tests.drivers.oak import host
from tests.drivers.oak.host import FPS, HEIGHT, WIDTH, rgb_message

SPEED = np.array((0.4, -0.2, 0.1))  # metres a second
TURN = np.array((0.1, 0.5, -0.3))  # radians a second
WAITS = host.Config(width=WIDTH, height=HEIGHT, fps=FPS, odometry=True)


def pose(rotation: Float64, position: Float64) -> Float64:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = position
    return T


T_LEFT_RGB = pose(np.array((0.02, -0.01, 0.03)), np.array((0.0375, 0.005, -0.0025)))


def left_pose(seconds: float) -> Float64:
    return pose(np.array((0.3, 0.0, 0.0)), np.zeros(3)) @ pose(TURN * seconds, SPEED * seconds)


def basalt_says(k: int) -> dai.TransformData:
    """What Basalt sends of pair ``k``: the body's pose, without a stamp."""
    T_world_body = left_pose(k / FPS) @ invert_pose(T_BODY_LEFT)
    quaternion = Rotation.from_matrix(T_world_body[:3, :3]).as_quat()
    return dai.TransformData(*T_world_body[:3, 3].tolist(), *quaternion.tolist())


def live(calibration: Path, count: int, *, ends: bool = False, start: timedelta | None = None) -> Sources:
    """Colour images as a camera gives them: each when it has been captured."""
    start = start or dai.Clock.now()
    rgb = [rgb_message(k, start) for k in range(count)]
    return host.played(calibration, rgb, None, period_s=1 / FPS, ends=ends)


def with_pose(images: list[CameraImage]) -> list[CameraImage]:
    return [image for image in images if image.own_pose is not None]


def test_images_carry_the_pose_of_their_moment(calibration: Path) -> None:
    start = dai.Clock.now()
    sources = host.tracked(live(calibration, 60, start=start), basalt_says, T_LEFT_RGB, start=start)
    camera = host.camera(lambda: sources, config=WAITS)
    with camera:
        images = list(itertools.islice(camera, 50))
        assert camera.warnings == ()
    assert all(image.tracks_itself for image in images)
    posed = with_pose(images)
    assert len(posed) > 10  # but those from before the first pose
    start_ns = start // timedelta(microseconds=1) * 1000
    for image in posed:
        assert image.own_pose is not None and image.own_pose.source == "vio"
        # pairs are slower than images, so this lies between two poses
        expected = left_pose((image.stamp_ns - start_ns) / 1e9) @ T_LEFT_RGB
        np.testing.assert_allclose(image.own_pose.T_world_camera, expected, atol=1e-4)


def test_images_do_not_wait_for_ever_and_a_lost_track_is_told(
    calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(odometry, "ANSWER_S", 0.2)
    monkeypatch.setattr(camera_module, "ODOMETRY_WAIT_S", 0.1)
    go_on = threading.Event()

    def says_nothing(k: int) -> dai.TransformData:
        go_on.wait(60)
        return basalt_says(k)

    camera = host.camera(lambda: host.tracked(live(calibration, 60), says_nothing, T_LEFT_RGB), config=WAITS)
    with camera:
        images = list(itertools.islice(camera, 40))
        assert any("odometry has not answered for 0.2 s" in trouble for trouble in camera.warnings)
        go_on.set()
    assert not with_pose(images)
    lost = dai.TransformData(float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    camera = host.camera(lambda: host.tracked(live(calibration, 30), lambda _: lost, T_LEFT_RGB), config=WAITS)
    with camera:
        assert not with_pose(list(itertools.islice(camera, 20)))
        assert any("lost track" in trouble for trouble in camera.warnings)


def test_after_a_reconnection_poses_are_of_another_world(calibration: Path) -> None:
    def connect(count: int, ends: bool) -> Sources:
        return host.tracked(live(calibration, count, ends=ends), basalt_says, T_LEFT_RGB)

    camera = host.camera(lambda: connect(30, True), lambda: connect(60, False), config=WAITS)
    with camera:
        images = with_pose(list(itertools.islice(camera, 70)))
    worlds = [image.own_pose.world for image in images if image.own_pose is not None]
    assert len(set(worlds)) == 2 and worlds == sorted(worlds) and min(worlds) > 0


def test_an_exception_while_tracking_is_told_and_the_camera_opened_again(calibration: Path) -> None:
    told: list[str] = []

    def again() -> Sources:
        told.extend(camera.warnings)
        return host.tracked(live(calibration, 60), basalt_says, T_LEFT_RGB)

    camera = host.camera(
        lambda: host.tracked(live(calibration, 60), lambda _: dai.Buffer(), T_LEFT_RGB), again, config=WAITS
    )
    with camera:
        next(image for image in camera if image.own_pose is not None)
    assert any("odometry has ended" in text and "getTranslation" in text for text in told)


def test_the_body_looks_along_x_and_the_camera_along_z() -> None:
    T_world_left = basalt_pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(T_world_left[:3, 2], (1, 0, 0))  # forward is x of the world
    np.testing.assert_allclose(T_world_left[:3, 0], (0, -1, 0))  # right of the image is -y
    np.testing.assert_allclose(T_world_left[:3, 1], (0, 0, -1))  # down is -z
    np.testing.assert_allclose(T_world_left[:3, 3], (1, 2, 3))
