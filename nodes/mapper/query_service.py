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
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple, Self

import structlog

from semantic_mapper.errors import MapError, SemanticMapperError
from semantic_mapper.mapping.map_types import PoseInMap
from semantic_mapper.mapping.moving import MovingSpace
from semantic_mapper.mapping.storage.changes import CopiedChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_weights import LiveWeights
from semantic_mapper.nodes.publishing import PartStatus
from semantic_mapper.queries import questions
from semantic_mapper.queries.instances import Instance, InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.nearest import MAX_RADIUS_VOXELS, RADIUS_VOXELS, at, nearest
from semantic_mapper.queries.occupancy import distance_field, occupancy
from semantic_mapper.queries.questions import NAMES, InstanceArrays, MapInfo, Point, decode_question
from semantic_mapper.queries.rays import cast_rays
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import points_in_box
from semantic_mapper.transport.keys import Keys
from semantic_mapper.transport.query_messages import (
    MapState,
    Request,
    encode_answer,
    encode_error,
)
from semantic_mapper.transport.query_sockets import QueryServer

PERIOD_S = 0.1  # between two snapshots, at least
MAX_BLOCKS = 600  # copied between two frames (unless one frame has more): bounds what a step may cost
LISTENED_S = 1.0  # without a question for so long, no more snapshots are made
CATCH_UP_S = 4.0  # without another copy for so long, questions wait no longer for the present map
MAX_WAITING, MAX_OF_CLIENT = 64, 8  # questions that wait, of all clients and of one
# What would keep the others waiting for more than about a second is refused.
MAX_VISITED_VOXELS = 1e8  # of `at`
MAX_RAY_METRES = 2e5  # of `cast_rays`, all rays together
MAX_FIELD_VOXELS = 1 << 22  # of `distance_field`
MAX_CHANGED_BLOCKS = 1 << 14  # of `changes`, unless one version has more
_MAX_TRACKERS = 4  # one for each direction that was called up
_POLL_S = 0.5
_NOT_READY = "the mapper has not handed its map over to its query service yet: it is busy, or ending; ask again"
_TOO_MANY = "too many questions wait for an answer; ask again later, and await each answer"

_log = structlog.get_logger(__name__)


@dataclass(slots=True, eq=False)
class _PendingRequest:
    """A question that waits for a snapshot or a worker, or that one answers.

    Args:
        client: Its name, or its address where it gives none.
        address: Socket that the answer goes to.
        until: When the client stops waiting, monotonic seconds.
        parts: As they came.
        request: What they mean.
        lane: Number of the worker; -1 = it waits for a snapshot.
        answer: Its parts; None where nobody waits for it any more.
    """

    client: bytes
    address: bytes
    until: float
    parts: list[bytes]
    request: Request[Any]
    lane: int = -1
    answer: list[bytes] | None = None


class _Tracked(NamedTuple):
    """A tracker, and what it found last: in which version of the map."""

    tracker: InstanceTracker
    version: int
    things: tuple[Instance, ...]
    gone: tuple[Instance, ...]


