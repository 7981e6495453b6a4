"""The camera node over cameras: real drivers, sockets and video files; of V4L2 only the kernel is not real."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.base import Camera, CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import PoseChecks
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.errors import CameraError, ConfigError, TransportError
from semantic_mapper.nodes import publishing
from semantic_mapper.nodes.camera import live as live_camera
from semantic_mapper.nodes.camera.node import run_camera
from semantic_mapper.nodes.launcher.liveness import TURN
from semantic_mapper.nodes.options import CameraOptions
from semantic_mapper.transport.messages import EndOfStream, Message, Status, StreamInfo
from semantic_mapper.transport.sockets import LosslessSubscriber
from semantic_mapper.types import PosedFrame
from tests.drivers.fake_v4l2 import Machine, Sensor, make_machine
from tests.drivers.support import PATIENCE_S, write_calibration, write_film
from tests.nodes.mapper.test_query_service import a_folder
from tests.nodes.support import NodeHere, eventually, node_here

COUNT = 9


class Walk(PoseSource):
    """Walks along x; of every third image nobody knows where it was."""

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        T = np.eye(4)
        T[0, 3] = image.seq
        return None if image.seq % 3 == 2 else PoseEstimate(T, "walk", 0.1)


def walking(camera: Camera) -> PosedCamera:
    return PosedCamera(camera, Walk(), PoseChecks(max_speed_m_s=1e6))


@dataclass
class Running:
    """A camera node in a thread of the test, and what it has published so far."""

    node: NodeHere
    heard: list[Message] = field(default_factory=list)

    def until(self, holds: Callable[[Message], bool]) -> Any:
        """The first message that holds, waited for; those before it count, too."""
        deadline = time.monotonic() + PATIENCE_S
        while (found := next((m for m in list(self.heard) if holds(m)), None)) is None:
            assert time.monotonic() < deadline, self.heard[-3:]
            time.sleep(0.01)
        return found

    def until_end(self) -> EndOfStream:
        end = self.until(lambda m: isinstance(m, EndOfStream))
        self.node.wait(PATIENCE_S)
        return end

    def until_status(self, holds: Callable[[Status], bool]) -> Status:
        return self.until(lambda m: isinstance(m, Status) and holds(m))

    def frames(self) -> list[PosedFrame]:
        return [m for m in list(self.heard) if isinstance(m, PosedFrame)]


@contextmanager
def running(options: dict[str, Any], *, busy: threading.Event | None = None, **more: Any) -> Iterator[Running]:
    ended = threading.Event()
    with a_folder() as folder:
        endpoint = f"ipc://{folder}/eye"
        checked = convert_config(options, CameraOptions, "test")

        def listen() -> None:
            with LosslessSubscriber(endpoint, ("info", "frame", "end", "status"), hwm=2) as subscriber:
                while not ended.is_set():
                    if busy is not None and busy.is_set():  # reads nothing
                        ended.wait(0.01)
                        continue
                    message = subscriber.receive(0.05)
                    if message is not None:
                        camera.heard.append(message)
                    if isinstance(message, EndOfStream):
                        return

        listener = threading.Thread(target=listen)
        try:
            with node_here(run_camera, "eye", {"eye": endpoint}, checked, **more) as node:
                camera = Running(node)
                listener.start()
                yield camera
        finally:
            ended.set()
            listener.join(PATIENCE_S)
        assert not listener.is_alive()


@pytest.fixture(autouse=True)
def _walking(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_camera, "with_poses", lambda camera, live, driver: walking(camera))
    monkeypatch.setattr(publishing, "STATUS_PERIOD_S", 0.1)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return make_machine(tmp_path, monkeypatch)


def v4l2(device: Path, tmp_path: Path, **settings: Any) -> dict[str, Any]:
    config = {"device": str(device), "calibration": write_calibration(tmp_path / "webcam.toml"), "stall_s": PATIENCE_S}
    return {"camera": {"kind": "v4l2", "id": "front", "config": config | settings, "poses": {"kind": "walk"}}}


def test_a_video_file_is_published_to_its_end(tmp_path: Path) -> None:
    film = write_film(tmp_path / "film.avi", [np.full((48, 64, 3), (20 * k, 0, 0), np.uint8) for k in range(COUNT)])
    config = tmp_path / "film.toml"
    config.write_text(f'source = "{film}"\ncalibration = "{write_calibration(tmp_path / "lens.toml")}"\n')
    with running({"camera": {"kind": "opencv", "config": str(config), "poses": {"kind": "walk"}}}) as camera:
        end = camera.until_end()
        info = camera.until(lambda m: isinstance(m, StreamInfo))
    assert (end.reason, end.published, end.source) == ("end", 6, "eye")
    assert info.source == "video film.avi" and list(info.cameras) == ["camera"]
    frames = camera.frames()
    assert [f.seq for f in frames] == [0, 1, 3, 4, 6, 7]
    assert [f.T_world_camera[0, 3] for f in frames] == [0, 1, 3, 4, 6, 7]
    assert all(f.pose_source == "walk" and f.pose_sigma == 0.1 for f in frames)
    assert frames[4].rgb[..., 0].mean() == pytest.approx(120, abs=5)


def long_film(tmp_path: Path) -> dict[str, Any]:
    """60 images, as quickly as they are taken; a third of them is without a pose."""
    noise = np.random.default_rng(1).integers(0, 255, (240, 320, 3), np.uint8)
    film = write_film(tmp_path / "film.avi", [noise] * 60)
    lens = write_calibration(tmp_path / "lens.toml", 320, 240)
    config = {"source": str(film), "calibration": lens, "pace": "fast"}
    return {"camera": {"kind": "opencv", "config": config, "poses": {"kind": "walk"}}}


def test_a_video_file_waits_for_a_reader_that_must_not_lose_a_frame(tmp_path: Path) -> None:
    busy = threading.Event()
    busy.set()
    with running(long_film(tmp_path), busy=busy) as camera:
        time.sleep(1.0)  # a mapper that compiles
        assert camera.node.thread.is_alive()
        busy.clear()
        end = camera.until_end()
    assert (end.reason, end.published) == ("end", 40)
    assert [f.seq for f in camera.frames()] == [n for n in range(60) if n % 3 != 2]
    busy.set()
    with running(long_film(tmp_path), busy=busy):
        time.sleep(0.5)  # and is stopped
    with running(long_film(tmp_path) | {"ack_timeout_s": 0.5}, busy=busy, fails=True) as camera:
        camera.node.wait(PATIENCE_S)
    assert isinstance(camera.node.error, TransportError)
    assert "taken no frame for 0.5 s" in str(camera.node.error)


@pytest.mark.parametrize(
    ("poses", "corrections", "closes", "says"),
    [
        ({"kind": "rgbd"}, "", False, "loop closure is off: the option `corrections` of this node is empty"),
        ({"kind": "rgbd", "loop_closure": False}, "", False, ""),
        ({"kind": "rgbd"}, "query", True, ""),
    ],
)
def test_loops_are_closed_only_where_the_map_is_told_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poses: Any, corrections: str, closes: bool, says: str
) -> None:
    opened: list[Any] = []

    def with_poses(camera: Camera, live: Any, driver: Any) -> PosedCamera:
        opened.append(live.poses)
        return walking(camera)

    monkeypatch.setattr(live_camera, "with_poses", with_poses)
    options = {"camera": long_film(tmp_path)["camera"] | {"poses": poses}, "corrections": corrections}
    with running(options) as camera:
        status = camera.until_status(lambda _: True)
    assert opened[-1].get("loop_closure", True) == closes
    assert [says in w for w in status.degraded if "loop closure" in w] == [True] * bool(says)


@pytest.mark.parametrize("start", [None, np.diag((-1.0, -1, 1, 1)).tolist()])
def test_a_camera_that_cannot_be_found_again_must_not_come_back_in_another_world(tmp_path: Path, start: object) -> None:
    poses = {"kind": "visual"} if start is None else {"kind": "rgbd", "T_world_start": start}
    camera = v4l2(tmp_path / "video0", tmp_path)["camera"] | {"poses": poses}
    with running({"camera": camera}, restartable=True, fails=True) as running_camera:
        running_camera.node.wait(PATIENCE_S)
    error = running_camera.node.error
    assert isinstance(error, ConfigError) and 'set restart = "never"' in str(error)
    assert not running_camera.frames()


@pytest.fixture
def film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Settings of a film; its camera has the poses of the launch file."""
    monkeypatch.undo()  # of the walking camera
    images = write_film(tmp_path / "film.avi", [np.full((48, 64, 3), 90, np.uint8)] * COUNT)
    return {"source": str(images), "calibration": str(write_calibration(tmp_path / "lens.toml"))}


