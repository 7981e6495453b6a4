"""What Foxglove receives of a robot, read with Foxglove's own classes."""

import dataclasses
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.foxglove.server import BACKLOG, FoxgloveServer
from semantic_mapper.nodes.options import FoxgloveOptions
from semantic_mapper.plots import class_colors
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.transport.keys import allow, make_keys
from tests.nodes.foxglove.client import FoxgloveClient, Received
from tests.nodes.foxglove.robot import REFRESH_S, WARM_S, Robot, big_frame, bridged_robot
from tests.nodes.support import eventually, free_port
from tests.queries.scene import LABELS, whole
from tests.small import tiny_frames

NUMBERS = {PackedElementField.FLOAT32: "<f4", PackedElementField.UINT8: "u1"}


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def robot(port: int) -> Iterator[Robot]:
    with bridged_robot(FoxgloveOptions(port=port, refresh_s=REFRESH_S)) as robot:
        yield robot


def gather(client: FoxgloveClient, robot: Robot | None, wanted: set[str]) -> dict[str, Received]:
    """The newest message of each topic, once all have come; frames are published meanwhile."""
    found: dict[str, Received] = {}

    def step() -> bool:
        if robot is not None:
            robot.publish(2)
        while (message := client.receive(0.05)) is not None:
            found[message.topic] = message
        return wanted <= set(found)

    assert eventually(step, WARM_S), f"no {wanted - set(found)}"
    return found


def test_a_client_that_was_too_quick_for_the_sdk_receives_a_new_camera_all_the_same(port: int) -> None:
    frame = tiny_frames(1)[0]
    with FoxgloveServer(port) as server, FoxgloveClient(server.url) as client:
        client.receive(0.2)
        client.ask_ahead()  # for its pictures
        client.receive(0.2)

        def came() -> bool:
            server.send_frame(frame, None)
            received = client.receive(0.05)
            return received is not None and received.topic == f"/{frame.camera_id}/rgb"

        assert eventually(came, WARM_S)


def read_picture(received: Received, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    picture = CompressedImage.FromString(received.data)
    assert picture.timestamp.ToNanoseconds() == received.log_time_ns
    image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), flags)
    return image[..., ::-1] if flags == cv2.IMREAD_COLOR else image


def read_cloud(received: Received) -> np.ndarray:
    cloud = PointCloud.FromString(received.data)
    assert cloud.frame_id == "world" and cloud.pose.orientation.w == 1
    form = {
        "names": [field.name for field in cloud.fields],
        "formats": [NUMBERS[field.type] for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_stride,
    }
    return np.frombuffer(cloud.data, np.dtype(form))


def test_images_poses_map_graph_and_status_arrive(robot: Robot, port: int) -> None:
    frame = tiny_frames()[2]
    camera = f"/{frame.camera_id}"
    wanted = {"/tf", "/path", "/map/classes", "/map/colors", "/map/info", "/graph", "/status"}
    wanted |= {f"{camera}/{kind}" for kind in ("rgb", "depth", "semantics", "moving", "calibration")}
    with robot.mapped() as service, FoxgloveClient(f"ws://127.0.0.1:{port}") as client:
        found = gather(client, robot, wanted)
        assert service.alive
    assert all(message.log_time_ns == frame.stamp_ns for message in found.values())

    assert np.abs(read_picture(found[f"{camera}/rgb"]).astype(int) - frame.rgb).mean() < 8
    assert (read_picture(found[f"{camera}/semantics"]) == LABELS.colors[1]).all()
    mask = read_picture(found[f"{camera}/moving"], cv2.IMREAD_UNCHANGED)
    assert (mask[:2] == 255).all() and not mask[2:].any()
    depth = RawImage.FromString(found[f"{camera}/depth"].data)
    assert depth.encoding == "32FC1" and depth.frame_id == f"camera{camera}"
    np.testing.assert_array_equal(np.frombuffer(depth.data, "<f4").reshape(depth.height, -1), frame.depth_m)
    lens = CameraCalibration.FromString(found[f"{camera}/calibration"].data)
    assert (lens.K[0], lens.K[2], lens.K[5], lens.width) == (66.0, 47.5, 35.5, 96)

    moved = FrameTransforms.FromString(found["/tf"].data).transforms[0]
    assert (moved.parent_frame_id, moved.child_frame_id) == ("world", f"camera{camera}")
    q = moved.rotation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), frame.T_world_camera[:3, :3])
    expected = surface_points(whole(), surface_voxels(whole()))
    for topic, rgb in (("/map/colors", expected.rgb), ("/map/classes", class_colors(expected.label, LABELS))):
        cloud = read_cloud(found[topic])
        np.testing.assert_array_equal(np.stack([cloud[axis] for axis in "xyz"], 1), expected.xyz)
        np.testing.assert_array_equal(np.stack([cloud[c] for c in ("red", "green", "blue")], 1), rgb)
        np.testing.assert_array_equal(cloud["label"], expected.label)
    info = json.loads(found["/map/info"].data)
    assert info["points"] == len(expected.xyz)
    assert {"id": 9, "name": "cup", "color": list(LABELS.colors[2])} in info["classes"]

    drawn = SceneUpdate.FromString(found["/graph"].data)
    boxes = {entity.id for entity in drawn.entities if entity.cubes}
    assert boxes == {f"thing/{thing.id}" for thing in GraphTracker().update(whole()).things} and drawn.deletions
    status = json.loads(found["/status"].data)
    assert status["node"] == "mapper" and status["counters"]["moving"] == 7


