"""What the viewer is shown: a saved map, nodes and map of a running system, or a session that maps a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import structlog
from numpy.typing import NDArray

from semantic_mapper.client import MapClient
from semantic_mapper.errors import MapError, TransportError
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.map_feed import MapFollower, follow_changes, thinned
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.nodes.streams import MapPoses, Streams
from semantic_mapper.queries.graph import GraphTracker, SceneGraph, find_graph
from semantic_mapper.queries.objects import ObjectChange, ObjectMemory
from semantic_mapper.queries.questions import RememberedObjects
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import surface_points, surface_voxels
from semantic_mapper.replay.rerun_log import RerunLog
from semantic_mapper.transport.messages import EndOfStream
from semantic_mapper.transport.sockets import NewestSubscriber
from semantic_mapper.types import CameraIntrinsics, MapUpdate, PosedFrame

if TYPE_CHECKING:
    from semantic_mapper.mapping.pipeline import MappingPipeline

POLL_S = 0.1
REFRESH_S = 2.0  # between two maps
GRAPH_S = 5.0  # between two graphs
FIRST_FRAME_S = 5.0  # a map is shown as of its newest frame, which may never come
# Of a session, mapping goes before showing: images so often, and between two maps so many times as long as the last
# one took.
IMAGE_S, PAUSE = 0.5, 20.0
ASK_AGAIN_S = 1.0  # a mapper that does not answer yet

Begin = Callable[[], rr.RecordingStream]  # what is to be shown is open: where does it go?

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Live:
    """Where a running system is listened to."""

    mapper: str  # its place, as of ``MapClient``
    # endpoints of cameras and mappers, whatever else is among them; none shows the map alone
    nodes: tuple[str, ...] = ()
    # server, keys: Of a mapper on another machine, as of ``MapClient``.
    server: str = ""
    keys: Path | None = None
    streams: int = 1  # how many of the nodes are cameras; it is over when all of their streams have ended


class MapShow:
    """Shows one state of a map after the other."""

    def __init__(self, log: RerunLog, changes: Callable[[], Sequence[ObjectChange]] = tuple) -> None:
        self._log, self._changes = log, changes
        self._shown: NDArray[np.int64] | None = None  # contents of the blocks
        self._graph: GraphTracker | None = None
        self._graph_at = 0.0

    def show(self, snapshot: MapSnapshot, stamp_ns: int) -> None:
        """Show it as of a time; a map that has not changed since is left as it is."""
        if self._shown is not None and np.array_equal(snapshot.serials, self._shown):
            return
        self._shown = snapshot.serials
        self._log.set_time(stamp_ns)
        self._show_graph(snapshot)  # it knows which way is up
        self._log.log_map(thinned(surface_points(snapshot, surface_voxels(snapshot))))
        self._log.log_changes(self._changes())  # last: a mapper may take a while to answer

    def _show_graph(self, snapshot: MapSnapshot) -> None:
        """Rooms and things, now and then; none where lengths are not metres, or the floor is not known yet."""
        if not snapshot.scale_known or time.monotonic() < self._graph_at:
            return
        self._graph = self._graph or GraphTracker()
        try:
            self._log.log_graph(self._graph.update(snapshot), self._graph.gone)
        except MapError as error:
            _log.debug("graph_not_shown", reason=str(error))
        self._graph_at = time.monotonic() + GRAPH_S


class WatchedSession(RerunLog):
    """Shows frames now and then, the map now and then and at the end, in some twentieth of the time."""

    def __init__(self, begin: Begin, pipeline: MappingPipeline) -> None:
        super().__init__(begin(), pipeline.label_set, pipeline.voxel_map.config.voxel_size_m)
        self._map = pipeline.voxel_map
        self._show, self._mirror = MapShow(self), MapMirror.of(self._map)
        self._image_due, self._map_due = 0.0, time.monotonic() + REFRESH_S
        self._stamp_ns = 0

    def log_step(self, frame: PosedFrame, update: MapUpdate) -> None:
        """One frame and what was rendered for it, and the map, where it is time for them."""
        self._stamp_ns, now = frame.stamp_ns, time.monotonic()
        if now >= self._image_due:
            super().log_step(frame, update)
            self._image_due = now + IMAGE_S
        if now >= self._map_due:
            self._show_map()
            self._map_due = time.monotonic() + max(REFRESH_S, PAUSE * (time.monotonic() - now))

    def finish(self, points: MapPoints, graph: SceneGraph | None = None) -> None:
        """The map as it is at the end; all has been sent then."""
        self._show_map()
        if graph is not None:
            self.log_graph(graph)
        self.close()

    def _show_map(self) -> None:
        self._show.show(self._mirror.apply(self._map.changes(self._mirror.version)), self._stamp_ns)


def show_saved(path: Path, begin: Begin) -> None:
    """Show a saved map. Raises MapError: it cannot be read."""
    voxel_map = VoxelMap.load(path)
    log = RerunLog(begin(), voxel_map.label_set, voxel_map.config.voxel_size_m)
    log.note_scale(voxel_map.scale_known)
    if (graph := find_graph(voxel_map)) is not None:
        memory = RememberedObjects.of_saved(ObjectMemory.from_bytes(voxel_map.objects).objects)
        log.log_graph(graph)
        log.log_changes(memory.changes)
    log.finish(voxel_map.points())


def show_live(live: Live, begin: Begin, refresh_s: float, stop: StopRequest, tell: Callable[[str], None]) -> None:
    """Show a running system until its streams have ended or somebody asks to stop.

    The mapper is queried first, and waited for: a camera that waits for its listeners would else count this one in.
    ``begin`` is called once the endpoint is known to be one (else ``TransportError``), ``tell`` with lines of progress.
    """
    with MapClient(live.mapper, server=live.server, keys=live.keys, attempts=1) as client:
        stream = begin()
        snapshot = _first_snapshot(client, stop, tell)
        if snapshot is None:
            return
        log = RerunLog(stream, snapshot.label_set, snapshot.voxel_size_m)
        log.note_scale(snapshot.scale_known)
        show, began = MapShow(log, follow_changes(client)), time.monotonic()
        newest_ns = [0]  # stamp of the newest frame; cameras and logs may have clocks of their own

        def look() -> None:
            if not live.nodes:
                show.show(client.mirror().snapshot(), time.monotonic_ns())
            elif newest_ns[0] or time.monotonic() > began + FIRST_FRAME_S:
                show.show(client.mirror().snapshot(), newest_ns[0])

        try:
            with MapFollower(look, refresh_s):
                if live.nodes:
                    _follow_nodes(live, log, newest_ns, stop)
                    tell("the stream has ended" if not stop else "stopped")
                while not stop and not live.nodes:
                    time.sleep(POLL_S)
        finally:
            log.close()


def _first_snapshot(client: MapClient, stop: StopRequest, tell: Callable[[str], None]) -> MapSnapshot | None:
    """The map as it is, once its mapper answers; None where a stop request came first."""
    said = False
    while not stop:
        try:
            return client.mirror().snapshot()
        except (TransportError, MapError) as error:
            if not said:
                tell(f"waiting for the mapper: {error}")
            said = True
            time.sleep(ASK_AGAIN_S)
    return None


def _follow_nodes(live: Live, log: RerunLog, newest_ns: list[int], stop: StopRequest) -> None:
    """Show frames and what was rendered for them until all streams have ended: cameras wait for their listeners."""
    intrinsics: dict[str, CameraIntrinsics] = {}
    streams, poses = Streams(live.streams), MapPoses()
    with NewestSubscriber(live.nodes, ("frame", "map", "end")) as messages:
        while not stop and not streams.ended:
            message = messages.receive(POLL_S)
            match message:
                case PosedFrame():
                    intrinsics[message.camera_id] = message.intrinsics
                    newest_ns[0] = message.stamp_ns
                    pose = poses.place(message.world, message.T_world_camera)
                    if pose is None:  # the mapper does not know yet where in the map it was taken
                        log.log_frame(message, posed=False)
                    else:
                        log.log_frame(replace(message, T_world_camera=pose))
                case MapUpdate():
                    poses.note(message.world, message.T_map_world)
                    if message.camera_id in intrinsics:
                        log.log_update(message, intrinsics[message.camera_id])
                case EndOfStream():
                    streams.end(message)
                case _:
                    pass
