"""Real ROS bags of both versions, written by ``rosbags`` from frames of a rendered room."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from semantic_mapper.types import CameraIntrinsics, PosedFrame

Kind = Literal["ros1", "sqlite3", "mcap"]
START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 100_000_000
CAMERA = "camera_color_optical_frame"
COLOR, DEPTH, INFO = "/cam/color/image_raw", "/cam/aligned_depth_to_color/image_raw", "/cam/color/camera_info"
DEPTH_INFO = "/cam/aligned_depth_to_color/camera_info"

_ROS1, _ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))

# What happens in a bag: topic (and, behind "@", the node of ROS 1 that publishes it), time, message.
Event = tuple[str, int, Any]


class Messages:
    """Makes messages of one version of ROS."""

    def __init__(self, kind: Kind) -> None:
        self.store = _ROS1 if kind == "ros1" else _ROS2
        self.ros1 = kind == "ros1"

    def make(self, name: str, *values: object) -> Any:
        return self.store.types[name.replace("/", "/msg/")](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("std_msgs/Header", *((0,) if self.ros1 else ()), stamp, frame)

    def image(self, stamp_ns: int, frame: str, pixels: np.ndarray, encoding: str, padding: int = 0) -> Any:
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        header = self.header(stamp_ns, frame)
        big = int(pixels.dtype.byteorder == ">")
        return self.make("sensor_msgs/Image", header, height, width, encoding, big, rows.shape[1], rows.ravel())

    def compressed(self, stamp_ns: int, frame: str, format_: str, data: bytes) -> Any:
        return self.make(
            "sensor_msgs/CompressedImage", self.header(stamp_ns, frame), format_, np.frombuffer(data, np.uint8)
        )

    def info(
        self, stamp_ns: int, frame: str, k: CameraIntrinsics, model: str = "plumb_bob", lens: Sequence[float] = (0,) * 5
    ) -> Any:
        K = np.array((k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1), np.float64)
        P = np.array((k.fx, 0, k.cx, 0, 0, k.fy, k.cy, 0, 0, 0, 1, 0), np.float64)
        roi = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        head, lens_of = self.header(stamp_ns, frame), np.array(lens, np.float64)
        values = head, k.height, k.width, model, lens_of, K, np.eye(3).ravel(), P, 0, 0, roi
        return self.make("sensor_msgs/CameraInfo", *values)

    def transform(self, T: np.ndarray) -> Any:
        return self._at("Transform", "Vector3", T)

    def pose(self, T: np.ndarray) -> Any:
        return self._at("Pose", "Point", T)

    def _at(self, kind: str, place: str, T: np.ndarray) -> Any:
        rotation = self.make("geometry_msgs/Quaternion", *Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
        return self.make(f"geometry_msgs/{kind}", self.make(f"geometry_msgs/{place}", *T[:3, 3].tolist()), rotation)

    def tf(self, stamp_ns: int, parent: str, child: str, T_parent_child: np.ndarray) -> Any:
        stamped = self.make(
            "geometry_msgs/TransformStamped", self.header(stamp_ns, parent), child, self.transform(T_parent_child)
        )
        return self.make("tf2_msgs/TFMessage", [stamped])

    def odometry(self, stamp_ns: int, T_odom_body: np.ndarray, body: str) -> Any:
        zero = self.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        twist = self.make(
            "geometry_msgs/TwistWithCovariance", self.make("geometry_msgs/Twist", zero, zero), np.zeros(36)
        )
        pose = self.make("geometry_msgs/PoseWithCovariance", self.pose(T_odom_body), np.zeros(36))
        return self.make("nav_msgs/Odometry", self.header(stamp_ns, "odom"), body, pose, twist)

    def pose_stamped(self, stamp_ns: int, T: np.ndarray) -> Any:
        return self.make("geometry_msgs/PoseStamped", self.header(stamp_ns, "map"), self.pose(T))


def stamp_of(number: int) -> int:
    return START_NS + number * PERIOD_NS


def camera_on_base() -> np.ndarray:
    """Where the camera sits on the robot: forward and up, its axes turned as optical frames are."""
    T = np.eye(4)
    T[:3, :3] = ((0, 0, 1), (-1, 0, 0), (0, -1, 0))
    T[:3, 3] = (0.2, 0.05, 0.9)
    return T


def odom_in_map() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    T[:3, 3] = (1.0, -2.0, 0.0)
    return T


def bodies(frames: Sequence[PosedFrame]) -> list[np.ndarray]:
    """T_odom_base of each frame."""
    down = np.linalg.inv(camera_on_base())
    return [np.linalg.inv(odom_in_map()) @ frame.T_world_camera @ down for frame in frames]


def room_events(m: Messages, frames: Sequence[PosedFrame]) -> list[Event]:
    """Colour, registered depth, calibration, and tf over map, odom, base and camera; a robot's usual bag."""
    k = frames[0].intrinsics
    events: list[Event] = [("/tf_static", START_NS, m.tf(START_NS, "base_link", CAMERA, camera_on_base()))]
    for n, (frame, T_odom_base) in enumerate(zip(frames, bodies(frames), strict=True)):
        ns = stamp_of(n)
        assert frame.depth_m is not None
        events += [
            ("/tf", ns, m.tf(ns, "odom", "base_link", T_odom_base)),
            ("/tf", ns, m.tf(ns, "map", "odom", odom_in_map())),
            (INFO, ns, m.info(ns, CAMERA, k)),
            (COLOR, ns + 5_000_000, m.image(ns, CAMERA, frame.rgb, "rgb8")),
            (DEPTH, ns + 9_000_000, m.image(ns, CAMERA, millimetres(frame), "16UC1")),
            (DEPTH_INFO, ns, m.info(ns, CAMERA, k)),
        ]
    return events


def millimetres(frame: PosedFrame) -> np.ndarray:
    assert frame.depth_m is not None
    return np.rint(frame.depth_m * 1000).astype(np.uint16)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def compressed_depth(image: np.ndarray) -> bytes:
    """As image_transport writes 16UC1: a head that says nothing, and a PNG."""
    return struct.pack("<iff", 0, 0.0, 0.0) + png(image)


def write_bag(path: Path, kind: Kind, events: Sequence[Event]) -> Path:
    """Write a bag; returns what a user would name: the .bag file, or the folder."""
    store = _ROS1 if kind == "ros1" else _ROS2
    serialize: Callable[[Any, str], Any]
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        serialize = store.serialize_ros1  # type: ignore[assignment]
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        serialize = store.serialize_cdr  # type: ignore[assignment]
    connections: dict[str, Any] = {}
    with writer:
        for topic, received_ns, message in sorted(events, key=lambda event: event[1]):
            name = message.__msgtype__
            if topic not in connections:
                bare, _, node = topic.partition("@")
                of_node = {"callerid": node} if node else {}
                connections[topic] = writer.add_connection(bare, name, typestore=store, **of_node)
            writer.write(connections[topic], received_ns, serialize(message, name))
    return path