def test_frames_get_the_poses_that_the_launch_file_names(film: dict[str, str]) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, -2.0, 0.5
    poses = {"kind": "fixed", "T_world_camera": pose.tolist()}
    with running({"camera": {"kind": "opencv", "id": "wall", "config": film, "poses": poses}}) as camera:
        camera.until_end()
    frames = camera.frames()
    assert [f.seq for f in frames] == list(range(COUNT))
    assert all((f.camera_id, f.pose_source, f.pose_sigma) == ("wall", "fixed", 0.0) for f in frames)
    assert all(np.array_equal(f.T_world_camera, pose) for f in frames)


@pytest.mark.parametrize("restartable", [False, True])
def test_a_failure_of_what_restarts_ends_no_stream(
    film: dict[str, str], monkeypatch: pytest.MonkeyPatch, restartable: bool
) -> None:
    poses = {"kind": "device"}  # a video gives no pose of its own
    monkeypatch.setattr(live_camera, "check_world", lambda *_: None)
    options = {"camera": {"kind": "opencv", "config": film, "poses": poses}}
    with running(options, restartable=restartable, fails=True) as camera:
        camera.until(lambda m: isinstance(m, EndOfStream) or (isinstance(m, Status) and m.state == "ended"))
        ends = [m.reason for m in list(camera.heard) if isinstance(m, EndOfStream)]
    assert isinstance(camera.node.error, CameraError) and ends == ([] if restartable else ["error"])


