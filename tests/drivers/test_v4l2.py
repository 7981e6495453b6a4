"""V4L2 cameras that do what they are requested, and all the ways in which they do not."""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.drivers.v4l2 import ioctls
from semantic_mapper.drivers.v4l2.devices import list_devices
from semantic_mapper.errors import CameraError, ConfigError
from tests.drivers.fake_v4l2 import METADATA, Capture, Machine, Sensor, make_machine
from tests.drivers.support import PATIENCE_S, until, write_calibration


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return make_machine(tmp_path, monkeypatch)


def v4l2(named: Path | str, tmp_path: Path, **settings: Any) -> Camera:
    config = {"device": str(named), "calibration": write_calibration(tmp_path / "webcam.toml"), "stall_s": PATIENCE_S}
    return open_camera("v4l2", config | settings, "front", "test")


def image_where(images: Iterator[CameraImage], holds: Callable[[CameraImage], bool]) -> CameraImage:
    return next(image for image in images if holds(image))


def test_requests_are_those_of_the_kernel_s_header() -> None:
    assert (ioctls.QUERYCAP, ioctls.ENUM_FMT) == (0x80685600, 0xC0405602)
    assert (ioctls.G_CTRL, ioctls.S_CTRL, ioctls.QUERYCTRL) == (0xC008561B, 0xC008561C, 0xC0445624)


def test_images_are_rgb_with_the_stamps_of_their_buffers(machine: Machine, tmp_path: Path) -> None:
    device = machine.plug(Sensor(), 0)
    with v4l2(device, tmp_path) as camera:
        before_ns = time.monotonic_ns()
        images = list(islice(camera, 5))
        after_ns = time.monotonic_ns()
        assert camera.info.source == f"V4L2 HD Webcam at {device}" and camera.info.frame_hz == 30
        assert camera.info.cameras["front"] == images[0].intrinsics
        assert camera.warnings == ()
    for image in images:
        assert image.rgb.shape == (48, 64, 3) and image.rgb.dtype == np.uint8
        assert (image.rgb[7, 9] == (100, 50, 0)).all()
        assert image.camera_id == "front" and image.depth_m is None and image.own_pose is None
        assert before_ns - 100_000_000 < image.stamp_ns < after_ns - 15_000_000  # 20 ms before it arrived
    seqs = [image.seq for image in images]
    assert seqs == sorted(set(seqs)) and seqs[0] >= 0
    stamps = [image.stamp_ns for image in images]
    assert stamps == sorted(set(stamps))


def test_what_the_device_does_otherwise_than_asked_is_told(machine: Machine, tmp_path: Path) -> None:
    device = machine.plug(Sensor(formats=("YUYV",), rate=10.0, clock=time.time), 0)
    with v4l2(device, tmp_path) as camera:
        before_ns = time.monotonic_ns()
        image = next(iter(camera))
        assert before_ns - 1_000_000_000 < image.stamp_ns <= time.monotonic_ns(), "stamped when it arrived"
        told = " / ".join(camera.warnings)
        assert camera.info.frame_hz == 10
    assert "requested pixels as MJPG, it gives YUYV; it offers YUYV" in told
    assert "requested 30 images/s, it gives 10" in told and "stamped when they arrive" in told
    other = machine.plug(Sensor(sizes=((80, 60),)), 1, link="usb-Other-video-index0")
    with pytest.raises(CameraError, match="80x60, but was calibrated at 64x48"), v4l2(other, tmp_path):
        pass


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"calibration": ""}, "semantic-mapper calibrate"),
        ({"device": ""}, "`doctor --cameras` lists"),
        ({"uncalibrated": True}, "leave one of the two out"),
        ({"width": 80, "height": 60}, "another size than the 80x60"),
        ({"calibration": "missing.toml"}, "missing.toml: no such file"),
        ({"width": 80}, "both width and height"),
        ({"fourcc": "MJPEG"}, "fourcc"),
        ({"exposure_m": 3}, "did you mean `exposure_ms`?"),
        ({"gain": 2**31}, "gain"),  # ctypes would pass on what is left of a larger one
        ({"white_balance_k": 2**32 + 4000}, "white_balance_k"),
        ({"exposure_ms": float("inf")}, "exposure_ms"),
        ({"controls": {"focus_absolute": -(2**31) - 1}}, "controls"),
    ],
)
def test_a_config_that_cannot_work_is_refused_at_once(tmp_path: Path, settings: dict[str, Any], says: str) -> None:
    with pytest.raises((CameraError, ConfigError)) as caught:
        v4l2("/dev/video0", tmp_path, **settings)
    assert says in str(caught.value)


def test_unplugged_it_is_waited_for_found_under_another_index_and_can_be_stopped(
    machine: Machine, tmp_path: Path
) -> None:
    sensor, other = Sensor(level=100), Sensor(card="Other", level=200)
    device = machine.plug(sensor, 0)
    with v4l2(device, tmp_path) as camera:
        images = iter(camera)
        before = next(images)
        machine.unplug(sensor)
        machine.plug(other, 0, link="usb-Other-video-index0")  # has taken its number
        until(lambda: any("no such camera" in t and "waited for since" in t for t in camera.warnings))
        plugged_ns = time.monotonic_ns()
        machine.plug(sensor, 3)
        after = image_where(images, lambda image: image.stamp_ns > plugged_ns)
        until(lambda: camera.warnings == ())
        assert (after.rgb[0, 0] == (100, 50, 0)).all()  # not the other one
        assert after.seq > before.seq + 1
        machine.unplug(sensor)
        until(lambda: camera.warnings != ())
        threading.Timer(0.1, camera.stop).start()
        assert len(list(images)) <= 1, "stopped from another thread while it is gone"


