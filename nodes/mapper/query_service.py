"""The query service of a mapper: answers questions from an immutable snapshot of the map.

One thread owns the socket and makes snapshots of what the mapper's thread copies for it. Of two workers, one answers
what is quick, the other what takes long, each in the order of arrival. So no quick answer waits for a long one, and the
mapper for none.
"""

from __future__ import annotations

import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import structlog

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.labels import STUFF_NAMES
from semantic_mapper.mapping.changes import CopiedChanges
from semantic_mapper.mapping.map_types import CameraPose
from semantic_mapper.mapping.moving import MovingSpace
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_memory import LiveMemory
from semantic_mapper.nodes.mapper.live_weights import LiveWeights
from semantic_mapper.nodes.publishing import PartStatus
from semantic_mapper.queries import questions
from semantic_mapper.queries.find import find
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.nearest import MAX_RADIUS_VOXELS, RADIUS_VOXELS, at, nearest
from semantic_mapper.queries.occupancy import distance_field, occupancy
from semantic_mapper.queries.questions import Request, encode_error
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from semantic_mapper.queries.surface import cast_rays, points_in_box
from semantic_mapper.transport.endpoints import Closing
from semantic_mapper.transport.keys import Keys
from semantic_mapper.transport.sockets import QueryServer

PERIOD_S = 0.1  # between two snapshots, at least
MAX_BLOCKS = 600  # copied between two frames, and the rest of a frame: bounds what a step may cost
LISTENED_S = 1.0  # without a question for so long, no more snapshots are made
CATCH_UP_S = 4.0  # without another copy for so long, questions wait no longer for the present map
MAX_WAITING, MAX_OF_CLIENT = 64, 8  # questions that wait, of all clients and of one
# What would keep the others waiting for more than about a second is refused.
MAX_VISITED_VOXELS = 1e8  # of `at`
MAX_RAY_METRES = 2e5  # of `cast_rays`, all rays together
MAX_FIELD_VOXELS = 1 << 22  # of `distance_field`
MAX_CHANGED_BLOCKS = 1 << 14  # of `changes`, and the rest of a version
_POLL_S = 0.5
_NOT_READY = "the mapper has not handed its map over to its query service yet: it is busy, or ending; ask again"
_TOO_MANY = "too many questions wait for an answer; ask again later, and await each answer"

_log = structlog.get_logger(__name__)


@dataclass(slots=True, eq=False)
class _PendingRequest:
    """A question that waits for a snapshot or a worker, or that one answers."""

    address: bytes  # socket that the answer goes to
    until: float  # when the client stops waiting, monotonic seconds
    parts: list[bytes]  # as they came
    request: Request[Any]  # what they mean
    # of the worker: parts, or None where nobody waits for them any more; None = it waits for a snapshot
    answer: Future[list[bytes] | None] | None = None


