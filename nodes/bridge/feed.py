"""The way from a launch to another tool: its topics and its map, read as any client reads them.

Frames and status come by the topics; newest wins. The map is fetched by a thread of its own through ``MapClient``, its
changes alone, and only while somebody receives it. Nothing here can hold up the mapper.
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import numpy as np
import structlog
from numpy.typing import NDArray

from semantic_mapper.client import MapClient
from semantic_mapper.errors import CodecError, MapError, NodeError, SemanticMapperError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_scale import FIX
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.nodes.bridge.packing import describe_map, thinned
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import BridgeOptions
from semantic_mapper.nodes.publishing import publish_status
from semantic_mapper.nodes.streams import MapPoses, Streams
from semantic_mapper.queries.graph import GraphTracker, SceneGraph
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.transport.codec import decode_as, read_envelope
from semantic_mapper.transport.keys import ServerIdentity, load_keys
from semantic_mapper.transport.messages import EndOfStream, NodeState, Status
from semantic_mapper.transport.sockets import NewestSubscriber, Publisher
from semantic_mapper.types import Float64, MapUpdate, PosedFrame

POLL_S = 0.1
STATUS_PERIOD_S = 1.0
PAUSE = 4.0  # after what a map or graph took to fetch and pack, so many times that long: at most a fifth of a core
NICENESS = 19  # the mapper goes first wherever both want the processor

Subject = Literal["map", "graph"]

_log = structlog.get_logger(__name__)


class Outlet(Protocol):
    """The other tool's side. Frames and status come from one thread, map and graph from another."""

    def requests(self, subject: Subject) -> int:
        """How many have begun to receive this so far, or 0 where nobody receives it now."""
        ...

    def send_labels(self, label_set: LabelSet) -> None:
        """The classes of the map, before anything that has classes."""
        ...

    def wants(self, topic: Literal["frame", "map"], camera_id: str) -> bool:
        """Whether anybody receives what messages of a camera on this topic hold: else they are not even decoded."""
        ...

    def note_pose(self, camera_id: str, T_map_camera: Float64) -> None:
        """Where a camera was in the map, of every frame of which that is known."""
        ...

    def send_frame(self, frame: PosedFrame, T_map_camera: Float64 | None) -> None:
        """One camera image with its pose in the map; None while that is not known."""
        ...

    def send_update(self, update: MapUpdate) -> None:
        """What was rendered for a frame."""
        ...

    def send_status(self, status: Status) -> None:
        """What a node says of itself."""
        ...

    def send_map(self, points: MapPoints, about: dict[str, Any]) -> None:
        """The map as it is now; ``about`` as of ``describe_map``."""
        ...

    def send_graph(self, graph: SceneGraph, stamp_ns: int) -> None:
        """Floors, rooms, doors and things as they are now."""
        ...


def lower_priority() -> None:
    """Let every other process go first, before threads are started, which inherit it."""
    os.setpriority(os.PRIO_PROCESS, 0, max(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))


def run_bridge(context: NodeContext, options: BridgeOptions, outlet: Outlet) -> None:
    """Hand on what the nodes publish until all streams have ended or somebody asks to stop.

    Raises:
        NodeError: the thread that sends the map has ended, by a bug; what it has said is in the log.
        TransportError: an invalid endpoint, the endpoint of the node is taken, or there are no keys.
    """
    query = options.query if "://" in options.query else context.endpoint(options.query)
    endpoints = [context.endpoint(name) for name in options.inputs()]
    identity = ServerIdentity(load_keys(Path(options.keys).expanduser())) if options.keys else None
    with ExitStack() as stack:
        publisher = stack.enter_context(Publisher(context.endpoint(context.name)))
        client = stack.enter_context(MapClient(query, attempts=1, identity=identity))
        follower = stack.enter_context(_MapFollower(client, outlet, options))
        messages = stack.enter_context(NewestSubscriber(endpoints, ("frame", "map", "status", "end")))
        report = _StatusReport(context.name, publisher, messages, follower)
        streams, poses = Streams(len(options.cameras)), MapPoses()
        context.heartbeat.ready()
        while not context.stop and not streams.ended:
            context.heartbeat.turn()
            if not follower.alive:
                raise NodeError("the map is no longer sent: the thread that does so has ended; its error is above")
            if (parts := messages.receive_parts(POLL_S)) is not None:
                try:
                    _hand_on(parts, outlet, follower, streams, poses)
                except CodecError as error:  # of what its sender itself could not read
                    _log.warning("message_left_out", reason=str(error))
            if report.due:
                outlet.send_status(report.tell("running"))
        messages.close()  # a camera that has ended waits for its listeners to leave
        context.heartbeat.ending()
        outlet.send_status(report.tell("ended"))


