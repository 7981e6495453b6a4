"""What Zenoh's own clients receive of a robot, and who may be one."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh
from structlog.testing import capture_logs

from semantic_mapper.errors import ConfigError, TransportError
from semantic_mapper.nodes.bridge.packing import POINT
from semantic_mapper.nodes.options import ZenohOptions
from semantic_mapper.nodes.zenoh.addresses import zenoh_settings
from semantic_mapper.nodes.zenoh.node import run_zenoh
from semantic_mapper.nodes.zenoh.session import ZenohSession
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.transport.messages import Status
from tests.nodes.bridge.robot import REFRESH_S, WARM_S, Robot, big_frame, bridged_robot
from tests.nodes.support import eventually, free_port
from tests.queries.scene import LABELS, whole
from tests.small import tiny_frames

HOWTO = Path(__file__).resolve().parents[3] / "docs" / "howto.md"


@contextmanager
def session(address: str, **settings: Any) -> Iterator[zenoh.Session]:
    """A client of Zenoh that knows one address and looks for nobody else."""
    config = zenoh.Config()
    known = {"mode": "client", "connect/endpoints": [address], "scouting/multicast/enabled": False}
    for key, value in {**known, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as opened:
        yield opened


@pytest.fixture
def address() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def robot(address: str) -> Iterator[Robot]:
    options = ZenohOptions(listen=address, refresh_s=REFRESH_S, prefix="lab/robot")
    with bridged_robot(run_zenoh, options, "zenoh") as robot:
        yield robot


class Heard:
    """The newest sample of each key; the callback of a subscriber."""

    def __init__(self) -> None:
        self.samples: dict[str, zenoh.Sample] = {}
        self._lock = threading.Lock()

    def __call__(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self.samples[str(sample.key_expr)] = sample


def attached(sample: zenoh.Sample) -> dict[str, Any]:
    assert sample.attachment is not None
    return json.loads(sample.attachment.to_bytes())


def test_a_session_that_has_ended_is_one_clear_error(address: str) -> None:
    with ZenohSession(ZenohOptions(listen=address)) as outlet:
        outlet._session.close()
        status = Status("mapper", "running", 1)
        for send in (lambda: outlet.wants("frame", "eye"), lambda: outlet.send_status(status)):
            with pytest.raises(TransportError, match="Zenoh sends nothing any more: session closed"):
                send()


def test_a_session_that_cannot_be_closed_is_one_line(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Session:
        """Of Zenoh, whose router has gone."""

        def close(self) -> None:
            opened.close()
            raise zenoh.ZError("no answer")

    with capture_logs() as told, ZenohSession(ZenohOptions(listen=address)) as outlet:
        opened = outlet._session
        monkeypatch.setattr(outlet, "_session", Session())
    assert [(entry["event"], entry["reason"]) for entry in told] == [("session_not_closed", "no answer")]


def test_images_poses_map_graph_and_status_arrive(robot: Robot, address: str) -> None:
    frame, heard = tiny_frames()[2], Heard()
    camera = f"lab/robot/{frame.camera_id}"
    keys = {f"{camera}/{kind}" for kind in ("rgb", "depth", "semantics", "moving", "pose")}
    keys |= {"lab/robot/map/points", "lab/robot/graph", "lab/robot/status/mapper", "lab/robot/status/zenoh"}
    with robot.mapped(), session(address) as client:
        client.declare_subscriber("lab/robot/**", heard)

        def step() -> bool:
            robot.publish(2)
            return keys <= set(heard.samples)

        assert eventually(step, WARM_S), keys - set(heard.samples)
    found = heard.samples
    assert set(found) == keys

    pose = json.loads(found[f"{camera}/pose"].payload.to_bytes())
    assert pose["T_map_camera"] == frame.T_world_camera.tolist() and pose["intrinsics"]["fx"] == 66.0
    image = found[f"{camera}/rgb"]
    assert image.encoding == zenoh.Encoding.IMAGE_JPEG and attached(image) == pose
    shown = cv2.imdecode(np.frombuffer(image.payload.to_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(cv2.cvtColor(shown, cv2.COLOR_BGR2RGB).astype(int) - frame.rgb).mean() < 8
    depth = np.frombuffer(found[f"{camera}/depth"].payload.to_bytes(), "<f4")
    assert frame.depth_m is not None and depth.tobytes() == frame.depth_m.tobytes()
    ids = cv2.imdecode(np.frombuffer(found[f"{camera}/semantics"].payload.to_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert ids.shape == frame.rgb.shape[:2] and (ids == LABELS.ids[1]).all()

    mask = cv2.imdecode(np.frombuffer(found[f"{camera}/moving"].payload.to_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert (mask[:2] == 255).all() and not mask[2:].any()

    cloud = found["lab/robot/map/points"]
    about, points = attached(cloud), np.frombuffer(cloud.payload.to_bytes(), POINT)
    expected = surface_points(whole(), surface_voxels(whole()))
    assert about["points"] == len(points) == len(expected.xyz) and about["every_nth"] == 1
    np.testing.assert_array_equal(np.stack([points[axis] for axis in "xyz"], 1), expected.xyz)
    np.testing.assert_array_equal(points["red"], expected.rgb[:, 0])
    names = {one["id"]: one["name"] for one in about["classes"]}
    assert {names.get(i) for i in np.unique(points["label"])} >= {"floor", "table", "cup"}
    graph = json.loads(found["lab/robot/graph"].payload.to_bytes())
    assert [thing["id"] for thing in graph["objects"]] == [thing.id for thing in GraphTracker().update(whole()).things]
    status = json.loads(found["lab/robot/status/mapper"].payload.to_bytes())
    assert status["counters"] == {"fused": 2, "moving": 7}


def test_who_asks_for_the_map_gets_it_without_a_subscription(robot: Robot, address: str) -> None:
    with robot.mapped(), session(address) as client:
        for selector, key in (("lab/robot/map/points", "lab/robot/map/points"), ("lab/robot/*", "lab/robot/graph")):
            [reply] = client.get(selector, timeout=WARM_S)
            assert reply.ok is not None and str(reply.ok.key_expr) == key and len(reply.ok.payload) > 100


def test_a_client_that_stands_still_loses_images(address: str) -> None:
    frame, count = big_frame(), 60
    with ZenohSession(ZenohOptions(listen=address)) as bridge, session(address) as client:
        came, go_on = list[int](), threading.Event()

        def stand_still(sample: zenoh.Sample) -> None:
            came.append(attached(sample)["seq"])
            go_on.wait(60)

        direct = zenoh.handlers.Callback(stand_still, indirect=False)  # else the client itself keeps all
        client.declare_subscriber("semantic_mapper/*/depth", direct)
        assert eventually(lambda: bridge.wants("frame", frame.camera_id), 20)
        for number in range(count):
            bridge.send_frame(dataclasses.replace(frame, seq=number), None)  # 4 MB each
        go_on.set()

        def receives_again() -> bool:
            bridge.send_frame(dataclasses.replace(frame, seq=count), None)
            return came[-1] == count

        assert eventually(receives_again, 20)
        assert len(set(came)) < count // 2


def test_it_joins_the_network_of_a_router_that_comes_later(address: str) -> None:
    with ZenohSession(ZenohOptions(listen="", connect=address)) as bridge:
        settings = {"mode": "router", "connect/endpoints": [], "listen/endpoints": [address]}
        with session(address, **settings), session(address) as client:
            heard = Heard()
            client.declare_subscriber("semantic_mapper/rooms/pose", heard)
            assert eventually(lambda: bridge.wants("frame", "rooms"), 20)
            bridge.send_frame(tiny_frames()[0], np.eye(4))
            assert eventually(lambda: bool(heard.samples), 20)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"listen": "7447"}, ConfigError, "no address of Zenoh.*tcp/127.0.0.1:PORT"),
        ({"listen": "udp/127.0.0.1:7447"}, ConfigError, "no address of Zenoh"),
        ({"listen": "tcp/127.0.0.1:7447#iface=eth0"}, ConfigError, "no address of Zenoh"),
        ({"listen": "tcp/0.0.0.0:7447"}, TransportError, "certificates on both sides.*tls/0.0.0.0:7447"),
        ({"listen": "tcp/[::]:7447"}, TransportError, "certificates on both sides"),
        ({"connect": "tcp/robot:7447"}, TransportError, "certificates on both sides.*ssh -L"),
        ({"listen": "tls/0.0.0.0:7447"}, TransportError, "needs a folder with ca.pem, own.pem and own.key"),
        ({"listen": "tls/0.0.0.0:7447", "certificates": "/nowhere"}, TransportError, "/nowhere/ca.pem: no such file"),
    ],
)
def test_what_other_machines_could_reach_needs_certificates(
    options: dict[str, str], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        zenoh_settings(ZenohOptions(**options))


def test_an_address_that_is_taken_is_named(address: str) -> None:
    options = ZenohOptions(listen=address)
    with ZenohSession(options), pytest.raises(TransportError, match=f"Zenoh cannot use {address}.*another address"):
        ZenohSession(options)


def make_certificates(folder: Path) -> None:
    """As docs/howto.md says, for the machines robot and desk."""
    text = HOWTO.read_text(encoding="utf-8")
    script = text.split("<!-- certificates -->\n```sh\n")[1].split("```")[0]
    subprocess.run(["bash", "-euc", script], cwd=folder, check=True, capture_output=True)


def test_with_certificates_a_machine_that_was_signed_enters_and_no_other(tmp_path: Path) -> None:
    signed, other = tmp_path / "signed", tmp_path / "other"
    for folder in (signed, other):
        folder.mkdir()
        make_certificates(folder)
    address = f"tls/127.0.0.1:{free_port()}"
    options = ZenohOptions(listen=address, certificates=str(signed / "robot"))
    with ZenohSession(options) as bridge:
        assert not bridge.wants("frame", "rooms")
        with pytest.raises(zenoh.ZError), session(address, **desk(other, signed)):
            pass
        with session(address, **desk(signed, signed)) as client:
            client.declare_subscriber("semantic_mapper/rooms/rgb", lambda sample: None)
            assert eventually(lambda: bridge.wants("frame", "rooms"), 20)
    (signed / "robot" / "own.key").chmod(0o644)
    with pytest.raises(TransportError, match="others can read the secret key"):
        zenoh_settings(options)


def desk(own: Path, trusted: Path) -> dict[str, Any]:
    """Settings of the other machine; its own certificate may be one that nobody signed whom the robot trusts."""
    tls = {"root_ca_certificate": str(trusted / "desk" / "ca.pem"), "enable_mtls": True}
    tls |= {"connect_certificate": str(own / "desk" / "own.pem"), "connect_private_key": str(own / "desk" / "own.key")}
    settings: dict[str, Any] = {f"transport/link/tls/{name}": value for name, value in tls.items()}
    return settings | {"connect/timeout_ms": 2000}