def test_it_stays_when_the_camera_goes_says_so_and_goes_on_when_it_is_back(machine: Machine, tmp_path: Path) -> None:
    sensor = Sensor()
    with running(v4l2(machine.plug(sensor, 0), tmp_path)) as camera:
        before = camera.until(lambda m: isinstance(m, PosedFrame))
        machine.unplug(sensor)
        gone = camera.until_status(lambda s: s.state == "degraded")
        last_before = camera.frames()[-1].stamp_ns
        machine.plug(sensor, 4)
        back = camera.until(lambda m: isinstance(m, PosedFrame) and m.stamp_ns > last_before)
        well = camera.until_status(lambda s: s.state == "running" and s.stamp_ns > gone.stamp_ns)
        camera.node.stop.signum = 15
        end = camera.until_end()
    assert any("no such camera" in t or "gone" in t for t in gone.degraded) and gone.counters["published"] >= 1
    assert back.seq > before.seq + 1 and back.camera_id == "front"
    assert well.degraded == () and well.ages_s["frame"] < PATIENCE_S
    assert {"published", "missing", "no_pose"} <= set(well.counters)
    assert end.reason == "stopped" and end.published >= len(camera.frames())


def test_a_driver_that_hangs_is_told_apart_from_a_camera_that_is_waited_for(machine: Machine, tmp_path: Path) -> None:
    sensor, returns = Sensor(), threading.Event()
    beats, theirs = os.pipe()
    os.set_blocking(beats, False)

    def turns() -> bool:
        try:
            return TURN in os.read(beats, 65536)
        except BlockingIOError:
            return False

    def goes_on() -> bool:
        turns()  # those of before do not count
        return eventually(turns, 1.0)

    with running(v4l2(machine.by_id / "usb-HD_Webcam-video-index0", tmp_path, stall_s=1.0), beats=theirs) as camera:
        camera.until_status(lambda s: s.state == "starting" and bool(s.degraded))
        assert goes_on(), "it waits for a camera that has never been there"
        machine.plug(sensor, 0)
        camera.until(lambda m: isinstance(m, PosedFrame))
        assert goes_on()
        sensor.stalled = True
        camera.until_status(lambda s: s.state == "degraded")
        assert goes_on(), "nothing comes, but the driver says so"
        machine.unplug(sensor)
        camera.until_status(lambda s: any("no such camera" in t for t in s.degraded))
        assert goes_on(), "it waits for a camera that is away"
        sensor.stalled, sensor.hangs = False, returns
        machine.plug(sensor, 4)
        assert eventually(lambda: sensor.opens > 1 and not goes_on(), PATIENCE_S), "a read that never returns"
        assert camera.node.thread.is_alive()
        returns.set()
        assert goes_on()
    os.close(beats)
    os.close(theirs)


def test_patience_with_a_camera_can_be_limited(machine: Machine, tmp_path: Path) -> None:
    options = v4l2(machine.dev / "video0", tmp_path)
    options["camera"]["open_s"] = 0.3
    with running(options, fails=True) as camera:
        camera.node.wait(PATIENCE_S)
    assert isinstance(camera.node.error, CameraError) and "is it plugged in" in str(camera.node.error)


def test_options_name_a_log_or_a_camera_with_poses() -> None:
    camera = {"kind": "v4l2", "poses": {}}
    for options, says in (
        ({}, "either a log or a camera"),
        ({"log": "a.mcap", "camera": camera}, "either a log or a camera"),
        ({"camera": {"kind": "v4l2"}}, "poses"),
        ({"camera": camera | {"id": "a/b"}}, "camera.id"),
        ({"log": ""}, "log"),
    ):
        with pytest.raises(ConfigError, match=says):
            convert_config(options, CameraOptions, "test")
