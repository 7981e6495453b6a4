"""RealSense cameras over the SDK's software device; only the list of connected devices is the tests' own."""

import time
from itertools import islice, pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.drivers import live, registry
from semantic_mapper.drivers.live import DRIFT, LiveCamera
from semantic_mapper.drivers.realsense import devices
from semantic_mapper.drivers.realsense.camera import open_camera, read_intrinsics
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import load_realsense
from semantic_mapper.errors import CameraError, DependencyError
from semantic_mapper.types import CameraIntrinsics, UInt8
from tests.drawn_room import walk_frames
from tests.drivers.realsense.soft import HEIGHT, SERIAL, WIDTH, Feed, SoftDevice, lens
from tests.drivers.support import until

try:
    load_realsense()
except DependencyError as error:  # there are wheels for Linux on x86-64 only
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MAX_PAUSE_S", 0.05)
    monkeypatch.setattr(live, "QUEUE", 16)


FRAMES = walk_frames(7, 6, CameraIntrinsics(66.0, 66.0, 47.5, 35.5, 96, 72))


def picture(number: int) -> tuple[UInt8, np.ndarray]:
    """A room, with the number of the image in its first pixel."""
    frame = FRAMES[number % 6]
    rgb = frame.rgb.copy()
    rgb[0, 0] = number % 256
    assert frame.depth_m is not None
    return rgb, np.rint(frame.depth_m * 1000).astype(np.uint16)


def camera_of(*found: SoftDevice, **settings: Any) -> LiveCamera:
    """The camera of devices that are connected one after the other; none in between."""
    waiting = list(found)

    def find(serial: str) -> SoftDevice:
        assert serial in ("", SERIAL)
        for device in waiting:
            if not device.gone:
                return device
        raise CameraError("no RealSense camera is connected")

    small = {"width": WIDTH, "height": HEIGHT, "depth_width": WIDTH, "depth_height": HEIGHT}
    return open_camera(convert_config(small | settings, Config, "test"), "front", find)


def test_images_have_their_own_depth_and_stamps_on_our_clock() -> None:
    device = SoftDevice()
    with Feed(picture, device) as feed, camera_of(device) as camera:
        assert camera.info.source == f"Soft D435 {SERIAL}" and camera.info.frame_hz == 30 and camera.warnings == ()
        images = list(islice(camera, 8))
    for image in images:
        number = int(image.rgb[0, 0, 0])
        rgb, units = picture(number)
        assert np.array_equal(image.rgb, rgb)
        # The SDK's alignment rounds to pixels, so that one in fifty takes the value of a neighbour, or none.
        assert image.depth_m is not None and (np.abs(image.depth_m - units / 1000) < 1e-6).mean() > 0.95
        assert image.depth_m.dtype == np.float32 and image.own_pose is None and image.camera_id == "front"
        assert image.intrinsics == camera.info.cameras["front"] and image.intrinsics.fx == 66.0
        assert abs(image.stamp_ns - feed.captured_ns[number]) < 1e9  # two clocks are not read at quite the same time
    assert [a.seq < b.seq and a.stamp_ns < b.stamp_ns for a, b in pairwise(images)] == [True] * 7


def test_the_clock_of_the_device_is_put_on_ours() -> None:
    device = SoftDevice()
    with Feed(picture, device, "hardware_clock") as feed, camera_of(device) as camera:
        opened_ns = time.monotonic_ns()
        images = list(islice(camera, 5))
        assert images[0].stamp_ns <= opened_ns, "the first image came while the camera was opened"
        assert all(image.stamp_ns <= time.monotonic_ns() for image in images)
    late_ns = np.array([image.stamp_ns - feed.captured_ns[int(image.rgb[0, 0, 0])] for image in images])
    assert (late_ns >= 20e6 - 1e3).all()  # as long as the quickest image so far took; an SDK's double rounds
    drift_ns = DRIFT * (images[-1].stamp_ns - images[0].stamp_ns)
    assert (np.diff(late_ns) <= drift_ns + 1e3).all(), "an image that comes late does not take the clock with it"


def test_depth_of_the_other_sensor_is_aligned_to_colour() -> None:
    """Depth from 3 cm to the left: what it sees at column u, 1.5 m away, colour sees 66 * 0.03 / 1.5 pixels further."""
    T = np.eye(4)
    T[0, 3] = 0.03
    units = np.full((HEIGHT, WIDTH), 3000, np.uint16)
    units[:, 50:] = 1500
    device = SoftDevice(T_color_depth=T)
    with Feed(lambda n: (picture(n)[0], units), device), camera_of(device) as camera:
        depth = next(iter(camera)).depth_m
    assert depth is not None
    near = np.flatnonzero((np.abs(depth - 1.5) < 0.01).mean(axis=0) > 0.5)
    assert abs(int(near.min()) - (50 + 66 * 0.03 / 1.5)) <= 1 and near.max() == WIDTH - 1
    assert (np.abs(depth[:, 5:40] - 3.0) < 0.01).mean() > 0.9


