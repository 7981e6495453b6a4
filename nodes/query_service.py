"""The query service of a mapper: a thread that answers questions from a mirror, which the mapper's thread feeds."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType
from typing import Self

import structlog

from nodes.live_correction import LiveCorrection
from nodes.query_answers import Answers, is_about_map
from semantic_mapper.mapping.changes import CopiedChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.relay import MirrorRelay
from semantic_mapper.queries.warm_up import warm_up
from semantic_mapper.transport.query_sockets import QueryServer

PERIOD_S = 0.1  # between two deliveries, at least
MAX_SHARE = 0.1  # of the mapper's time that deliveries may take; the pause after a dear one is longer
ASKED_LATELY_S = 5.0  # without a question for so long, the mirror is fed no more
CATCH_UP_S = 2.0  # how long the first question after that waits for the mirror; then it is answered as it is
FIRST_CATCH_UP_S = 60.0  # how long the very first one waits: kernels may compile, and an empty mirror says nothing true
MAX_BLOCKS = 600  # of a delivery (unless one frame has more): bounds what a step may cost
_WAIT_S = 0.5

_log = structlog.get_logger(__name__)


class QueryService:
    """Answers questions about a map that another thread changes. A context manager.

    Answers are about the map as it was a moment ago (see ``PERIOD_S``, ``MAX_SHARE``), and say about which version.
    While nobody asks, the map is not looked at.

    Args:
        endpoint: Where to listen.
        voxel_map: The map; only ``follow`` reads it.
        correction: Takes corrected poses; without it they are refused.

    Raises:
        TransportError: the endpoint is taken or cannot be bound.
    """

    def __init__(self, endpoint: str, voxel_map: VoxelMap, correction: LiveCorrection | None = None) -> None:
        self._map = voxel_map
        config = voxel_map.config
        self._relay = MirrorRelay(MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set))
        self._answers = Answers(self._relay, correction)
        self._given = 0  # version that deliveries have come to
        self._next_at = 0.0
        self._delivered: deque[CopiedChanges] = deque()
        self._asked_at = -ASKED_LATELY_S  # never; monotonic seconds
        self._awaited = 0  # version that the first question after a pause waits for
        self._closed = threading.Event()
        self.answered = 0
        self._server = QueryServer(endpoint)
        self.endpoint = self._server.endpoint
        self._thread = threading.Thread(target=self._serve, name=f"queries {endpoint}", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs; it ends before ``close`` only by a bug."""
        return self._thread.is_alive()

    def follow(self) -> None:
        """Hand what has changed over to the service; for the thread that changes the map, after each step.

        Costs nothing while nobody asks, and never waits.
        """
        now = time.monotonic()
        if now - self._asked_at > ASKED_LATELY_S or self._delivered or self._given == self._map.version:
            return
        if self._given >= self._awaited and now < self._next_at:
            return
        changes = self._map.copy_changes(self._given, MAX_BLOCKS)
        self._given = changes.version
        self._next_at = now + max(PERIOD_S, (time.monotonic() - now) / MAX_SHARE)
        self._delivered.append(changes)
        self._server.wake()

    def close(self) -> None:
        """End the thread and free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._server.wake()
        self._thread.join()
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _serve(self) -> None:
        warm_up()
        _log.info("questions_welcome", endpoint=self.endpoint)
        while not self._closed.is_set():
            self._server.wait(_WAIT_S)
            self._take_deliveries()
            # One at a time: the socket takes turns between clients, so that many questions of one delay no other.
            while not self._closed.is_set() and (asked := self._server.receive()) is not None:
                client, parts = asked
                if is_about_map(parts):
                    self._await_mirror()
                self._server.send(client, self._answer(parts))
                self.answered += 1
                self._take_deliveries()

    def _answer(self, parts: list[bytes]) -> list[bytes]:
        return self._answers.answer(parts)

    def _await_mirror(self) -> None:
        """After a pause, wait until the mirror has come up to the map as it is now."""
        now = time.monotonic()
        if now - self._asked_at > ASKED_LATELY_S:
            self._awaited = self._map.version
        self._asked_at = now
        patience = CATCH_UP_S if self._relay.snapshot().version else FIRST_CATCH_UP_S
        while self._relay.snapshot().version < self._awaited and not self._closed.is_set():
            if time.monotonic() > now + patience:
                self._awaited = 0  # the map is at rest or busy: those who ask next need not wait as well
                return
            self._server.wait_for_wake(_WAIT_S / 10)
            self._take_deliveries()

    def _take_deliveries(self) -> None:
        while self._delivered:
            self._relay.apply(self._delivered[0].compact())
            self._delivered.popleft()  # only now may the next one come
