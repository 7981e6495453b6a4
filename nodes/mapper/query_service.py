"""The query service of a mapper: answers requests from snapshots of the map.

One thread owns the socket and answers what is quick. One worker answers what takes long, in the order of arrival, and
one makes snapshots from the blocks that the mapper's thread copies for it. So a quick answer waits for quick ones only,
and the mapper for none.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import structlog

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.moving import MovingSpace
from semantic_mapper.mapping.storage.changes import CopiedChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.mapping.worlds import Whereabouts
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_weights import LiveWeights
from semantic_mapper.nodes.mapper.query_answers import Answers, Question
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.transport.codec import encode_error
from semantic_mapper.transport.keys import Keys
from semantic_mapper.transport.query_messages import ChangesRequest, Request
from semantic_mapper.transport.query_sockets import QueryServer

PERIOD_S = 0.1  # between two snapshots, at least
MAX_FRACTION = 0.1  # of the mapper's time that copying may take; the pause after a costly copy is longer
MAX_BLOCKS = 600  # in one copy (unless one frame has more): bounds what a step may cost
ASKED_LATELY_S = 5.0  # without a request for so long, no more snapshots are made
MIRRORED_LATELY_S = 0.25  # the same after requests for changes: who mirrors a map now and then waits for a snapshot
CATCH_UP_S = 2.0  # how long requests after such a pause wait for a snapshot of the present map
FIRST_CATCH_UP_S = 60.0  # how long the very first ones wait: there is no snapshot yet to answer them from
MAX_PENDING = 64  # requests of all clients together
MAX_PENDING_OF_CLIENT = 8
GRACE_S = 0.5  # in which a client whose request timed out asks again, and keeps its place
CLOSE_S = 5.0  # how long ``close`` waits for an answer that is being computed
_POLL_S = 0.5
_CATCH_UP_POLL_S = 0.05
_HAND_OVER_POLL_S = 0.005
_NOT_READY = "the mapper has not handed its map over to its query service yet: it is busy, or ending; ask again"
_TOO_MANY = "too many questions that take long wait for an answer; ask again later, and await each answer"

_log = structlog.get_logger(__name__)


@dataclass(slots=True, eq=False)
class _PendingRequest:
    """A request that waits for a snapshot or for the worker, or that the worker answers.

    Args:
        client: Its name, or its address where it gives none.
        address: Socket that the answer goes to.
        until: When the client stops waiting, monotonic seconds.
        parts: Of the request; the same where a client asks again.
        question: What the parts mean.
        started: Whether the worker computes the answer.
        answer: Its parts; None where nobody waits for it any more.
    """

    client: bytes
    address: bytes
    until: float
    parts: list[bytes]
    question: Question
    started: bool = False
    answer: list[bytes] | None = None


class QueryService:
    """Answers requests about a map that another thread changes. A context manager.

    Answers are about the map as it was a moment ago (see ``PERIOD_S``, ``MAX_FRACTION``), and say about which version.
    While nobody asks, no snapshots are made; for who mirrors the map once a second, say, one at a time.

    Args:
        endpoint: Where to listen.
        voxel_map: The map; only ``follow`` reads it.
        correction: Takes corrected poses; without it they are refused.
        weights: Takes other weights; without it requests about them are refused.
        keys: See ``QueryServer``.
        moving, whereabouts: See ``Answers``.

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
        whereabouts: Whereabouts | None = None,
    ) -> None:
        self._map = voxel_map
        config = voxel_map.config
        self._mirror = MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set)
        self._answers = Answers(self._mirror, correction, weights, moving, whereabouts)
        self._copied_version = 0
        self._copy_again_at = 0.0
        self.asked = False  # whether anybody has ever asked about the map
        self._wanted_until = 0.0  # snapshots; monotonic seconds
        self._wanted_s = 0.0  # after the last request, or its answer
        self._awaited_version = 0  # that requests after a pause wait for
        self._catch_up_until = 0.0
        self._map_is_busy = False  # a snapshot did not come in time, or cannot
        # Of each client, in order of arrival, until the answer is sent. Used by the socket's thread alone.
        self._pending: dict[bytes, list[_PendingRequest]] = {}
        self._catching_up: deque[_PendingRequest] = deque()  # those that wait for a snapshot
        self._finished: deque[_PendingRequest] = deque()  # from the worker
        self._closed = threading.Event()
        self._lock = threading.Lock()  # of pending requests that the worker takes, and of ``wake`` against ``close``
        self.answered = 0
        self.abandoned = 0  # requests dropped because nobody waited for the answer any more
        self._server = QueryServer(endpoint, keys=keys)
        self.endpoint = self._server.endpoint
        self._long_queries = ThreadPoolExecutor(1, f"long queries {endpoint}")
        self._snapshots = ThreadPoolExecutor(1, f"snapshots {endpoint}")
        self._snapshot: Future[None] = Future()  # the one being made
        self._snapshot.set_result(None)
        self._thread = threading.Thread(target=self._serve, name=f"queries {endpoint}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether requests are answered; False before ``close`` only by a bug."""
        made = self._snapshot
        return self._thread.is_alive() and (not made.done() or made.exception() is None)

    def follow(self) -> None:
        """Copy what has changed for the next snapshot; for the thread that changes the map, after each step.

        Costs nothing while nobody asks, and never waits.
        """
        now = time.monotonic()
        wanted = bool(self._catching_up) or now <= self._wanted_until
        if not wanted or not self._snapshot.done() or self._copied_version == self._map.version or not self.alive:
            return
        if self._copied_version >= self._awaited_version and now < self._copy_again_at:
            return
        self._copy_changes()
        self._copy_again_at = now + max(PERIOD_S, (time.monotonic() - now) / MAX_FRACTION)

    def hand_over_all(self, within_s: float) -> bool:
        """Make a snapshot of the whole map if anybody has ever asked; for before its thread does something long.

        Returns:
            Whether there is one; False where nobody has asked, or it was not made within ``within_s`` seconds.
        """
        if not self.asked:
            self._map_is_busy = True
            return False
        deadline = time.monotonic() + within_s
        while not self._snapshot.done() or self._copied_version != self._map.version:
            if time.monotonic() > deadline or not self.alive:
                return False
            if self._snapshot.done():
                self._copy_changes()
            else:
                time.sleep(_HAND_OVER_POLL_S)
        return self.alive

    def close(self) -> None:
        """End the threads and free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        with self._lock:
            self._closed.set()
            self._server.wake()
        self._thread.join()
        self._snapshots.shutdown()
        if wait([self._long_queries.submit(lambda: None)], CLOSE_S).not_done:
            _log.warning("answer_left_behind", waited_s=CLOSE_S)
        self._long_queries.shutdown(wait=False)
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _copy_changes(self) -> None:
        changes = self._map.copy_changes(self._copied_version, MAX_BLOCKS)
        self._copied_version = changes.version
        self._snapshot = self._snapshots.submit(self._make_snapshot, changes)

    def _make_snapshot(self, changes: CopiedChanges) -> None:
        try:
            self._mirror.apply(changes.compact())
        except Exception:
            _log.exception("snapshot_failed", version=changes.version)
            raise
        self._wake()

    def _wake(self) -> None:
        with self._lock:
            if not self._closed.is_set():
                self._server.wake()

    def _serve(self) -> None:
        _log.info("queries_ready", endpoint=self.endpoint)
        while not self._closed.is_set():
            self._server.wait(_CATCH_UP_POLL_S if self._catching_up else _POLL_S)
            self._send_finished()
            self._stop_catching_up()
            # One at a time: the socket takes turns between clients, so that many requests of one delay no other.
            while not self._closed.is_set() and (received := self._server.receive()) is not None:
                self._take(*received)
                self._send_finished()
        for request in self._catching_up:
            self._send(request.address, encode_error(MapError(_NOT_READY)))

    def _take(self, address: bytes, parts: list[bytes]) -> None:
        """Answer a request, or let it wait: for a snapshot, for the worker, or for the client's request before it."""
        question = self._answers.read(parts)
        asked = question.request
        if question.about_map:
            self._note_question(asked)
        lags = question.about_map and self._snapshot_lags()
        client = asked.asker.encode() or address
        if not (lags or question.takes_long or client in self._pending):
            self._send(address, self._answer(question))
            return
        request = _PendingRequest(client, address, time.monotonic() + asked.waits_s + GRACE_S, parts, question)
        if asked.asker and self._replace_last(request):
            return
        earlier = self._pending.get(client, [])
        if len(earlier) >= MAX_PENDING_OF_CLIENT or sum(map(len, self._pending.values())) >= MAX_PENDING:
            self._send(address, encode_error(MapError(_TOO_MANY)))
            return
        self._pending[client] = [*earlier, request]
        if lags or any(other in self._catching_up for other in earlier):
            self._catching_up.append(request)
        else:
            self._long_queries.submit(self._work, request)

    def _replace_last(self, request: _PendingRequest) -> bool:
        """Let a client that awaits each answer ask again, or something else, in the place of its last request.

        Returns:
            False where it has none, or where the answer to another question is being computed.
        """
        if request.client not in self._pending:
            return False
        last = self._pending[request.client][-1]
        with self._lock:
            if last.parts != request.parts:
                if last.started:
                    return False
                self.abandoned += 1
            last.address, last.until = request.address, request.until
            last.parts, last.question = request.parts, request.question
        return True

    def _stop_catching_up(self) -> None:
        """Pass on the requests that wait for a snapshot, once it is there or will not come in time."""
        if not self._catching_up or self._snapshot_lags():
            return
        self._want_snapshots()
        while self._catching_up:
            self._long_queries.submit(self._work, self._catching_up.popleft())

    def _work(self, request: _PendingRequest) -> None:
        with self._lock:
            request.started = True
            wanted = not self._closed.is_set() and time.monotonic() <= request.until
        if wanted:
            request.answer = self._answer(request.question)
        self._finished.append(request)
        self._wake()

    def _send_finished(self) -> None:
        while self._finished:
            request = self._finished.popleft()
            self._pending[request.client].remove(request)
            if not self._pending[request.client]:
                del self._pending[request.client]
            if request.answer is None:
                self.abandoned += 1
            else:
                self._send(request.address, request.answer)

    def _answer(self, question: Question) -> list[bytes]:
        if question.about_map and self._map_is_busy and not self._mirror.snapshot().version:
            return encode_error(MapError(_NOT_READY))
        return question.answer()

    def _send(self, address: bytes, parts: list[bytes]) -> None:
        self._server.send(address, parts)
        self.answered += 1

    def _want_snapshots(self) -> None:
        self._wanted_until = max(self._wanted_until, time.monotonic() + self._wanted_s)

    def _note_question(self, request: Request) -> None:
        """After a pause, requests wait until there is a snapshot of the map as it is now."""
        now = time.monotonic()
        if now > self._wanted_until:
            self._awaited_version = self._map.version
            self._catch_up_until = now + (CATCH_UP_S if self._mirror.snapshot().version else FIRST_CATCH_UP_S)
        self.asked = True
        self._wanted_s = MIRRORED_LATELY_S if isinstance(request, ChangesRequest) else ASKED_LATELY_S
        self._want_snapshots()

    def _snapshot_lags(self) -> bool:
        """Whether requests should wait for a newer snapshot."""
        version = self._mirror.snapshot().version
        if version >= self._awaited_version:
            return False
        if time.monotonic() <= self._catch_up_until and (version or not self._map_is_busy):
            return True
        self._awaited_version, self._map_is_busy = 0, True  # those who ask next need not wait as well
        return False
