import itertools
from datetime import timedelta
from pathlib import Path

import depthai as dai
import numpy as np
import pytest

from semantic_mapper.drivers import live
from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.oak.camera import geometry_troubles, open_camera, reported_intrinsics
from semantic_mapper.drivers.oak.device import Sources
from semantic_mapper.errors import CameraError
from tests.drivers.oak import host
from tests.drivers.oak.host import HEIGHT, PERIOD, WIDTH, depth_message, long_ago, rgb_message


def take(camera: Camera, count: int) -> list[CameraImage]:
    return list(itertools.islice(camera, count))


def messages(count: int, *, start: timedelta | None = None) -> tuple[list[dai.Buffer], list[dai.Buffer]]:
    start = start or long_ago(count)
    return [rgb_message(k, start) for k in range(count)], [depth_message(k, start) for k in range(count)]


def test_images_have_colours_metres_stamps_and_intrinsics(calibration: Path) -> None:
    start = long_ago(10)
    with host.camera(lambda: host.played(calibration, *messages(10, start=start))) as camera:
        info = camera.info
        images = take(camera, 10)
        assert camera.warnings == ()
    assert info.source == host.NAME and info.frame_hz == host.FPS
    assert [image.seq for image in images] == list(range(10))
    for k, image in enumerate(images):
        assert image.intrinsics == info.cameras["front"]
        assert np.abs(image.rgb.astype(int) - host.rgb_image(k))[:, [0, 10, -10, -1]].max() < 4
        assert image.depth_m is not None and image.depth_m.dtype == np.float32
        millimetres = host.depth_image(k)
        millimetres[0, :2] = 0
        np.testing.assert_allclose(image.depth_m, millimetres / 1000, atol=1e-6)
        stamp_ns = (start + k * PERIOD) // timedelta(microseconds=1) * 1000
        assert abs(image.stamp_ns - stamp_ns) < 1_000_000  # DepthAI's clock is the machine's monotonic one
    intrinsics = info.cameras["front"]
    # of the calibration, whose images are twenty times as large
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == pytest.approx((50, 51, 32.5, 23.5))
    assert (intrinsics.width, intrinsics.height, intrinsics.distortion) == (WIDTH, HEIGHT, ())


@pytest.mark.parametrize("padding", [None, 16])
def test_colours_are_the_same_in_every_format_and_with_padded_rows(calibration: Path, padding: int | None) -> None:
    start = long_ago(1)
    frame = rgb_message(5, start, dai.ImgFrame.Type.BGR888i)
    if padding is not None:
        packed, stride = rgb_message(5, start).getFrame(), WIDTH + padding
        padded = np.full((packed.shape[0], stride), 99, np.uint8)
        padded[:, :WIDTH] = packed
        frame = dai.ImgFrame()
        frame.setType(dai.ImgFrame.Type.NV12)
        frame.setWidth(WIDTH)
        frame.setHeight(HEIGHT)
        frame.setStride(stride)
        frame.fb.p1Offset, frame.fb.p2Offset = 0, stride * HEIGHT
        frame.setData(padded.ravel())
        host.stamped(frame, 5, start)
    with host.camera(lambda: host.played(calibration, [frame], None)) as camera:
        (image,) = take(camera, 1)
    assert image.depth_m is None
    assert np.abs(image.rgb.astype(int) - host.rgb_image(5))[:, [0, 10, -10, -1]].max() < 4


def test_intrinsics_that_the_images_carry_count_more_than_the_calibration(calibration: Path) -> None:
    rgb, depth = messages(3)
    cropped = dai.ImgTransformation(WIDTH, HEIGHT, [[70.0, 0, 30], [0, 71, 20], [0, 0, 1]])
    other = dai.ImgTransformation(WIDTH, HEIGHT, [[60.0, 0, 30], [0, 61, 20], [0, 0, 1]])
    for message in rgb:
        message.setTransformation(cropped)
    with host.camera(lambda: host.played(calibration, rgb, depth)) as camera:
        (image,) = take(camera, 1)
        assert camera.warnings == ()
    assert (image.intrinsics.fx, image.intrinsics.cy) == (70, 20)
    for message in depth:
        message.setTransformation(other)
    with host.camera(lambda: host.played(calibration, rgb, depth)) as camera:
        (trouble,) = camera.warnings
    assert "not be aligned" in trouble


