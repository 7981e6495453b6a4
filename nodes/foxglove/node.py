"""The node that serves images, map, graph and status to Foxglove, read as any client reads them.

Frames and status come by the topics; newest wins. The map is fetched by a thread of its own through ``MapClient``, its
changes alone, and only while somebody receives it. Nothing here can hold up the mapper.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import structlog
from numpy.typing import NDArray

from semantic_mapper.client import MapClient
from semantic_mapper.errors import CodecError, MapError, NodeError
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import SCALE_FIX
from semantic_mapper.nodes.map_feed import MapFollower, describe_map, follow_changes, thinned
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.options import FoxgloveOptions
from semantic_mapper.nodes.publishing import PartStatus, StatusReport
from semantic_mapper.nodes.streams import MapPoses, Streams
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.transport.codec import decode_as, read_envelope
from semantic_mapper.transport.messages import EndOfStream, NodeState, Status
from semantic_mapper.transport.sockets import NewestSubscriber, Publisher
from semantic_mapper.types import MapUpdate, PosedFrame

if TYPE_CHECKING:
    from semantic_mapper.nodes.foxglove.server import FoxgloveServer, Subject

POLL_S = 0.1
PAUSE = 4.0  # after what a map or graph took to fetch and pack, so many times that long: at most a fifth of a core
NICENESS = 19  # the mapper goes first wherever both want the processor

_log = structlog.get_logger(__name__)


def run_foxglove(context: NodeContext, options: FoxgloveOptions) -> None:
    """Serve until all streams have ended or somebody asks to stop.

    Raises DependencyError: the extra is not installed. NodeError: the thread that sends the map has ended, by a bug;
    what it has said is in the log. TransportError: the port is taken, a socket of the launch cannot be used, or there
    are no keys.
    """
    from semantic_mapper.nodes.foxglove.server import FoxgloveServer  # an extra, which may be missing

    os.setpriority(os.PRIO_PROCESS, 0, max(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))  # threads inherit it
    endpoints = [context.endpoint(name) for name in options.inputs()]
    keys = Path(options.keys).expanduser() if options.keys else None
    with ExitStack() as stack:
        server = stack.enter_context(FoxgloveServer(options.port))
        _log.info("serving", foxglove_websocket=server.url)
        publisher = stack.enter_context(Publisher(context.endpoint(context.name)))
        client = stack.enter_context(MapClient(context.endpoint(options.query), attempts=1, keys=keys))
        sender = _MapSender(client, server)
        follower = stack.enter_context(MapFollower(sender.look, options.refresh_s, PAUSE))
        messages = stack.enter_context(NewestSubscriber(endpoints, ("frame", "map", "status", "end")))
        report = StatusReport(context.name, publisher)
        streams, poses = Streams(len(options.cameras)), MapPoses()

        def tell(state: NodeState) -> None:
            counters = {"frames": sender.frames, "maps": sender.sent["map"], "graphs": sender.sent["graph"]}
            counters |= {"rejected": messages.rejected, "overwritten": messages.overwritten}
            ages = {} if messages.silent_s is None else {"frame": messages.silent_s}
            warnings = (follower.trouble, sender.no_graph)
            server.send_status(report.publish(state, PartStatus(counters, warnings, ages)))

        context.heartbeat.ready()
        while not context.stop and not streams.ended:
            context.heartbeat.turn()
            if not follower.alive:
                raise NodeError("the map is no longer sent: the thread that does so has ended; its error is above")
            if (parts := messages.receive_parts(POLL_S)) is not None:
                try:
                    _hand_on(parts, server, sender, streams, poses)
                except CodecError as error:  # of what its sender itself could not read
                    _log.warning("message_left_out", reason=str(error))
            if report.due:
                tell("running")
        messages.close()  # a camera that has ended waits for its listeners to leave
        context.heartbeat.ending()
        tell("ended")


def _hand_on(parts: list[bytes], server: FoxgloveServer, sender: _MapSender, streams: Streams, poses: MapPoses) -> None:
    envelope = read_envelope(parts)
    match envelope.topic:
        case "frame":
            sender.stamp_ns = envelope.stamp_ns
            sender.frames += 1
            T_map_camera = poses.place(envelope.world, envelope.T_world_camera)
            if T_map_camera is not None:
                server.note_pose(envelope.source, T_map_camera)
            if server.wants("frame", envelope.source):
                server.send_frame(decode_as(PosedFrame, parts), T_map_camera)
        case "map":
            poses.note(envelope.world, envelope.T_map_world)
            if server.wants("map", envelope.source):
                server.send_update(decode_as(MapUpdate, parts))
        case "status":
            server.send_status(decode_as(Status, parts))
        case "end":
            streams.end(decode_as(EndOfStream, parts))
        case _:
            pass


class _MapSender:
    """Sends map and graph on whenever they have changed or somebody new receives them."""

    def __init__(self, client: MapClient, server: FoxgloveServer) -> None:
        self.frames, self.stamp_ns = 0, 0  # heard of, and stamp of the newest one
        self.sent: dict[Subject, int] = {"map": 0, "graph": 0}
        self.no_graph = ""  # why somebody who wants one has none
        self._client = client
        self._server = server
        self._labels: LabelSet | None = None
        self._graphs: tuple[MapMirror, GraphTracker] | None = None
        self._changes = follow_changes(client)
        self._shown: dict[Subject, tuple[int, NDArray[np.int64]]] = {}  # to how many, and contents of the blocks

    def look(self) -> None:
        """Fetch the map and send what is new."""
        requests = {subject: self._server.requests(subject) for subject in self.sent}
        if self._labels is None:
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
            self._server.send_map(thinned(points), describe_map(snapshot, len(points.xyz), self.stamp_ns))
            self.sent["map"] += 1
        if requests["graph"] and not snapshot.scale_known:
            self.no_graph = f"no graph: lengths of the map are not metres: {SCALE_FIX}"
        elif self._is_new("graph", requests["graph"], snapshot):
            if self._graphs is None or self._graphs[0] is not mirror:  # of a mapper that was restarted
                self._graphs = mirror, GraphTracker()
            self._send_graph(self._graphs[1], snapshot)

    def _send_graph(self, tracker: GraphTracker, snapshot: MapSnapshot) -> None:
        try:
            graph, changes = tracker.update(snapshot), self._changes()
        except MapError as error:  # which way is up shows once there is a floor
            self.no_graph = f"no graph: {error}"
            return
        self.no_graph = "" if graph.floors else "no graph: no floor was found"
        self._server.send_graph(graph, changes, self.stamp_ns)
        self.sent["graph"] += 1

    def _use_labels(self, label_set: LabelSet) -> None:
        if label_set != self._labels:
            self._labels = label_set
            self._server.send_labels(label_set)

    def _is_new(self, subject: Subject, requests: int, snapshot: MapSnapshot) -> bool:
        """Whether somebody receives it who is new, or the map is another one than was shown last; shown it is then."""
        before = self._shown.get(subject)
        if not requests or (before and before[0] == requests and np.array_equal(before[1], snapshot.serials)):
            return False
        self._shown[subject] = requests, snapshot.serials
        return True