def test_settings_reach_the_sensor_and_a_slow_port_is_told() -> None:
    rs, device = load_realsense(), SoftDevice(usb="2.1")
    with Feed(picture, device), camera_of(device, preset="high_density", ir_dots=True) as camera:
        assert device.depth_sensor.get_option(rs.option.visual_preset) == int(rs.rs400_visual_preset.high_density)
        assert device.depth_sensor.get_option(rs.option.emitter_enabled) == 1.0
        assert "USB 2.1, too slow for its images" in camera.warnings[0]
    alone = SoftDevice()
    with Feed(lambda n: (picture(n)[0], None), alone), camera_of(alone, depth=False) as camera:
        assert all(image.depth_m is None for image in islice(camera, 3))


def test_modes_that_are_not_offered_and_devices_that_give_nothing_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "START_S", 0.2)
    for settings, complaint in (
        ({"width": 640}, "gives no color of 640x72 at 30 images/s, but 96x72 at 30; set `fps`, `width`"),
        ({"fps": 60}, "gives no color of 96x72 at 60 images/s"),
        ({"depth_height": 480}, "gives no depth of 96x480 at 30 images/s, but 96x72 at 30"),
        ({}, r"was opened, but has given no image for 0.2 s"),
    ):
        with pytest.raises(CameraError, match=complaint), camera_of(SoftDevice(), **settings):
            pass


def test_a_device_that_goes_away_is_waited_for_and_images_of_the_future_are_passed_over() -> None:
    first, second = SoftDevice(), SoftDevice()
    with Feed(picture, first) as feed, camera_of(first, second) as camera:
        images = iter(camera)
        before = list(islice(images, 3))[-1]
        feed.device = None
        first.gone = second.gone = True
        until(lambda: any("no RealSense camera is connected" in text for text in camera.warnings))
        second.gone, feed.device = False, second
        after = next(image for image in images if image.seq > before.seq + 1)
        assert after.stamp_ns > before.stamp_ns
        until(lambda: camera.warnings == ())
        feed.ahead_ms = 60_000.0
        until(lambda: any("its stamp is in the future" in text for text in camera.warnings))
        feed.ahead_ms = 0.0
        until(lambda: camera.warnings == ())
        assert next(images).stamp_ns > after.stamp_ns


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_lens_models_of_the_sdk_become_opencv_s(model: str) -> None:
    """As of a D455: its colour camera has the inverse of OpenCV's model."""
    told = lens(640, 480, 385.0, model, (-0.056, 0.067, 0.0005, -0.0003, -0.022))
    found = read_intrinsics(told)
    rs = load_realsense()
    pixels = np.array([(x, y) for x in (5.0, 200.0, 630.0) for y in (5.0, 300.0, 470.0)])
    rays = np.array([rs.rs2_deproject_pixel_to_point(told, pixel.tolist(), 1.0) for pixel in pixels])
    K = np.array(((found.fx, 0, found.cx), (0, found.fy, found.cy), (0, 0, 1)))
    again, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(found.distortion))
    assert np.abs(again[:, 0] - pixels).max() < 0.5


def test_colour_and_depth_lose_the_lens_together() -> None:
    told = lens(WIDTH, HEIGHT, 66.0, "brown_conrady", (-0.1, 0.02, 0.0, 0.0, 0.0))
    device = SoftDevice(color=told, depth=told)
    with Feed(picture, device), camera_of(device) as camera:
        image = next(iter(camera))
    assert image.intrinsics.distortion == () and image.intrinsics.fx != 66.0
    assert image.depth_m is not None and (image.depth_m > 0).mean() > 0.9


def test_connected_devices_are_listed_and_found_by_their_serial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "SEARCH_S", 0.0)
    assert devices.connected() == []  # the SDK's own answer on a machine without one
    with pytest.raises(CameraError, match="no RealSense camera is connected, or it is in use: check its cable"):
        devices.find_device("")
    soft = SoftDevice()
    monkeypatch.setattr(devices, "connected", lambda: [soft])
    (found,) = devices.list_devices()
    assert (found.kind, found.name, found.address, found.note) == ("realsense", "Soft D435", SERIAL, "USB 3.2")
    assert devices.find_device(SERIAL) is soft
    with pytest.raises(CameraError, match="the RealSense '77' is not connected"):
        devices.find_device("77")