def test_depth_of_a_camera_elsewhere_and_turned_pictures_are_said() -> None:
    def seen(x_cm: float = 0.0, turned_deg: float = 0.0, *, mirrored: bool = False) -> dai.ImgFrame:
        shown, pose = dai.ImgTransformation(WIDTH, HEIGHT, [[70.0, 0, 30], [0, 70, 20], [0, 0, 1]]), dai.Extrinsics()
        shown.addRotation(turned_deg, dai.Point2f(WIDTH / 2, HEIGHT / 2))
        pose.rotationMatrix, pose.translation = np.eye(3).tolist(), dai.Point3f(x_cm, 0, 0)
        pose.lengthUnit, pose.toCameraSocket = dai.LengthUnit.CENTIMETER, dai.CameraBoardSocket.CAM_A
        shown.setExtrinsics(pose)
        if mirrored:
            shown.addFlipHorizontal()
        frame = dai.ImgFrame()
        frame.setTransformation(shown)
        return frame

    assert geometry_troubles(seen(), seen()) == geometry_troubles(seen(), seen(0.2)) == []
    (trouble,) = geometry_troubles(seen(), seen(7.5))
    assert "not be aligned" in trouble and "75 mm and 0.0 degrees apart" in trouble
    turned = seen(turned_deg=180)
    (trouble,) = geometry_troubles(turned, turned)
    assert "turns its pictures" in trouble
    with pytest.raises(CameraError, match="mirrors"):
        geometry_troubles(seen(mirrored=True), None)
    lens = reported_intrinsics(turned)
    assert lens is not None and np.allclose((lens.fx, lens.fy, lens.cx, lens.cy), (70, 70, WIDTH - 30, HEIGHT - 20))


def test_lost_and_damaged_messages_doubles_and_those_of_the_future_are_gaps(calibration: Path) -> None:
    rgb, depth = messages(9)
    del depth[2], rgb[5]  # what is left of the pair is left out, too
    with host.camera(lambda: host.played(calibration, rgb, depth)) as camera:
        images = take(camera, 7)
    assert [image.seq for image in images] == [0, 1, 3, 4, 6, 7, 8]
    for image in images:  # colour and depth are of one moment
        assert image.depth_m is not None
        assert round(float(image.depth_m[1, 1]) * 1000) - 1110 == image.seq
        assert abs(int(image.rgb[0, 0, 1]) - 8 * image.seq) < 4
    start = long_ago(8)
    rgb = [rgb_message(k, start) for k in (0, 1, 1, 3, 2, 4)]
    rgb.insert(1, rgb_message(9, dai.Clock.now() + timedelta(hours=1)))
    rgb[-1:-1] = [damaged(5, start), damaged(6, start)]
    rgb.append(rgb_message(7, start))
    with host.camera(lambda: host.played(calibration, rgb, None)) as camera:
        images = take(camera, 5)
    assert [image.seq for image in images] == [0, 1, 3, 4, 7]
    stamps = [image.stamp_ns for image in images]
    assert stamps == sorted(set(stamps))


def test_a_device_that_goes_away_is_waited_for(calibration: Path) -> None:
    start = long_ago(60)
    warnings: list[tuple[str, ...]] = []

    def absent() -> Sources:
        warnings.append(camera.warnings)
        raise CameraError("no OAK camera is connected")

    def back() -> Sources:
        warnings.append(camera.warnings)
        counted_anew = [host.stamped(rgb_message(k, start), k, start + 25 * PERIOD) for k in range(4)]
        return host.played(calibration, counted_anew, None)

    def connect(config: host.Config) -> Sources:
        asked.append(config.device)
        return connections.pop(0)()

    first = [rgb_message(k, start) for k in range(4)]
    connections = [lambda: host.played(calibration, first, None, ends=True), absent, back]
    asked: list[str] = []
    camera = open_camera(host.CONFIG, "front", connect=connect)
    with camera:
        images = take(camera, 8)
        assert camera.warnings == ()
    assert [image.seq for image in images] == [0, 1, 2, 3, 25, 26, 27, 28]  # a number for each that was lost
    assert np.diff([image.stamp_ns for image in images]).min() > 0
    assert asked == ["", "1844301000000000", "1844301000000000"]  # the same device, whatever else is plugged in
    (gone,), (missing,) = warnings
    assert f"{host.NAME} has gone" in gone and "no OAK camera is connected" in missing


def test_a_device_without_images_is_refused(calibration: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "START_S", 0.3)
    rgb, _ = messages(3)
    camera = host.camera(lambda: host.played(calibration, rgb, []))
    with pytest.raises(CameraError, match=r"was opened, but has given no image for 0\.3 s"), camera:
        pass


def test_images_that_are_not_what_was_asked_for_are_an_error(calibration: Path) -> None:
    rgb, _ = messages(1)
    config = host.Config(width=80, height=60, fps=host.FPS)
    camera = host.camera(lambda: host.played(calibration, rgb, None), config=config)
    with pytest.raises(CameraError, match="64x48, but 80x60 was requested"), camera:
        pass
    grey = dai.ImgFrame()
    grey.setCvFrame(np.zeros((HEIGHT, WIDTH), np.uint8), dai.ImgFrame.Type.GRAY8)
    flat = host.stamped(grey, 0, rgb[0].getTimestamp())
    with (
        pytest.raises(CameraError, match="16 bits a pixel, got uint8"),
        host.camera(lambda: host.played(calibration, rgb, [flat])),
    ):
        pass


def damaged(k: int, start: timedelta) -> dai.ImgFrame:
    frame = dai.ImgFrame()
    frame.setData(np.zeros(10, np.uint8))
    frame.setWidth(WIDTH)
    frame.setHeight(HEIGHT)
    frame.setType(dai.ImgFrame.Type.NV12)
    return host.stamped(frame, k, start)