def _hand_on(parts: list[bytes], outlet: Outlet, follower: _MapFollower, streams: Streams, poses: MapPoses) -> None:
    """One message of a node.

    Raises:
        CodecError: it cannot be decoded.
    """
    envelope = read_envelope(parts)
    match envelope.topic:
        case "frame":
            follower.stamp_ns = envelope.stamp_ns
            follower.frames += 1
            T_map_camera = poses.place(envelope.world, envelope.T_world_camera)
            if T_map_camera is not None:
                outlet.note_pose(envelope.source, T_map_camera)
            if outlet.wants("frame", envelope.source):
                outlet.send_frame(decode_as(PosedFrame, parts), T_map_camera)
        case "map":
            poses.note(envelope.world, envelope.T_map_world)
            if outlet.wants("map", envelope.source):
                outlet.send_update(decode_as(MapUpdate, parts))
        case "status":
            outlet.send_status(decode_as(Status, parts))
        case "end":
            streams.end(decode_as(EndOfStream, parts))
        case _:
            pass


class _StatusReport:
    """Publishes how the bridge is, about once a second."""

    def __init__(self, node: str, publisher: Publisher, messages: NewestSubscriber, follower: _MapFollower) -> None:
        self._node = node
        self._publisher = publisher
        self._messages = messages
        self._follower = follower
        self._last = 0.0

    @property
    def due(self) -> bool:
        """Whether it is time to."""
        return time.monotonic() - self._last >= STATUS_PERIOD_S

    def tell(self, state: NodeState) -> Status:
        """Publish it; for the clients, too."""
        self._last = time.monotonic()
        counters = {
            "frames": self._follower.frames,
            "maps": self._follower.sent["map"],
            "graphs": self._follower.sent["graph"],
        }
        counters |= {"rejected": self._messages.rejected, "overwritten": self._messages.overwritten}
        silent = self._messages.silent_s
        ages = {} if silent is None else {"frame": silent}
        degraded = tuple(filter(None, (self._follower.trouble, self._follower.no_graph)))
        status = Status(self._node, state, time.monotonic_ns(), counters, ages, degraded)
        publish_status(self._publisher, status)
        return status


class _MapFollower:
    """Sends map and graph on whenever they have changed or somebody new receives them; a thread of its own.

    Args:
        client: Of the mapper; one that is restarted is found again.
        outlet: Where to.
        options: See there.
    """

    def __init__(self, client: MapClient, outlet: Outlet, options: BridgeOptions) -> None:
        self.frames, self.stamp_ns = 0, 0  # heard of, and stamp of the newest one
        self.sent: dict[Subject, int] = {"map": 0, "graph": 0}
        self.trouble = ""  # why the last look failed
        self.no_graph = ""  # why somebody who wants one has none
        self._client = client
        self._outlet = outlet
        self._options = options
        self._labels: LabelSet | None = None
        self._graphs: tuple[MapMirror, GraphTracker] | None = None
        self._shown: dict[Subject, tuple[int, NDArray[np.int64]]] = {}  # to how many, and contents of the blocks
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether it still sends; False before its end only by a bug."""
        return self._thread.is_alive()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Once more, for what has come since."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        ended, pause_s = False, 0.0
        while not ended:
            ended = self._ended.wait(max(self._options.refresh_s, pause_s))
            began = time.monotonic()
            try:
                self._look()
                self.trouble, pause_s = "", PAUSE * (time.monotonic() - began)
            except SemanticMapperError as error:  # a mapper that starts has no map for a while
                if not (self.trouble or ended):
                    _log.warning("map_not_sent", reason=str(error))
                self.trouble, pause_s = str(error), 0.0

    def _look(self) -> None:
        requests = {subject: self._outlet.requests(subject) for subject in self.sent}
        if self._labels is None and not self._ended.is_set():
            self._use_labels(self._client.info().label_set)
        if not requests["graph"]:
            self.no_graph = ""
        if not any(requests.values()):
            return
        mirror = self._client.mirror()
        snapshot = mirror.snapshot()
        self._use_labels(snapshot.label_set)
        if self._is_new("map", requests["map"], snapshot):
            points = surface_points(snapshot, surface_voxels(snapshot))
            self._outlet.send_map(thinned(points), describe_map(snapshot, len(points.xyz), self.stamp_ns))
            self.sent["map"] += 1
        if requests["graph"] and not snapshot.scale_known:
            self.no_graph = f"no graph: lengths of the map are not metres: {FIX}"
        elif self._is_new("graph", requests["graph"], snapshot):
            if self._graphs is None or self._graphs[0] is not mirror:  # of a mapper that was restarted
                self._graphs = mirror, GraphTracker()
            self._send_graph(self._graphs[1], snapshot)

    def _send_graph(self, tracker: GraphTracker, snapshot: MapSnapshot) -> None:
        try:
            graph = tracker.update(snapshot)
        except MapError as error:  # which way is up shows once there is a floor
            self.no_graph = f"no graph: {error}"
            return
        self.no_graph = "" if graph.floors else "no graph: no floor was found"
        self._outlet.send_graph(graph, self.stamp_ns)
        self.sent["graph"] += 1

    def _use_labels(self, label_set: LabelSet) -> None:
        if label_set != self._labels:
            self._labels = label_set
            self._outlet.send_labels(label_set)

    def _is_new(self, subject: Subject, requests: int, snapshot: MapSnapshot) -> bool:
        """Whether somebody receives it who is new, or the map is another one than was shown last; shown it is then."""
        before = self._shown.get(subject)
        if not requests or (before and before[0] == requests and np.array_equal(before[1], snapshot.serials)):
            return False
        self._shown[subject] = requests, snapshot.serials
        return True
