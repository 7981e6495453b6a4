"""A Foxglove websocket on this machine: what a launch publishes, as Foxglove's own message types.

A client that does not keep up loses the oldest of what waits for it. What nobody subscribes to is not even encoded.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from types import TracebackType
from typing import Any, Literal, Self

import msgspec
import numpy as np

from semantic_mapper.errors import TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.nodes.bridge.feed import Subject
from semantic_mapper.nodes.bridge.packing import POINT, moving_mask, pack_points, to_jpeg, to_png
from semantic_mapper.nodes.foxglove.scene import WORLD, camera_frame, draw_graph, draw_path, stamp, transform
from semantic_mapper.nodes.foxglove.sdk import channels, foxglove, messages
from semantic_mapper.plots import class_colors
from semantic_mapper.queries.graph import SceneGraph
from semantic_mapper.replay.exporters.base import CameraPath
from semantic_mapper.transport.messages import Status
from semantic_mapper.types import CameraIntrinsics, Float64, MapUpdate, PosedFrame

HOST = "127.0.0.1"  # the protocol has neither keys nor passwords: other machines come in by `ssh -L`
BACKLOG = 32  # messages that may wait for a client; of a map of 400,000 points each has 8 MB
SETTLE_S = 0.05  # after the SDK has said so, until what is sent reaches who has subscribed
PATH_PERIOD_S = 1.0  # a long path takes milliseconds to draw
STATUS_SCHEMA = {
    "type": "object",
    "properties": {
        "node": {"type": "string"},
        "state": {"type": "string"},
        "stamp_ns": {"type": "integer"},
        "counters": {"type": "object"},
        "ages_s": {"type": "object"},
        "degraded": {"type": "array", "items": {"type": "string"}},
    },
}
_TYPES = {"<f4": messages.PackedElementFieldNumericType.Float32, "|u1": messages.PackedElementFieldNumericType.Uint8}
_MAPS: dict[str, Subject] = {"/map/classes": "map", "/map/colors": "map", "/map/info": "map", "/graph": "graph"}


class _Camera:
    """Channels of one camera."""

    def __init__(self, camera_id: str, context: foxglove.Context) -> None:
        name = f"/{camera_id}"
        self.rgb = channels.CompressedImageChannel(f"{name}/rgb", context=context)
        self.depth = channels.RawImageChannel(f"{name}/depth", context=context)
        self.semantics = channels.CompressedImageChannel(f"{name}/semantics", context=context)
        self.moving = channels.CompressedImageChannel(f"{name}/moving", context=context)
        self.calibration = channels.CameraCalibrationChannel(f"{name}/calibration", context=context)
        self.path = CameraPath()


class FoxgloveServer:
    """An ``Outlet`` that serves Foxglove; a context manager.

    Args:
        port: Of 127.0.0.1; 0 = any that is free.

    Raises:
        TransportError: the port is taken.
    """

    def __init__(self, port: int) -> None:
        context = foxglove.Context()
        self._context = context
        self._listener = _Listener()
        try:
            self._server = foxglove.start_server(
                name="semantic-mapper",
                host=HOST,
                port=port,
                context=context,
                server_listener=self._listener,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            raise TransportError(
                f"port {port} cannot be had ({error}); give another one as `port`, or 0 for any that is free"
            ) from error
        self._cameras: dict[str, _Camera] = {}
        self._labels: LabelSet | None = None
        self._path_sent = 0.0
        self._tf = channels.FrameTransformsChannel("/tf", context=context)
        self._path = channels.SceneUpdateChannel("/path", context=context)
        self._classes = channels.PointCloudChannel("/map/classes", context=context)
        self._colors = channels.PointCloudChannel("/map/colors", context=context)
        self._info = foxglove.Channel("/map/info", schema={"type": "object"}, context=context)
        self._graph = channels.SceneUpdateChannel("/graph", context=context)
        self._status = foxglove.Channel("/status", schema=STATUS_SCHEMA, context=context)

    @property
    def url(self) -> str:
        """What a client connects to."""
        return f"ws://{HOST}:{self._server.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()

    def requests(self, subject: Subject) -> int:
        """See ``Outlet``."""
        return self._listener.requests(subject)

    def send_labels(self, label_set: LabelSet) -> None:
        """See ``Outlet``."""
        self._labels = label_set

    def wants(self, topic: Literal["frame", "map"], camera_id: str) -> bool:
        """See ``Outlet``."""
        c = self._camera(camera_id)
        wanted = (c.rgb, c.depth, c.calibration, self._tf) if topic == "frame" else (c.semantics, c.moving, self._path)
        return any(channel.has_sinks() for channel in wanted)

    def note_pose(self, camera_id: str, T_map_camera: Float64) -> None:
        """See ``Outlet``."""
        self._camera(camera_id).path.add(T_map_camera)

    def send_frame(self, frame: PosedFrame, T_map_camera: Float64 | None) -> None:
        """See ``Outlet``."""
        camera, when, name = self._camera(frame.camera_id), frame.stamp_ns, camera_frame(frame.camera_id)
        if T_map_camera is not None and self._tf.has_sinks():
            moved = transform(T_map_camera, name, when)
            self._tf.log(messages.FrameTransforms(transforms=[moved]), log_time=when)
        if camera.calibration.has_sinks():
            camera.calibration.log(_calibration(frame.intrinsics, name, when), log_time=when)
        if camera.rgb.has_sinks():
            picture = to_jpeg(frame.rgb)
            camera.rgb.log(_picture(picture, "jpeg", name, when), log_time=when)
        if camera.depth.has_sinks() and frame.depth_m is not None:
            height, width = frame.depth_m.shape
            data = np.ascontiguousarray(frame.depth_m, "<f4").tobytes()
            form = {"width": width, "height": height, "encoding": "32FC1", "step": 4 * width}
            image = messages.RawImage(timestamp=stamp(when), frame_id=name, data=data, **form)
            camera.depth.log(image, log_time=when)

    def send_update(self, update: MapUpdate) -> None:
        """See ``Outlet``."""
        camera, labels, when = self._camera(update.camera_id), self._labels, update.stamp_ns
        name = camera_frame(update.camera_id)
        if labels is not None and camera.semantics.has_sinks():
            picture = to_png(class_colors(update.label, labels))
            camera.semantics.log(_picture(picture, "png", name, when), log_time=when)
        if camera.moving.has_sinks():
            camera.moving.log(_picture(to_png(moving_mask(update)), "png", name, when), log_time=when)
        paths = {name: camera.path.poses for name, camera in self._cameras.items() if camera.path.poses}
        if paths and self._path.has_sinks() and time.monotonic() - self._path_sent > PATH_PERIOD_S:
            self._path_sent = time.monotonic()
            self._path.log(draw_path(paths, when), log_time=when)

    def send_status(self, status: Status) -> None:
        """See ``Outlet``."""
        if self._status.has_sinks():
            self._status.log(msgspec.json.encode(status), log_time=status.stamp_ns)

    def send_map(self, points: MapPoints, about: dict[str, Any]) -> None:
        """See ``Outlet``."""
        when = about["stamp_ns"]
        if self._classes.has_sinks() and self._labels is not None:
            self._classes.log(_cloud(points, class_colors(points.label, self._labels), when), log_time=when)
        if self._colors.has_sinks():
            self._colors.log(_cloud(points, points.rgb, when), log_time=when)
        if self._info.has_sinks():
            self._info.log(about, log_time=when)

    def send_graph(self, graph: SceneGraph, stamp_ns: int) -> None:
        """See ``Outlet``."""
        if self._graph.has_sinks() and self._labels is not None:
            self._graph.log(draw_graph(graph, self._labels, stamp_ns), log_time=stamp_ns)

    def _camera(self, camera_id: str) -> _Camera:
        if camera_id not in self._cameras:
            self._cameras[camera_id] = _Camera(camera_id, self._context)
        return self._cameras[camera_id]


class _Listener(foxglove.websocket.ServerListener):
    """Counts who receives map and graph; called by the SDK's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._there: Counter[str] = Counter()
        self._joined: Counter[str] = Counter()
        self._last = 0.0  # when somebody joined

    def requests(self, subject: Subject) -> int:
        """See ``Outlet``."""
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


def _picture(data: bytes, form: str, frame_id: str, when: int) -> messages.CompressedImage:
    return messages.CompressedImage(timestamp=stamp(when), frame_id=frame_id, data=data, format=form)


def _calibration(k: CameraIntrinsics, frame_id: str, when: int) -> messages.CameraCalibration:
    """Images are rectified: there is no distortion."""
    return messages.CameraCalibration(
        timestamp=stamp(when),
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
        timestamp=stamp(when),
        frame_id=WORLD,
        pose=messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0)),
        point_stride=POINT.itemsize,
        fields=fields,
        data=pack_points(points, rgb),
    )