def test_a_stream_that_stalls_is_told_even_while_a_read_hangs_and_started_anew(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.drivers.fake_v4l2.SELECT_S", 1.0)
    sensor = Sensor()
    with v4l2(machine.plug(sensor, 0), tmp_path, stall_s=0.3) as camera:
        images = iter(camera)
        before = next(images)
        sensor.stalled = True
        until(lambda: any("the stream has stalled" in t for t in camera.warnings))
        assert sensor.opens == 1
        until(lambda: any("gives no images" in t for t in camera.warnings))
        going_ns = time.monotonic_ns()
        sensor.stalled = False
        after = image_where(images, lambda image: image.stamp_ns > going_ns)
        assert sensor.opens >= 2
        assert after.seq > before.seq + 1
        until(lambda: camera.warnings == ())


def test_single_damaged_images_are_gaps_and_no_reason_to_start_anew(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an uncalibrated camera, which gives images for calibrating and says so."""
    sensor = Sensor(sizes=((64, 48), (80, 60)))
    read = [0]
    whole = Capture.read

    def every_third(capture: Capture) -> tuple[bool, np.ndarray | None]:
        read[0] += 1
        sensor.damaged = read[0] % 3 == 0
        return whole(capture)

    monkeypatch.setattr(Capture, "read", every_third)
    wish = {"calibration": "", "uncalibrated": True, "width": 80, "height": 60}
    with v4l2(machine.plug(sensor, 0), tmp_path, **wish) as camera:
        images = list(islice(camera, 8))
        assert sensor.opens == 1 and any("not calibrated" in trouble for trouble in camera.warnings)
    assert all(image.seq % 3 != 2 and image.rgb.shape == (60, 80, 3) for image in images) and images[-1].seq >= 10


def test_a_device_in_use_or_that_is_none_is_told(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = machine.plug(Sensor(busy=True), 0)
    metadata = machine.plug(Sensor(capabilities=METADATA), 1, link="usb-HD_Webcam-video-index1")
    (machine.dev / "video8").touch()
    for path, says in (
        (device, "is another program using it"),
        (metadata, "it is the metadata of HD Webcam"),
        (machine.dev / "video7", "no such camera: .*No such file.*is it plugged in"),
        (machine.dev / "video8", "no such camera: .*is it a camera"),
    ):
        if path.name == "video8":
            monkeypatch.undo()  # as the kernel says it
        with pytest.raises(CameraError, match=says), v4l2(path, tmp_path):
            pass


def test_controls_are_set_automatic_ones_too(machine: Machine, tmp_path: Path) -> None:
    sensor = Sensor(values={ioctls.EXPOSURE_AUTO: 1, ioctls.AUTO_WHITE_BALANCE: 0})  # left so by somebody else
    device = machine.plug(sensor, 0)
    with v4l2(device, tmp_path):
        assert sensor.values == {ioctls.EXPOSURE_AUTO: 3, ioctls.AUTO_WHITE_BALANCE: 1}
    with v4l2(device, tmp_path, exposure_ms=8.0, white_balance_k=5000, gain=40, controls={"focus_absolute": 10}) as c:
        assert c.warnings == ()
    assert sensor.values == {
        ioctls.EXPOSURE_AUTO: ioctls.EXPOSURE_MANUAL,
        ioctls.EXPOSURE_ABSOLUTE: 80,
        ioctls.AUTO_WHITE_BALANCE: 0,
        ioctls.WHITE_BALANCE_TEMPERATURE: 5000,
        ioctls.GAIN: 40,
        0x009A090A: 10,
    }


def test_controls_that_do_not_follow_are_told(machine: Machine, tmp_path: Path) -> None:
    device = machine.plug(Sensor(), 0)
    with v4l2(device, tmp_path, exposure_ms=500.0, gain=101, controls={"focus_absolut": 3}) as camera:
        told = " / ".join(camera.warnings)
    assert "requested exposure_time_absolute = 5000, it has 2047; exposure_time_absolute goes from 3 to 2047" in told
    assert "gain: requested gain = 101, it has 100" in told
    assert "no control 'focus_absolut'; did you mean `focus_absolute`?" in told
    bare = machine.plug(Sensor(controls=()), 1, link="usb-Bare-video-index0")
    with v4l2(bare, tmp_path, gain=3) as camera:
        assert "it has no control 'gain'; there are none" in camera.warnings[0]


def test_listing_names_cameras_by_id_and_leaves_metadata_out(machine: Machine) -> None:
    link = machine.plug(Sensor(), 10)
    machine.plug(Sensor(capabilities=METADATA), 11, link="usb-HD_Webcam-video-index1")
    plain = machine.plug(Sensor(card="Grabber", formats=("YUYV",)), 2, link="")
    dead = machine.plug(Sensor(answers=False), 3, link="")
    rows = [(c.kind, c.name, c.address) for c in list_devices()]
    assert rows == [("v4l2", "Grabber", str(plain)), ("v4l2", "?", str(dead)), ("v4l2", "HD Webcam", str(link))]
    notes = [c.note for c in list_devices()]
    assert notes[2] == "video10; MJPG YUYV; uvcvideo at usb-1.2" and "does not answer" in notes[1]


def test_a_failure_of_the_reading_thread_is_no_silence(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)
    with v4l2(machine.plug(Sensor(), 0), tmp_path) as camera:
        images = iter(camera)
        next(images)
        monkeypatch.setattr("tests.drivers.fake_v4l2.Capture.read", lambda capture: 1 / 0)
        with pytest.raises(CameraError, match="its reading thread has failed"):
            list(images)
