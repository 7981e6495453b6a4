"""Video files and streams: real files, a real server, FFmpeg as OpenCV has it."""

import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.base import Camera
from semantic_mapper.drivers.live import StreamClock
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.errors import CameraError, ConfigError
from tests.drivers.support import until, write_calibration, write_film

COUNT = 12
HZ = 10


def level(index: int) -> int:
    return 10 + 20 * index


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Red images that grow brighter, 10 a second."""
    return red_film(tmp_path_factory.mktemp("video") / "red.avi")


def red_film(path: Path, codec: str = "MJPG") -> Path:
    return write_film(path, [np.full((48, 64, 3), (level(k), 0, 0), np.uint8) for k in range(COUNT)], HZ, codec)


def opencv(named: Path | str, tmp_path: Path, **settings: Any) -> Camera:
    config = {"source": str(named), "calibration": write_calibration(tmp_path / "lens.toml"), "pace": "fast"}
    return open_camera("opencv", config | settings, "film", "test")


def test_every_image_of_a_file_comes_with_the_time_within_it(tmp_path: Path) -> None:
    with opencv(red_film(tmp_path / "red.mp4", "mp4v"), tmp_path) as camera:
        assert camera.info.frame_count == COUNT and camera.info.frame_hz == HZ
        assert camera.info.source == "video red.mp4"
        images = list(camera)
        assert camera.warnings == ()
    assert [image.seq for image in images] == list(range(COUNT))
    stamps = [image.stamp_ns for image in images]
    assert stamps == pytest.approx([k * 100_000_000 for k in range(COUNT)], abs=1_000_000)
    for index, image in enumerate(images):
        red, green, blue = image.rgb.reshape(-1, 3).mean(axis=0)
        assert red == pytest.approx(level(index), abs=4) and green < 8 and blue < 8
        assert image.camera_id == "film" and image.depth_m is None


def test_a_file_in_its_recorded_rhythm_can_be_stopped(video: Path, tmp_path: Path) -> None:
    with opencv(video, tmp_path, pace="recorded") as camera:
        images = iter(camera)
        began = time.monotonic()
        assert [image.seq for image in islice(images, 3)] == [0, 1, 2]
        assert time.monotonic() - began >= 0.15  # three images are 0.2 s apart
        camera.stop()
        assert not list(images)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"source": ""}, "no video is named"),
        ({"calibration": ""}, "semantic-mapper calibrate"),
        ({"source": "missing.avi"}, "missing.avi: no such video file"),
        ({"source": __file__}, "no video that OpenCV can read"),
        ({"calibration": "large.toml"}, "64x48, but was calibrated at 128x96"),
        ({"source": "http://127.0.0.1:1/stream.mjpg", "open_timeout_s": 1}, "cannot be opened within 1 s"),
    ],
)
def test_what_cannot_be_played_is_told(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_calibration(tmp_path / "large.toml", 128, 96)
    with pytest.raises((CameraError, ConfigError)) as caught, opencv(video, tmp_path, **settings):
        pass
    assert says in str(caught.value)


class Sender:
    """Sends motion JPEG over HTTP until told to break off; then clients that connect again gets more."""

    def __init__(self) -> None:
        self.connections = 0
        self.break_off = threading.Event()
        self.refuse = threading.Event()
        _, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), (0, 0, 200), np.uint8))
        self._jpeg = jpeg.tobytes()
        sender = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                sender.serve(self)

            def log_message(self, format: str, *args: object) -> None:  # noqa: A002
                return

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}/stream.mjpg"

    def serve(self, request: BaseHTTPRequestHandler) -> None:
        if self.refuse.is_set():
            request.send_error(503)
            return
        self.connections += 1
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        try:
            while not self.break_off.wait(0.02):
                request.wfile.write(
                    b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n"
                    % (len(self._jpeg), self._jpeg)
                )
        except OSError:
            return  # the client has gone

    def close(self) -> None:
        self.break_off.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def sender() -> Iterator[Sender]:
    made = Sender()
    yield made
    made.close()


def test_a_stream_that_breaks_off_is_connected_anew(sender: Sender, tmp_path: Path) -> None:
    began_ns = time.monotonic_ns()
    with opencv(sender.url, tmp_path, stamps="arrival", open_timeout_s=20, stall_s=20) as camera:
        assert camera.info.source == f"stream {sender.url}"
        images = iter(camera)
        first = next(images)
        assert abs(first.rgb[20, 30].astype(int) - (200, 0, 0)).max() < 8
        assert began_ns < first.stamp_ns <= time.monotonic_ns()
        sender.refuse.set()
        sender.break_off.set()
        until(lambda: any("waited for since" in trouble for trouble in camera.warnings))
        sender.break_off.clear()
        back_ns = time.monotonic_ns()
        sender.refuse.clear()
        later = next(image for image in images if image.stamp_ns > back_ns)
        assert later.seq > first.seq + 1 and sender.connections >= 2
        assert camera.warnings == ()


def test_the_sender_s_clock_is_found_through_the_jitter_of_the_way(rng: np.random.Generator) -> None:
    clock = StreamClock()
    errors = []
    for k in range(600):
        sent_ns = k * 33_333_333
        captured_ns = round(1e12 + sent_ns * (1 + 5e-5))  # on our clock; theirs runs 50 ppm slow
        stamp_ns = clock.stamp_ns(sent_ns, captured_ns + round(5e6 + rng.exponential(20e6)))
        errors.append((stamp_ns - captured_ns) / 1e6)
    assert clock.trustworthy
    assert max(abs(error - 5) for error in errors[100:]) < 4  # ms; the jitter is 20


@pytest.mark.parametrize("told_hz", [25.0, 0.0])
def test_a_clock_that_counts_images_is_found_out(told_hz: float) -> None:
    clock = StreamClock()
    stamps = [(clock.stamp_ns(round(k * 1e9 / told_hz) if told_hz else 0, 10**12 + k * 10**8)) for k in range(60)]
    assert not clock.trustworthy
    assert stamps[-1] == 10**12 + 59 * 10**8