def test_a_camera_of_another_world_is_shown_once_its_place_in_the_map_is_known(robot: Robot, port: int) -> None:
    robot.world, robot.T_map_world = 7, None
    topics = {"/tf", f"/{tiny_frames()[2].camera_id}/rgb"}
    with FoxgloveClient(f"ws://127.0.0.1:{port}", topics) as client:
        gather(client, robot, topics - {"/tf"})
        robot.publish(2)
        while (message := client.receive(4 * REFRESH_S)) is not None:
            assert message.topic != "/tf"
        robot.T_map_world = T = np.eye(4)
        T[:3, 3] = 5.0, -3.0, 0.7
        found = gather(client, robot, {"/tf"})
    at = FrameTransforms.FromString(found["/tf"].data).transforms[0].translation
    np.testing.assert_allclose([at.x, at.y, at.z], tiny_frames()[2].T_world_camera[:3, 3] + T[:3, 3])


def test_a_late_client_receives_the_map_that_does_not_change_and_so_after_a_restart(robot: Robot, port: int) -> None:
    url, topics = f"ws://127.0.0.1:{port}", {"/map/classes"}
    with robot.mapped() as service:
        robot.publish(0)
        assert eventually(lambda: service.answered > 0, WARM_S)
        asked = service.answered
        for number in (1, 2, 3):
            robot.publish(number)
        assert not eventually(lambda: service.answered > asked, 4 * REFRESH_S), "nobody listens, and nothing is fetched"
        for _ in range(2):
            with FoxgloveClient(url, topics) as client:
                assert len(read_cloud(gather(client, None, topics)["/map/classes"]))
                assert all(client.receive(REFRESH_S) is None for _ in range(4)), "the same map is not sent again"
    with FoxgloveClient(url, topics) as client:
        assert all(client.receive(REFRESH_S) is None for _ in range(4)) and robot.bridge.error is None, (
            "the mapper is away"
        )
        with robot.mapped():
            gather(client, None, topics)


def test_a_mapper_with_keys_answers_who_has_the_same(port: int, tmp_path: Path) -> None:
    robot_keys, desk = make_keys(tmp_path / "robot"), make_keys(tmp_path / "desk")
    allow(robot_keys.folder, "desk", desk.public.decode())
    options = FoxgloveOptions(port=port, refresh_s=REFRESH_S, keys=str(robot_keys.folder))
    with (
        bridged_robot(options) as robot,
        robot.mapped(robot_keys),
        FoxgloveClient(f"ws://127.0.0.1:{port}", {"/map/info"}) as client,
    ):
        found = gather(client, None, {"/map/info"})
    info = json.loads(found["/map/info"].data)
    assert info["points"] == len(surface_points(whole(), surface_voxels(whole())).xyz)


def test_it_ends_with_the_stream_and_lets_the_camera_go(port: int) -> None:
    with bridged_robot(FoxgloveOptions(port=port, refresh_s=REFRESH_S)) as robot:
        robot.end()
        assert eventually(lambda: not robot.camera.subscribers("frame"), 20)
        robot.bridge.wait(20)


def test_a_client_that_does_not_keep_up_loses_the_oldest(port: int) -> None:
    frame, count = big_frame(), 150
    topics = {f"/{frame.camera_id}/depth"}
    with FoxgloveServer(port) as server, FoxgloveClient(server.url, topics) as client:
        assert not server.wants("frame", frame.camera_id)
        assert eventually(lambda: client.receive(0.05) is None and server.wants("frame", frame.camera_id), 20)
        for number in range(count):
            server.send_frame(dataclasses.replace(frame, stamp_ns=number), None)  # 4 MB each, and nobody reads them
        came: list[int] = []
        while (message := client.receive(2.0)) is not None:
            came.append(message.log_time_ns)
    assert came == sorted(came) and came[-1] == count - 1 and BACKLOG <= len(came) < count // 2


def test_it_listens_on_this_machine_alone_and_names_a_port_that_is_taken() -> None:
    with FoxgloveServer(0) as server, socket.socket() as other:
        port = int(server.url.rpartition(":")[2])
        other.bind(("127.0.0.2", port))  # would be taken, too, if it listened on all addresses
        assert server.url == f"ws://127.0.0.1:{port}"
        with pytest.raises(TransportError, match=f"port {port} cannot be had.*give another one"):
            FoxgloveServer(port)
