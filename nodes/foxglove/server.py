"""A Foxglove websocket on this machine: what a launch publishes, as Foxglove's own message types.

A client that does not keep up loses the oldest of what waits for it. What nobody subscribes to is not even encoded.
On import, raises DependencyError: the extra is not installed.
"""

import logging
import re
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from semantic_mapper.errors import DependencyError, TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.nodes.map_feed import POINT, pack_points
from semantic_mapper.plots import CHANGE_COLORS, class_colors
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.queries.instances import Instance
from semantic_mapper.queries.objects import ObjectChange
from semantic_mapper.replay.exporters.base import CameraPath, quaternion
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.transport.messages import Status
from semantic_mapper.types import CameraIntrinsics, Float64, MapUpdate, PosedFrame, UInt8

try:
    import foxglove
    from foxglove import channels, messages
except ModuleNotFoundError as error:
    raise DependencyError(
        "nodes of kind 'foxglove' need the package foxglove-sdk: pip install 'semantic-mapper[foxglove]'"
    ) from error

HOST = "127.0.0.1"  # the protocol has neither keys nor passwords: other machines come in by `ssh -L`
BACKLOG = 32  # messages that may wait for a client; of a map of 400,000 points each has 8 MB
MAX_REFUSED = 64  # channels that are remembered: a client may ask for any number
_SDK = "foxglove.websocket.connected_client"  # its logger
SETTLE_S = 0.05  # after the SDK has said so, until what is sent reaches who has subscribed
JPEG_QUALITY = 80
PATH_PERIOD_S = 1.0  # a long path takes milliseconds to draw
WORLD = "world"  # that of the map
TEXT_M = 0.12  # height of letters
LINE_M = 0.03
PATH_COLOR = messages.Color(r=1.0, g=0.85, b=0.2, a=1.0)
ROOM_COLOR = messages.Color(r=0.9, g=0.9, b=0.95, a=1.0)
DOOR_COLOR = messages.Color(r=1.0, g=0.5, b=0.1, a=1.0)
BOX_OPACITY = 0.35
_TEXT, _OBJECT = {"type": "string"}, {"type": "object"}
STATUS_SCHEMA = {
    "type": "object",
    "properties": {
        **{"node": _TEXT, "state": _TEXT, "stamp_ns": {"type": "integer"}, "counters": _OBJECT, "ages_s": _OBJECT},
        "degraded": {"type": "array", "items": _TEXT},
    },
}
Subject = Literal["map", "graph"]
_ORIGIN = messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0))
_TYPES = {"<f4": messages.PackedElementFieldNumericType.Float32, "|u1": messages.PackedElementFieldNumericType.Uint8}
_MAPS: dict[str, Subject] = {"/map/classes": "map", "/map/colors": "map", "/map/info": "map", "/graph": "graph"}


class _Camera:
    def __init__(self, camera_id: str, context: foxglove.Context, path: CameraPath) -> None:
        name = f"/{camera_id}"
        self.rgb = channels.CompressedImageChannel(f"{name}/rgb", context=context)
        self.depth = channels.RawImageChannel(f"{name}/depth", context=context)
        self.semantics = channels.CompressedImageChannel(f"{name}/semantics", context=context)
        self.moving = channels.CompressedImageChannel(f"{name}/moving", context=context)
        self.calibration = channels.CameraCalibrationChannel(f"{name}/calibration", context=context)
        self.all = (self.rgb, self.depth, self.semantics, self.moving, self.calibration)
        self.path = path