class QueryService(Closing):
    """Answers questions about a map that another thread changes. A context manager.

    Answers are about the map as it was a moment ago, and say about which version. Without questions there are no
    snapshots.

    Args:
        endpoint, keys: See ``QueryServer``, also for errors.
        voxel_map: The map; only ``follow`` and ``hand_over`` read its blocks.
        correction, weights: Take corrected poses and other weights; without them such requests are refused.
        moving: Where something moves now that is left out of the map.
        last_pose: Gives where the last frame was taken.
        before: The map that this one goes on in, as it was.
    """

    def __init__(
        self,
        endpoint: str,
        voxel_map: VoxelMap,
        correction: LiveCorrection | None = None,
        keys: Keys | None = None,
        weights: LiveWeights | questions.Weights | None = None,
        moving: MovingSpace | None = None,
        last_pose: Callable[[], CameraPose | None] = lambda: None,
        before: MapVisit | None = None,
    ) -> None:
        self.map_id = uuid.uuid4().hex
        self._map = voxel_map
        self._correction = correction
        self._weights = weights
        self._moving = moving or MovingSpace()
        self._last_pose = last_pose
        config = voxel_map.config
        self._mirror = MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set)
        self._tracker = InstanceTracker()

        self._copies: deque[CopiedChanges] = deque()  # on their way from the mapper's thread to that of the socket
        self._copied_version = 0
        self._copied_at = self._copy_again_at = 0.0  # monotonic seconds, as ``_listened_until``
        self._listened_until = 0.0
        self._awaited_version = 0  # that questions after a pause wait for
        self._memory_version = -1  # that the next update of the memory waits for; -1 = it is not due
        self._pending: list[_PendingRequest] = []  # in order of arrival, until the answer is sent
        self._closed = threading.Event()
        self._broken = False  # no snapshot can be made, by a bug
        self._map_is_busy = False  # a snapshot did not come in time
        self.answered = 0
        self._server = QueryServer(endpoint, keys=keys)
        self.endpoint = self._server.endpoint
        self._memory = LiveMemory(voxel_map, before, lambda: self._tracker, self._server.wake)
        self._quick, self._long = (ThreadPoolExecutor(1, f"{lane} queries {endpoint}") for lane in ("quick", "long"))
        self._thread = threading.Thread(target=self._serve, name=f"queries {endpoint}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether questions are answered; False before ``close`` only by a bug."""
        return self._thread.is_alive() and not self._broken

    def status(self) -> PartStatus:
        """For the mapper's status."""
        dead = "" if self.alive else "questions about the map are no longer answered; see the log"
        return PartStatus({"answered": self.answered, **self._memory.counters()}, (dead,))

    def follow(self) -> None:
        """Copy what has changed for the next snapshot; for the thread that changes the map, after each step. Costs
        nothing while nobody asks, and never waits."""
        awaited = self._copied_version < max(self._awaited_version, self._memory_version)
        now = time.monotonic()
        wanted = awaited or self._copy_again_at <= now <= self._listened_until
        if wanted and not self._copies and self._copied_version != self._map.version and self.alive:
            self._copy(MAX_BLOCKS)
            self._copy_again_at = now + PERIOD_S

    def hand_over(self) -> None:
        """Copy all that has changed, if there ever was a question, and leave what the map remembers alone; for before
        the map's thread does something long."""
        self._memory_version = -1
        self._memory.rest()
        if self._listened_until and self.alive and self._copied_version != self._map.version:
            self._copy(0)

    def close(self) -> None:
        """End the threads once the answers under way are computed, and free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._server.wake()
        self._thread.join()
        self._memory.close()
        for worker in (self._quick, self._long):
            worker.shutdown(cancel_futures=True)
        self._server.close()

    def _copy(self, limit: int) -> None:
        changes = self._map.copy_changes(self._copied_version, limit)
        self._copied_version = changes.result.version
        self._copies.append(changes)
        self._server.wake()

    # The thread of the socket.

    def _serve(self) -> None:
        _log.info("queries_ready", endpoint=self.endpoint)
        while not self._closed.is_set():
            self._server.wait(_POLL_S)
            self._make_snapshots()
            self._advance()
            # One at a time: the socket takes turns between clients, so that many questions of one delay no other.
            while not self._closed.is_set() and (received := self._server.receive()) is not None:
                self._take(*received)
                self._advance()
        for pending in self._pending:
            if pending.answer is None:
                self._send(pending.address, encode_error(MapError(_NOT_READY)))

    def _make_snapshots(self) -> None:
        try:
            while self._copies and not self._broken:
                self._mirror.apply(self._copies[0].compact())
                self._copies.popleft()
                self._copied_at, self._map_is_busy = time.monotonic(), False
        except Exception:  # noqa: BLE001 -- whatever it is, the mapper continues
            self._broken = True
            _log.exception("snapshot_failed", version=self._copies[0].result.version)

    def _update_memory(self) -> None:
        """Begin an update of what the map remembers, where one is due, once there is a snapshot of the present."""
        if self._memory_version < 0 and self._memory.is_due():
            self._memory_version, self._copied_at = self._map.version, max(self._copied_at, time.monotonic())
        snapshot = self._mirror.snapshot()
        late = self._broken or time.monotonic() > self._copied_at + CATCH_UP_S
        if self._memory_version >= 0 and (late or snapshot.version >= self._memory_version):
            self._memory_version = -1
            self._memory.begin(snapshot)

    def _take(self, address: bytes, parts: list[bytes]) -> None:
        """Pass a question on to a worker, or let it wait for a snapshot."""
        try:
            request = questions.decode_question(parts)
        except (SemanticMapperError, MemoryError) as error:
            self._send(address, _encode_error(error))
            return
        until = time.monotonic() + request.waits_s
        for pending in self._pending:
            if request.asker and pending.parts == parts:  # it timed out and asks again, in its turn
                pending.address, pending.until = address, until
                return
        of_client = sum(pending.address == address for pending in self._pending)
        if of_client >= MAX_OF_CLIENT or len(self._pending) >= MAX_WAITING:
            self._send(address, encode_error(MapError(_TOO_MANY)))
            return
        self._pending.append(_PendingRequest(address, until, parts, request))
        if request.about_map and not request.of_memory:
            now = time.monotonic()
            if now > self._listened_until:  # after a pause, questions wait for a snapshot of the map as it is now
                self._awaited_version, self._copied_at = self._map.version, now
            self._listened_until = now + LISTENED_S

    def _advance(self) -> None:
        """Pass questions on to the workers, but for those that wait for a newer snapshot, and send finished answers."""
        lags = self._mirror.snapshot().version < self._awaited_version
        if lags and (self._broken or time.monotonic() > self._copied_at + CATCH_UP_S):
            self._awaited_version, self._map_is_busy = 0, True  # those who ask next need not wait as well
            lags = False
        for pending in list(self._pending):
            if pending.answer is not None:
                if not pending.answer.done():
                    continue
                self._pending.remove(pending)
                if (answer := pending.answer.result()) is not None:
                    self._send(pending.address, answer)
                    if pending.request.about_map and not pending.request.of_memory:
                        self._listened_until = time.monotonic() + LISTENED_S
            elif self._may_answer(pending.request, lags=lags):
                worker = self._long if self._takes_long(pending.request) else self._quick
                pending.answer = worker.submit(self._answer, pending)
                pending.answer.add_done_callback(lambda _: self._server.wake())
        self._update_memory()

    def _may_answer(self, request: Request[Any], *, lags: bool) -> bool:
        if isinstance(request, questions.ObjectsRequest | questions.FindRequest):
            return self._memory.ready(request.up)
        return not (lags and request.about_map)

    def _takes_long(self, request: Request[Any]) -> bool:
        if not isinstance(request, questions.NearestRequest) or request.class_name in STUFF_NAMES:
            return request.takes_long
        return not self._tracker.knows(self._mirror.snapshot())  # the things of a map that has changed are found first

    def _send(self, address: bytes, parts: Sequence[bytes]) -> None:
        self._server.send(address, parts)
        self.answered += 1

    # The workers.

    def _answer(self, pending: _PendingRequest) -> list[bytes] | None:
        if time.monotonic() > pending.until:
            return None
        request = pending.request
        name = questions.NAMES[type(request)]
        try:
            snapshot = self._memory.last().snapshot if request.of_memory else self._mirror.snapshot()
            if request.about_map and self._map_is_busy and not snapshot.version:
                raise MapError(_NOT_READY)
            state = questions.MapState(self.map_id, snapshot.version, snapshot.epoch)
            return questions.encode_answer(name, state, self._find(snapshot, request))
        except (SemanticMapperError, MemoryError) as error:
            return _encode_error(error)
        except Exception as error:  # noqa: BLE001 -- a bug of ours must not end a thread that all wait for
            _log.exception("question_failed", question=name)
            self._tracker = InstanceTracker()  # one that failed half way is not used again
            return encode_error(MapError(f"the mapper could not compute this: {error}"))

    def _find(self, snapshot: MapSnapshot, request: Request[Any]) -> object:
        _refuse_too_much(snapshot, request)
        match request:
            case questions.InfoRequest():
                about = (snapshot.block_count, snapshot.voxel_size_m, snapshot.truncation_voxels, snapshot.label_set)
                return questions.MapInfo(self.map_id, snapshot.version, snapshot.epoch, *about, snapshot.scale_known)
            case questions.AtRequest():
                return at(snapshot.with_moving(self._moving.points), request.points, request.radius_m)
            case questions.NearestRequest():
                what = request.class_name, request.point, request.min_confidence
                return nearest(snapshot, *what, unsure=request.unsure, up=request.up, tracker=self._tracker)
            case questions.RaysRequest():
                return cast_rays(snapshot, request.origins, request.directions, request.max_m)
            case questions.BoxRequest():
                return points_in_box(snapshot, request.lower, request.upper)
            case questions.InstancesRequest():
                things = self._tracker.find(snapshot, request.up).things
                things += self._tracker.gone if request.gone else ()
                return tuple(thing for thing in things if request.unsure or not thing.unsure)
            case questions.ObjectsRequest():
                return self._memory.last().memory
            case questions.FindRequest():
                known = self._memory.last()
                return find(request.phrase, snapshot, known.memory.objects, up=known.up, limit=request.limit)
            case questions.OccupancyRequest():
                return occupancy(snapshot.with_moving(self._moving.points), request.points)
            case questions.DistanceRequest():
                box, occupied = (request.lower, request.upper), request.unknown_is_occupied
                return distance_field(snapshot.with_moving(self._moving.points), *box, unknown_is_occupied=occupied)
            case questions.ChangesRequest():
                since = request.since if request.map_id in ("", self.map_id) else 0
                return snapshot.changes(since, min(request.limit or MAX_CHANGED_BLOCKS, MAX_CHANGED_BLOCKS))
            case questions.CorrectPosesRequest() | questions.CorrectionRequest():
                if self._correction is None:
                    raise MapError("poses cannot be corrected here: this service only answers questions")
                is_new = isinstance(request, questions.CorrectPosesRequest)
                return self._correction.begin(request) if is_new else self._correction.describe()
            case questions.WeightsRequest():
                if self._weights is None:
                    raise MapError("this mapper takes no weights while it runs (option `learner`)")
                return self._weights.describe() if isinstance(self._weights, LiveWeights) else self._weights
            case questions.PoseRequest():
                return self._last_pose()
            case _:
                raise MapError(f"{type(request).__name__}: cannot be answered")


def _encode_error(error: SemanticMapperError | MemoryError) -> list[bytes]:
    if isinstance(error, MemoryError):
        error = MapError("the mapper has no memory left to answer this; ask for less at once")
    return encode_error(error)


def _refuse_too_much(snapshot: MapSnapshot, request: Request[Any]) -> None:
    match request:
        case questions.AtRequest():
            radius = RADIUS_VOXELS if request.radius_m is None else request.radius_m / snapshot.voxel_size_m
            size = len(request.points) * (2 * min(max(radius, 0), MAX_RADIUS_VOXELS) + 2) ** 3
            limit, what = MAX_VISITED_VOXELS, f"{len(request.points)} points with a radius of {request.radius_m} m"
        case questions.RaysRequest():
            count = max(request.origins.size, request.directions.size) // 3
            size, limit, what = count * request.max_m, MAX_RAY_METRES, f"{count} rays of {request.max_m:g} m"
        case questions.DistanceRequest():
            sides = [(b - a) / snapshot.voxel_size_m for a, b in zip(request.lower, request.upper, strict=True)]
            size, limit = math.prod(sides) if min(sides) > 0 else 0, MAX_FIELD_VOXELS
            what = f"a box of {' x '.join(f'{side:.0f}' for side in sides)} voxels"
        case _:
            return
    if size > limit:
        raise MapError(f"{what}: too much for one question over a socket; ask for less at once, or keep a mirror")