class QueryService:
    """Answers questions about a map that another thread changes. A context manager.

    Answers are about the map as it was a moment ago, and say about which version. Without questions there are no
    snapshots.

    Args:
        endpoint: Where to listen.
        voxel_map: The map; only ``follow`` and ``hand_over`` read it.
        correction: Takes corrected poses; without it they are refused.
        keys: See ``QueryServer``.
        weights: Takes other weights; without it questions about them are refused.
        moving: Where something moves now that is left out of the map.
        pose_in_map: Pose of the last frame.

    Raises:
        TransportError: the endpoint is taken or cannot be bound.
    """

    def __init__(
        self,
        endpoint: str,
        voxel_map: VoxelMap,
        correction: LiveCorrection | None = None,
        keys: Keys | None = None,
        weights: LiveWeights | None = None,
        moving: MovingSpace | None = None,
        pose_in_map: PoseInMap | None = None,
    ) -> None:
        self.map_id = uuid.uuid4().hex
        self._map = voxel_map
        self._correction = correction
        self._weights = weights
        self._moving = moving
        self._pose_in_map = pose_in_map or PoseInMap()
        config = voxel_map.config
        self._mirror = MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set)
        self._tracked: dict[Point, _Tracked] = {}  # by direction; the last one used stands last

        self._copies: deque[CopiedChanges] = deque()  # on their way from the mapper's thread to that of the socket
        self._copied_version = 0
        self._copy_again_at = 0.0
        self._copied_at = 0.0
        self.used = False  # whether there ever was a question about the map
        self._listened_until = 0.0  # monotonic seconds
        self._awaited_version = 0  # that questions after a pause wait for

        self._pending: list[_PendingRequest] = []  # in order of arrival, until the answer is sent
        self._finished: deque[_PendingRequest] = deque()  # from the workers
        self._closed = threading.Event()
        self._broken = False  # no snapshot can be made, by a bug
        self._map_is_busy = False  # a snapshot did not come in time
        self.answered = 0
        self.abandoned = 0  # questions dropped because nobody waited for the answer any more
        self._server = QueryServer(endpoint, keys=keys)
        self.endpoint = self._server.endpoint
        self._workers = [ThreadPoolExecutor(1, f"{lane} queries {endpoint}") for lane in ("quick", "long")]
        self._thread = threading.Thread(target=self._serve, name=f"queries {endpoint}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether questions are answered; False before ``close`` only by a bug."""
        return self._thread.is_alive() and not self._broken

    def status(self) -> PartStatus:
        """For the mapper's status."""
        dead = () if self.alive else ("questions about the map are no longer answered; see the log",)
        return PartStatus({"answered": self.answered, "abandoned": self.abandoned}, dead)

    def follow(self) -> None:
        """Copy what has changed for the next snapshot; for the thread that changes the map, after each step.

        Costs nothing while nobody asks, and never waits.
        """
        now = time.monotonic()
        wanted = now <= self._listened_until or self._copied_version < self._awaited_version
        if not wanted or self._copies or self._copied_version == self._map.version or not self.alive:
            return
        if self._copied_version < self._awaited_version or now >= self._copy_again_at:
            self._copy(MAX_BLOCKS)
            self._copy_again_at = now + PERIOD_S

    def hand_over(self) -> None:
        """Copy all that has changed, if there ever was a question; for before the map's thread does something long."""
        if self.used and self.alive and self._copied_version != self._map.version:
            self._copy(0)

    def close(self) -> None:
        """End the threads and free the endpoint, once the answers that are being computed are. Harmless when
        repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._server.wake()
        self._thread.join()
        for worker in self._workers:
            worker.shutdown(cancel_futures=True)
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _copy(self, limit: int) -> None:
        changes = self._map.copy_changes(self._copied_version, limit)
        self._copied_version = changes.version
        self._copies.append(changes)
        self._server.wake()

    # The thread of the socket.

    def _serve(self) -> None:
        _log.info("queries_ready", endpoint=self.endpoint)
        while not self._closed.is_set():
            self._server.wait(_POLL_S)
            self._make_snapshots()
            self._start_waiting()
            self._send_finished()
            # One at a time: the socket takes turns between clients, so that many questions of one delay no other.
            while not self._closed.is_set() and (received := self._server.receive()) is not None:
                self._take(*received)
                self._send_finished()
        for request in self._pending:
            if request.lane < 0:
                self._send(request.address, encode_error(MapError(_NOT_READY)))

    def _make_snapshots(self) -> None:
        try:
            while self._copies and not self._broken:
                self._mirror.apply(self._copies[0].compact())
                self._copies.popleft()
                self._copied_at = time.monotonic()
                self._map_is_busy = False
        except Exception:  # noqa: BLE001 -- whatever it is, the mapper continues
            self._broken = True
            _log.exception("snapshot_failed", version=self._copies[0].version)

    def _take(self, address: bytes, parts: list[bytes]) -> None:
        """Pass a question on to a worker, or let it wait for a snapshot."""
        try:
            request = decode_question(parts)
        except (SemanticMapperError, MemoryError) as error:
            self._send(address, encode_error(_to_error(error)))
            return
        client, until = request.asker.encode() or address, time.monotonic() + request.waits_s
        earlier = [pending for pending in self._pending if pending.client == client]
        if request.asker and earlier and earlier[-1].parts == parts:  # it timed out and asks again, in its turn
            earlier[-1].address, earlier[-1].until = address, until
            return
        if len(earlier) >= MAX_OF_CLIENT or len(self._pending) >= MAX_WAITING:
            self._send(address, encode_error(MapError(_TOO_MANY)))
            return
        if request.asker and earlier:  # it awaits each answer, and no longer that one
            earlier[-1].until = 0.0
        pending = _PendingRequest(client, address, until, parts, request)
        self._pending.append(pending)
        if request.about_map:
            self._note_question()
        if not (request.about_map and self._snapshot_lags()):
            self._start(pending)

    def _note_question(self) -> None:
        """After a pause, questions wait until there is a snapshot of the map as it is now."""
        now = time.monotonic()
        if now > self._listened_until:
            self._awaited_version, self._copied_at = self._map.version, now
        self.used = True
        self._listened_until = now + LISTENED_S

    def _snapshot_lags(self) -> bool:
        """Whether questions wait for a newer snapshot."""
        if self._mirror.snapshot().version >= self._awaited_version:
            return False
        if time.monotonic() <= self._copied_at + CATCH_UP_S and not self._broken:
            return True
        self._awaited_version, self._map_is_busy = 0, True  # those who ask next need not wait as well
        return False

    def _start_waiting(self) -> None:
        """Pass on the questions that wait for a snapshot, once it is there or will not come in time."""
        waiting = [pending for pending in self._pending if pending.lane < 0]
        if waiting and not self._snapshot_lags():
            for pending in waiting:
                self._start(pending)

    def _start(self, pending: _PendingRequest) -> None:
        """Answers to one client come in the order of its questions, so that all that wait go to the same worker."""
        same_client = [other for other in self._pending if other.client == pending.client]
        before = same_client[: same_client.index(pending)]
        lane = before[-1].lane if before else int(pending.request.takes_long)
        if lane >= 0:
            pending.lane = lane
            self._workers[lane].submit(self._work, pending)

    def _send_finished(self) -> None:
        while self._finished:
            pending = self._finished.popleft()
            self._pending.remove(pending)
            if pending.answer is None:
                self.abandoned += 1
            else:
                self._send(pending.address, pending.answer)
                if pending.request.about_map:
                    self._listened_until = time.monotonic() + LISTENED_S

    def _send(self, address: bytes, parts: Sequence[bytes]) -> None:
        self._server.send(address, parts)
        self.answered += 1

    # The workers.

    def _work(self, pending: _PendingRequest) -> None:
        if time.monotonic() <= pending.until:
            pending.answer = self._answer(pending.request)
        self._finished.append(pending)
        self._server.wake()

    def _answer(self, request: Request[Any]) -> list[bytes]:
        name, snapshot = NAMES[type(request)], self._mirror.snapshot()
        try:
            if request.about_map and self._map_is_busy and not snapshot.version:
                raise MapError(_NOT_READY)
            state = MapState(self.map_id, snapshot.version, snapshot.epoch)
            return encode_answer(name, state, self._find(snapshot, request))
        except (SemanticMapperError, MemoryError) as error:
            return encode_error(_to_error(error))
        except Exception as error:  # noqa: BLE001 -- a bug of ours must not end a thread that all wait for
            _log.exception("question_failed", question=name)
            return encode_error(MapError(f"the mapper could not compute this: {error}"))

    def _find(self, snapshot: MapSnapshot, request: Request[Any]) -> object:
        match request:
            case questions.InfoRequest():
                return self._describe(snapshot)
            case questions.AtRequest():
                _bound_points(snapshot, request)
                return at(self._with_moving(snapshot), request.points, request.radius_m)
            case questions.NearestRequest():
                return nearest(snapshot, request.class_name, request.point, request.min_confidence)
            case questions.RaysRequest():
                _bound_rays(request)
                return cast_rays(snapshot, request.origins, request.directions, request.max_m)
            case questions.BoxRequest():
                return points_in_box(snapshot, request.lower, request.upper)
            case questions.InstancesRequest():
                return self._find_instances(snapshot, request)
            case questions.OccupancyRequest():
                return occupancy(self._with_moving(snapshot), request.points)
            case questions.DistanceRequest():
                _bound_field(snapshot, request)
                box = request.lower, request.upper
                return distance_field(
                    self._with_moving(snapshot), *box, unknown_is_occupied=request.unknown_is_occupied
                )
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
                return self._weights.describe() if request.to is None else self._weights.return_to(request.to)
            case questions.PoseRequest():
                return self._pose_in_map.last
            case _:
                raise MapError(f"{type(request).__name__}: cannot be answered")

    def _with_moving(self, snapshot: MapSnapshot) -> MapSnapshot:
        return snapshot if self._moving is None else snapshot.with_moving(self._moving.points)

    def _describe(self, snapshot: MapSnapshot) -> MapInfo:
        return MapInfo(
            self.map_id,
            snapshot.version,
            snapshot.epoch,
            snapshot.block_count,
            snapshot.voxel_size_m,
            snapshot.truncation_voxels,
            snapshot.label_set,
            snapshot.scale_known,
        )

    def _find_instances(self, snapshot: MapSnapshot, request: questions.InstancesRequest) -> InstanceArrays:
        up = request.up
        tracked = self._tracked.pop(up, None)  # out of here while it updates: one that fails half way is not used again
        if tracked is None or tracked.version != snapshot.version:
            tracker = tracked.tracker if tracked else InstanceTracker(up=up)
            tracked = _Tracked(tracker, snapshot.version, tracker.update(snapshot), tracker.gone)
        self._tracked[up] = tracked
        for old in list(self._tracked)[:-_MAX_TRACKERS]:
            del self._tracked[old]
        things = (*tracked.things, *tracked.gone) if request.gone else tracked.things
        return InstanceArrays.of(things, snapshot.label_set)


def _to_error(error: SemanticMapperError | MemoryError) -> SemanticMapperError:
    if isinstance(error, MemoryError):
        return MapError("the mapper has no memory left to answer this; ask for less at once")
    return error


def _bound_points(snapshot: MapSnapshot, request: questions.AtRequest) -> None:
    radius = RADIUS_VOXELS if request.radius_m is None else request.radius_m / snapshot.voxel_size_m
    visited = len(request.points) * (2 * min(max(radius, 0), MAX_RADIUS_VOXELS) + 2) ** 3
    if visited > MAX_VISITED_VOXELS:
        raise MapError(
            f"at: {len(request.points)} points with a radius of {request.radius_m} m are too much for one question; "
            "ask for fewer points at once, or keep a mirror"
        )


def _bound_rays(request: questions.RaysRequest) -> None:
    count = max(request.origins.size, request.directions.size) // 3
    if count * request.max_m > MAX_RAY_METRES:
        raise MapError(
            f"cast_rays: {count} rays of {request.max_m:g} m are too much for one question; at most "
            f"{MAX_RAY_METRES:g} m together, or keep a mirror"
        )


def _bound_field(snapshot: MapSnapshot, request: questions.DistanceRequest) -> None:
    sides = [(b - a) / snapshot.voxel_size_m for a, b in zip(request.lower, request.upper, strict=True)]
    if min(sides) > 0 and math.prod(sides) > MAX_FIELD_VOXELS:
        raise MapError(
            f"distance_field: a box of {' x '.join(f'{s:.0f}' for s in sides)} voxels; over a socket at most "
            f"{MAX_FIELD_VOXELS} are computed at once; keep a mirror for more"
        )
