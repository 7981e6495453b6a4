"""What the map of a mapper remembers of its things, brought up to the present now and then in a thread of its own.

Questions about things are answered as of the last update, so that they cost neither the one who asks nor the mapper
what an update does. There are updates where the map goes on in another one, and while somebody asks."""

from __future__ import annotations

import concurrent.futures
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import structlog

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.graph import GraphTracker
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.objects import ObjectMemory, bring_up
from semantic_mapper.queries.questions import Point, RememberedObjects
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.types import Float64

MAX_UPS = 4  # directions up, by which rooms are kept
PAUSE = 30.0  # after what an update took of the processor, so many times that long: the mapper goes first
WANTED_S = 60.0  # without a question for so long, there are no more updates of a map that goes on in no other
AS_OF_S = 5.0  # an answer may be so much older than the last update should be

_log = structlog.get_logger(__name__)


class Remembered(NamedTuple):
    """What was known at an update."""

    snapshot: MapSnapshot
    up: Float64  # (3,) unit vector
    memory: RememberedObjects


class LiveMemory(Closing):
    """Brings ``VoxelMap.objects`` up to the present; a context manager. One thread calls it, but for ``last``.

    ``before`` is the map that this one goes on in, as it was; ``tracker`` gives what finds the things; ``on_update`` is
    called after each update, by its thread."""

    def __init__(
        self,
        voxel_map: VoxelMap,
        before: MapVisit | None,
        tracker: Callable[[], InstanceTracker],
        on_update: Callable[[], object],
    ) -> None:
        self._since_ns = 0 if before is None else before.stamp_ns
        self._map, self._before, self._tracker, self._on_update = voxel_map, before, tracker, on_update
        self._graphs: dict[Point | None, GraphTracker] = {}
        self._worker = ThreadPoolExecutor(1, "memory")
        self._last: Future[Remembered] | None = None  # the last update that has ended, also by an error
        self._running: Future[Remembered] | None = None
        self._up: Point | None = None  # as the next update has it
        # Version and up of the last update, and of the one that runs.
        self._is_of: tuple[int, Point | None] = -1, None
        self._begun = self._is_of
        # Monotonic seconds: until when there are updates, when the next one is due, until when answers are of the last.
        self._until, self._due, self._as_of = 0.0 if before is None else math.inf, 0.0, 0.0

    def close(self) -> None:
        """End with the update that runs. Harmless when repeated."""
        self._worker.shutdown()

    def rest(self) -> None:
        """No more updates unless somebody asks, once the one that runs has ended; for any thread."""
        self._until = 0.0
        if (running := self._running) is not None:
            concurrent.futures.wait([running])

    def last(self) -> Remembered:
        """Of the last update. Raises MapError: as it did, or there was none."""
        if self._last is None:
            raise MapError("what the map remembers is not known yet; ask again")
        return self._last.result()

    def ready(self, up: Point | None) -> bool:
        """Whether a question may be answered as of the last update; else the next one is due now."""
        self._collect()
        now, (version, last_up) = time.monotonic(), self._is_of
        self._until = max(self._until, now + WANTED_S)
        ready = self._last is not None and up == last_up and (version == self._map.version or now <= self._as_of)
        if not ready and self._running is None:
            self._up, self._due = up, 0.0
        return ready

    def is_due(self) -> bool:
        """Whether it is time for an update, and the map has changed since the last one."""
        self._collect()
        on_time = self._running is None and self._due <= time.monotonic() <= self._until
        return on_time and self._is_of != (self._map.version, self._up)

    def _collect(self) -> None:
        if self._running is not None and self._running.done():
            self._last, self._running, self._is_of = self._running, None, self._begun
            if not isinstance(error := self._last.exception(), SemanticMapperError | None):
                _log.error("memory_not_updated", exc_info=error)

    def begin(self, snapshot: MapSnapshot) -> None:
        """Begin an update to a state of the map."""
        self._begun = snapshot.version, self._up
        self._running = self._worker.submit(self._bring_up, snapshot, self._up)
        self._running.add_done_callback(lambda _: self._on_update())

    def _bring_up(self, snapshot: MapSnapshot, wanted_up: Point | None) -> Remembered:
        began = time.thread_time()
        try:
            return self._updated(snapshot, wanted_up)
        finally:
            self._due = time.monotonic() + PAUSE * (time.thread_time() - began)
            self._as_of = self._due + AS_OF_S

    def _updated(self, snapshot: MapSnapshot, wanted_up: Point | None) -> Remembered:
        if not snapshot.version:
            raise MapError("the mapper has not handed its map over yet: it is busy, or ending; ask again")
        voxel_map, before = self._map, self._before
        memory = ObjectMemory.from_bytes(voxel_map.objects)
        if wanted_up not in self._graphs and len(self._graphs) == MAX_UPS:
            self._graphs.clear()
        graphs = self._graphs.setdefault(wanted_up, GraphTracker(wanted_up))
        up = graphs.up_in(snapshot)
        things = tuple(thing for thing in self._tracker().find(snapshot, up).things if not thing.unsure)
        graph = graphs.update(snapshot, things)
        bring_up(voxel_map, memory, snapshot, graph, before)
        return Remembered(snapshot, up, RememberedObjects(memory.objects, self._since_ns))

    def counters(self) -> dict[str, int]:
        """How many things were moved, are new and have gone since the map of before; nothing without one."""
        if not self._since_ns or (last := self._last) is None or last.exception() is not None:
            return {}
        kinds = [change.kind for change in last.result().memory.changes]
        return {kind: kinds.count(kind) for kind in ("moved", "new", "gone")}