class FoxgloveServer(Closing):
    """Serves Foxglove; a context manager. Frames and status come from one thread, map and graph from another.

    ``port`` 0 = any that is free. Raises TransportError: the port is taken.
    """

    def __init__(self, port: int) -> None:
        context = foxglove.Context()
        self._context = context
        self._tf = channels.FrameTransformsChannel("/tf", context=context)
        self._path = channels.SceneUpdateChannel("/path", context=context)
        self._classes = channels.PointCloudChannel("/map/classes", context=context)
        self._colors = channels.PointCloudChannel("/map/colors", context=context)
        self._info = foxglove.Channel("/map/info", schema=_OBJECT, context=context)
        self._graph = channels.SceneUpdateChannel("/graph", context=context)
        self._status = foxglove.Channel("/status", schema=STATUS_SCHEMA, context=context)
        listener = _Listener()
        self.requests = listener.requests
        try:
            self._server = foxglove.start_server(
                name="semantic-mapper",
                host=HOST,
                port=port,
                context=context,
                server_listener=listener,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise TransportError(
                f"port {port} cannot be had ({error}); give another one as `port`, or 0 for any that is free"
            ) from error
        self._cameras: dict[str, _Camera] = {}
        self._refused = _Refused()
        logging.getLogger(_SDK).addHandler(self._refused)
        self._labels: LabelSet | None = None
        self._path_sent = 0.0

    @property
    def url(self) -> str:
        """What a client connects to."""
        return f"ws://{HOST}:{self._server.port}"

    def close(self) -> None:
        """Serve nobody any more."""
        self._server.stop()
        logging.getLogger(_SDK).removeHandler(self._refused)

    def send_labels(self, label_set: LabelSet) -> None:
        """The classes of the map, before anything that has classes."""
        self._labels = label_set

    def wants(self, topic: Literal["frame", "map"], camera_id: str) -> bool:
        """Whether anybody receives what messages of a camera on this topic hold: else they are not even decoded."""
        c = self._camera(camera_id)
        wanted = (c.rgb, c.depth, c.calibration, self._tf) if topic == "frame" else (c.semantics, c.moving, self._path)
        return any(channel.has_sinks() for channel in wanted)

    def note_pose(self, camera_id: str, T_map_camera: Float64) -> None:
        """Where a camera was in the map, of every frame of which that is known."""
        self._camera(camera_id).path.add(T_map_camera)

    def send_frame(self, frame: PosedFrame, T_map_camera: Float64 | None) -> None:
        """One camera image with its pose in the map; None while that is not known."""
        camera, when, name = self._camera(frame.camera_id), frame.stamp_ns, f"camera/{frame.camera_id}"
        if T_map_camera is not None and self._tf.has_sinks():
            position, rotation = _pose(T_map_camera[:3, :3], T_map_camera[:3, 3])
            places = {"parent_frame_id": WORLD, "child_frame_id": name, "translation": position, "rotation": rotation}
            moved = messages.FrameTransform(timestamp=_stamp(when), **places)
            self._tf.log(messages.FrameTransforms(transforms=[moved]), log_time=when)
        if camera.calibration.has_sinks():
            camera.calibration.log(_calibration(frame.intrinsics, name, when), log_time=when)
        if camera.rgb.has_sinks():
            picture = _encoded(".jpg", frame.rgb, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
            camera.rgb.log(_picture(picture, "jpeg", name, when), log_time=when)
        if camera.depth.has_sinks() and frame.depth_m is not None:
            height, width = frame.depth_m.shape
            form = {"width": width, "height": height, "encoding": "32FC1", "step": 4 * width}
            data = np.ascontiguousarray(frame.depth_m, "<f4").tobytes()
            camera.depth.log(messages.RawImage(timestamp=_stamp(when), frame_id=name, data=data, **form), log_time=when)

    def send_update(self, update: MapUpdate) -> None:
        """What was rendered for a frame."""
        camera, labels, when = self._camera(update.camera_id), self._labels, update.stamp_ns
        name = f"camera/{update.camera_id}"
        if labels is not None and camera.semantics.has_sinks():
            picture = _png(class_colors(update.label, labels))
            camera.semantics.log(_picture(picture, "png", name, when), log_time=when)
        if camera.moving.has_sinks():
            moving = np.zeros(update.label.shape, np.bool_) if update.moving is None else update.moving
            camera.moving.log(_picture(_png(moving * np.uint8(255)), "png", name, when), log_time=when)
        paths = {name: camera.path.poses for name, camera in self._cameras.items() if camera.path.poses}
        if paths and self._path.has_sinks() and time.monotonic() - self._path_sent > PATH_PERIOD_S:
            self._path_sent = time.monotonic()
            ways = {name: _line([T[:3, 3] for T in poses], PATH_COLOR, closed=False) for name, poses in paths.items()}
            drawn = [_entity(f"path/{name}", when, lines=[way]) for name, way in ways.items()]
            self._path.log(messages.SceneUpdate(entities=drawn), log_time=when)

    def send_status(self, status: Status) -> None:
        """What a node says of itself."""
        if self._status.has_sinks():
            self._status.log(msgspec.json.encode(status), log_time=status.stamp_ns)

    def send_map(self, points: MapPoints, about: dict[str, Any]) -> None:
        """The map as it is now; ``about`` as of ``describe_map``."""
        when = about["stamp_ns"]
        if self._classes.has_sinks() and self._labels is not None:
            self._classes.log(_cloud(points, class_colors(points.label, self._labels), when), log_time=when)
        if self._colors.has_sinks():
            self._colors.log(_cloud(points, points.rgb, when), log_time=when)
        if self._info.has_sinks():
            self._info.log(about, log_time=when)

    def send_graph(self, graph: SceneGraph, changes: Sequence[ObjectChange], stamp_ns: int) -> None:
        """Floors, rooms, doors and things as they are now, and what has become of things since the map of before."""
        if self._graph.has_sinks() and self._labels is not None:
            self._graph.log(_draw_graph(graph, changes, self._labels, stamp_ns), log_time=stamp_ns)

    def _camera(self, camera_id: str) -> _Camera:
        camera = self._cameras.get(camera_id)
        if camera is None or not self._refused.ids.isdisjoint(channel.id() for channel in camera.all):
            for channel in () if camera is None else camera.all:
                channel.close()
            path = CameraPath() if camera is None else camera.path
            camera = self._cameras[camera_id] = _Camera(camera_id, self._context, path)
        return camera


class _Refused(logging.Handler):
    """Which channels clients were too quick for: the SDK advertises one before it can be subscribed to, and says in its
    log alone that it has refused somebody; such a channel has to be advertised again."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: set[int] = set()

    def emit(self, record: logging.LogRecord) -> None:
        if said := re.search(r"unknown channel: (\d+)", record.getMessage()):
            self.ids = {*sorted(self.ids)[-MAX_REFUSED:], int(said[1])}


class _Listener(foxglove.websocket.ServerListener):
    """Counts who receives map and graph; called by the SDK's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._there: Counter[str] = Counter()
        self._joined: Counter[str] = Counter()
        self._last = 0.0  # when somebody joined

    def requests(self, subject: Subject) -> int:
        """How many have begun to receive this so far, or 0 where nobody receives it now."""
        with self._lock:
            settled = time.monotonic() - self._last > SETTLE_S
            return self._joined[subject] if self._there[subject] and settled else 0

    def on_subscribe(self, client: foxglove.websocket.Client, channel: foxglove.websocket.ChannelView) -> None:
        """One more."""
        if channel.topic in _MAPS:
            with self._lock:
                self._there[_MAPS[channel.topic]] += 1
                self._joined[_MAPS[channel.topic]] += 1
                self._last = time.monotonic()

    def on_unsubscribe(self, client: foxglove.websocket.Client, channel: foxglove.websocket.ChannelView) -> None:
        """One less; also where a client has gone."""
        if channel.topic in _MAPS:
            with self._lock:
                self._there[_MAPS[channel.topic]] -= 1


def _png(image: UInt8) -> bytes:
    return _encoded(".png", image, cv2.IMWRITE_PNG_COMPRESSION, 1)  # little, for speed


def _encoded(kind: str, image: UInt8, *flags: int) -> bytes:
    """File of an image (H, W, 3) or of one channel (H, W)."""
    return cv2.imencode(kind, cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image, flags)[1].tobytes()


def _picture(data: bytes, form: str, frame_id: str, when: int) -> messages.CompressedImage:
    return messages.CompressedImage(timestamp=_stamp(when), frame_id=frame_id, data=data, format=form)


def _calibration(k: CameraIntrinsics, frame_id: str, when: int) -> messages.CameraCalibration:
    """Images are rectified: there is no distortion."""
    return messages.CameraCalibration(
        timestamp=_stamp(when),
        frame_id=frame_id,
        width=k.width,
        height=k.height,
        K=[k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0],
        R=np.eye(3).ravel().tolist(),
        P=[k.fx, 0.0, k.cx, 0.0, 0.0, k.fy, k.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _cloud(points: MapPoints, rgb: Any, when: int) -> messages.PointCloud:
    kinds = [(name, POINT[name]) for name in POINT.names or ()]
    offsets = np.cumsum([0, *(kind.itemsize for _, kind in kinds)]).tolist()
    fields = [
        messages.PackedElementField(name=name, offset=offset, type=_TYPES[kind.str])
        for (name, kind), offset in zip(kinds, offsets, strict=False)
        if name != "spare"
    ]
    return messages.PointCloud(
        timestamp=_stamp(when),
        frame_id=WORLD,
        pose=_ORIGIN,
        point_stride=POINT.itemsize,
        fields=fields,
        data=pack_points(points, rgb),
    )


def _stamp(stamp_ns: int) -> messages.Timestamp:
    """Capture time, on the robot's clock."""
    return messages.Timestamp(stamp_ns // 10**9, stamp_ns % 10**9)


def _draw_graph(
    graph: SceneGraph, changes: Sequence[ObjectChange], label_set: LabelSet, stamp_ns: int
) -> messages.SceneUpdate:
    """Boxes of things, outlines of rooms and doors, each with its name, in place of all that was drawn before."""
    entities = [_thing(thing, label_set, stamp_ns) for thing in graph.things]
    for room in graph.rooms:
        outline = _line(room.outline, ROOM_COLOR, closed=True)
        name = _text(f"room {room.id}, {room.area_m2:.1f} m2", room.center, ROOM_COLOR)
        entities.append(_entity(f"room/{room.id}", stamp_ns, lines=[outline], texts=[name]))
    for number, door in enumerate(graph.doors):
        top = _text(f"door {door.rooms[0]}-{door.rooms[1]}, {door.width_m:.2f} m", door.center, DOOR_COLOR)
        post = _line([door.center, door.center + 2.0 * graph.up], DOOR_COLOR, closed=False)
        entities.append(_entity(f"door/{number}", stamp_ns, lines=[post], texts=[top]))
    for change in changes:
        r, g, b = (value / 255 for value in CHANGE_COLORS[change.kind])
        thing, color = change.object, messages.Color(r=r, g=g, b=b, a=1.0)
        name = _text(f"{thing.class_name} {thing.id}: {change.kind}", thing.box.center, color)
        lines = list[object]()
        if change.kind == "moved" and change.before is not None:
            lines.append(_line([change.before.box.center, thing.box.center], color, closed=False))
        entities.append(_entity(f"change/{thing.id}", stamp_ns, lines=lines, texts=[name]))
    gone = messages.SceneEntityDeletion(timestamp=_stamp(stamp_ns), type=messages.SceneEntityDeletionType.All)
    return messages.SceneUpdate(deletions=[gone], entities=entities)


def _thing(thing: Instance, label_set: LabelSet, stamp_ns: int) -> messages.SceneEntity:
    r, g, b = (value / 255 for value in label_set.colors[label_set.ids.index(thing.class_id)])
    box = thing.box
    position, rotation = _pose(box.R_world_box, box.center)
    pose = messages.Pose(position=position, orientation=rotation)
    cube = messages.CubePrimitive(pose=pose, size=_vector(box.size), color=messages.Color(r=r, g=g, b=b, a=BOX_OPACITY))
    top = box.center + box.R_world_box[:, 2] * (box.size[2] / 2 + TEXT_M)
    name = _text(thing.title, top, messages.Color(r=r, g=g, b=b, a=1.0))
    return _entity(f"thing/{thing.id}", stamp_ns, cubes=[cube], texts=[name])


def _entity(name: str, stamp_ns: int, **primitives: list[object]) -> messages.SceneEntity:
    return messages.SceneEntity(timestamp=_stamp(stamp_ns), frame_id=WORLD, id=name, **primitives)  # pyright: ignore


def _line(points: Sequence[Float64] | Float64, color: messages.Color, *, closed: bool) -> messages.LinePrimitive:
    kinds = messages.LinePrimitiveLineType
    return messages.LinePrimitive(
        type=kinds.LineLoop if closed else kinds.LineStrip,
        pose=_ORIGIN,
        thickness=LINE_M,
        points=[messages.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in points],
        color=color,
    )


def _text(text: str, at: Float64, color: messages.Color) -> messages.TextPrimitive:
    where = messages.Pose(position=_vector(at), orientation=messages.Quaternion(w=1.0))
    return messages.TextPrimitive(pose=where, billboard=True, font_size=TEXT_M, color=color, text=text)


def _vector(v: Float64) -> messages.Vector3:
    return messages.Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _pose(R: Float64, at: Float64) -> tuple[messages.Vector3, messages.Quaternion]:
    T = np.eye(4)
    T[:3, :3] = R
    x, y, z, w = map(float, quaternion(T))
    return _vector(at), messages.Quaternion(x=x, y=y, z=z, w=w)
