import json
import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq

from semantic_mapper.drivers.poses import topic
from semantic_mapper.drivers.poses.config import TopicPoses
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.errors import CameraError
from semantic_mapper.transport.keys import allow, make_keys, secure_server
from semantic_mapper.transport.pose_message import PoseMessage, encode_pose
from tests.drivers.support import PATIENCE_S, until

from .images import MS, image, rigid


class Robot:
    """A publisher of poses: along x at 1 m/s, turning about z at 1 rad/s."""

    def __init__(self, endpoint: str) -> None:
        self.socket = zmq.Context.instance().socket(zmq.XPUB)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(endpoint)

    def wait(self) -> None:
        """Until somebody has subscribed; others may have left before."""
        while True:
            assert self.socket.poll(int(PATIENCE_S * 1e3)), "nobody subscribed"
            if self.socket.recv()[:1] == b"\x01":
                return

    def send(self, ms: int, **changes: object) -> None:
        t = ms / 1e3
        fields = {
            "stamp_ns": ms * MS,
            "position": (t, 0.0, 0.0),
            "quaternion": (0.0, 0.0, math.sin(t / 2), math.cos(t / 2)),
            "sigma": 0.02,
        }
        self.socket.send_multipart(encode_pose(PoseMessage(**{**fields, **changes})))


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="sm-") as folder:
        yield f"ipc://{Path(folder) / 'socket'}"


@pytest.fixture
def robot(endpoint: str) -> Iterator[Robot]:
    made = Robot(endpoint)
    yield made
    made.socket.close(linger=0)


@contextmanager
def listening(endpoint: str, robot: Robot, **settings: Any) -> Iterator[TopicPoseSource]:
    # Waiting is generous: what a test expects to come has been sent.
    wait_s = settings.pop("wait_s", PATIENCE_S)
    with TopicPoseSource(TopicPoses(endpoint=endpoint, **settings), wait_s) as source:
        robot.wait()
        yield source


def test_an_image_gets_the_pose_at_its_stamp_of_where_the_camera_sits(endpoint: str, robot: Robot) -> None:
    T_base_camera = rigid((0.1, 0.2, -0.3), (0.2, 0.0, 0.5))
    settings = {"T_base_camera": T_base_camera.tolist(), "clock_offset_ns": -4000 * MS}
    with listening(endpoint, robot, **settings) as source:
        for ms in range(1000, 1201, 20):
            robot.send(ms, stamp_ns=(ms + 4000) * MS)
        found = source.pose(image(1111 * MS))
        assert found is not None
        base = rigid((0, 0, 1.111), (1.111, 0, 0))
        assert np.allclose(found.T_world_camera, base @ T_base_camera, atol=1e-9)
        assert found.source == "topic" and found.sigma == pytest.approx(0.02)
        until(lambda: source.counters["messages"] == 11)
        assert source.warnings == ()


def test_beyond_the_last_pose_the_motion_goes_on_for_a_while_and_no_longer(endpoint: str, robot: Robot) -> None:
    with listening(endpoint, robot, wait_s=0.0) as source:
        robot.send(1000)
        robot.send(1020)
        until(lambda: source.counters["messages"] == 2)
        found = source.pose(image(1060 * MS))
        assert found is not None and found.T_world_camera[0, 3] == pytest.approx(1.06)
        assert found.sigma > 0.02  # a guess is less sure
        assert source.pose(image(1071 * MS)) is None and source.counters["stale"] == 1
        assert "0.051 s older" in source.warnings[0] and "clock_offset_ns" in source.warnings[0]
        robot.send(1080)
        robot.send(1400)
        until(lambda: source.counters["messages"] == 4)
        assert source.pose(image(1075 * MS)) is not None and source.warnings == ()
        for ms in (999, 1300, 1401):  # before all, between poses that are too far apart, and no motion shown
            assert source.pose(image(ms * MS)) is None
        assert (source.counters["before"], source.counters["gap"], source.counters["stale"]) == (1, 1, 2)


@pytest.fixture
def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is 10 s on this machine's clock, and stays so."""
    clock = SimpleNamespace(monotonic=time.monotonic, monotonic_ns=lambda: 10_000 * MS)
    monkeypatch.setattr(topic, "time", clock)


@pytest.mark.usefixtures("stopped_clock")
def test_poses_of_another_clock_are_left_out(endpoint: str, robot: Robot) -> None:
    with listening(endpoint, robot, wait_s=0.0) as source:
        robot.send(10_051)  # 50 ms ahead may be a prediction
        until(lambda: source.counters["future"] == 1)
        assert source.pose(image(10_000 * MS)) is None
        ahead, empty = source.warnings
        assert "it is stamped 0.051 s ahead" in ahead and "clock_offset_ns" in ahead
        assert "no pose that can be used" in empty
        for ms in range(9800, 10_051, 25):
            robot.send(ms)
            robot.send(ms - 3000)  # a second publisher, on a clock that is behind
            robot.send(ms + 3_600_000)
        until(lambda: source.counters["future"] == 12)
        assert source.counters["messages"] == source.counters["out_of_order"] == 11
        found = source.pose(image(9860 * MS))
        assert found is not None and found.T_world_camera[0, 3] == pytest.approx(9.86)


def test_what_is_no_pose_costs_itself_only(endpoint: str, robot: Robot) -> None:
    with listening(endpoint, robot) as source:
        robot.socket.send(b"garbage")
        robot.socket.send_multipart([b"pose", *[b"{}"] * 5000])
        robot.socket.send(b"x" * 100_000)
        robot.send(1000)
        robot.send(1000)
        message = {"v": 1, "stamp_ns": 1040 * MS, "position": [1.04, 0, 0], "quaternion": [0, 0, 0, 1]}
        robot.socket.send(json.dumps(message).encode())
        found = source.pose(image(1020 * MS))
        assert found is not None and found.T_world_camera[0, 3] == pytest.approx(1.02)
        assert source.counters == {"rejected": 3, "out_of_order": 1, "messages": 2}


def test_silence_and_what_is_no_endpoint_are_reported(endpoint: str) -> None:
    with TopicPoseSource(TopicPoses(endpoint=endpoint), 0.01) as source:
        assert source.pose(image(5)) is None
        assert source.counters["empty"] == 1 and "is its publisher running" in source.warnings[0]
    with pytest.raises(CameraError, match="endpoints read"), TopicPoseSource(TopicPoses(endpoint="robot:5000")):
        pass


def test_a_robot_with_keys_is_listened_to_and_one_in_its_place_is_not(tmp_path: Path) -> None:
    robot, thief, desk = (make_keys(tmp_path / name) for name in ("robot", "thief", "desk"))
    allow(desk.folder, "robot", robot.public.decode())
    for server in (robot, thief):
        allow(server.folder, "desk", desk.public.decode())
    for keys, heard in ((thief, 0), (None, 0), (robot, 1)):
        socket = zmq.Context.instance().socket(zmq.XPUB)
        socket.setsockopt(zmq.LINGER, 0)
        if keys is not None:
            secure_server(socket, keys)
        port = socket.bind_to_random_port("tcp://127.0.0.1")
        settings = TopicPoses(endpoint=f"tcp://127.0.0.1:{port}", server="robot", keys=str(desk.folder))
        with socket, TopicPoseSource(settings) as source:
            assert bool(socket.poll(int(PATIENCE_S * 1e3) if heard else 300)) == bool(heard)
            if heard:
                message = PoseMessage(stamp_ns=5, position=(0, 0, 0), quaternion=(0, 0, 0, 1))
                socket.send_multipart(encode_pose(message))
                until(lambda: source.counters["messages"] == 1)
