"""The query service of a mapper: threads that answer questions from a mirror, which the mapper's thread feeds.

One has the socket and answers what is quick, one answers what takes long, one feeds the mirror. So a quick answer waits
for none but quick ones.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType
from typing import Self

import structlog

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.storage.changes import CopiedChanges
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.mapper.live_correction import LiveCorrection
from semantic_mapper.nodes.mapper.live_weights import LiveWeights
from semantic_mapper.nodes.mapper.long_queries import LongQuestions
from semantic_mapper.nodes.mapper.query_answers import Answers, Question
from semantic_mapper.nodes.mapper.query_queue import Asked, WaitingQuestions
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.relay import MirrorRelay
from semantic_mapper.transport.codec import encode_error
from semantic_mapper.transport.query_sockets import QueryServer
from semantic_mapper.transport.security import Keys

PERIOD_S = 0.1  # between two deliveries, at least
MAX_SHARE = 0.1  # of the mapper's time that deliveries may take; the pause after a dear one is longer
ASKED_LATELY_S = 5.0  # without a question for so long, the mirror is fed no more
CATCH_UP_S = 2.0  # how long questions after that wait for the mirror; then they are answered as it is
FIRST_CATCH_UP_S = 60.0  # how long the very first ones wait: kernels may compile, and an empty mirror says nothing true
MAX_BLOCKS = 600  # of a delivery (unless one frame has more): bounds what a step may cost
GRACE_S = 0.5  # in which a client that has waited in vain asks again, and keeps its turn
_WAIT_S = 0.5
_HANDING_OVER_S = 0.005  # between two looks at whether a delivery has been taken
_NOT_READY = "the mapper has not handed its map over to its query service yet: it is busy, or ending; ask again"
_TOO_MANY = "too many questions that take long wait for an answer; ask again later, and await each answer"

_log = structlog.get_logger(__name__)


class QueryService:
    """Answers questions about a map that another thread changes. A context manager.

    Answers are about the map as it was a moment ago (see ``PERIOD_S``, ``MAX_SHARE``), and say about which version.
    While nobody asks, the map is not looked at.

    Args:
        endpoint: Where to listen.
        voxel_map: The map; only ``follow`` reads it.
        correction: Takes corrected poses; without it they are refused.
        weights: Takes other weights; without it questions about them are refused.
        keys: See ``QueryServer``.

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
    ) -> None:
        self._map = voxel_map
        config = voxel_map.config
        self._relay = MirrorRelay(MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set))
        self._answers = Answers(self._relay, correction, weights)
        self._given = 0  # version that deliveries have come to
        self._next_at = 0.0
        self._delivered: deque[CopiedChanges] = deque()
        self._delivery_came = threading.Event()
        self._asked_at = -ASKED_LATELY_S  # never; monotonic seconds
        self._awaited = 0  # version that questions after a pause wait for
        self._patient_until = 0.0
        self._parked = WaitingQuestions()  # for the mirror; nobody else waits for these
        self._overdue = False  # somebody has waited in vain, or would
        self._closed = threading.Event()
        self.answered = 0
        self._server = QueryServer(endpoint, keys=keys)
        self.endpoint = self._server.endpoint
        self._long = LongQuestions(f"long queries {endpoint}", self._answer, self._server.wake)
        self._threads = (
            threading.Thread(target=self._serve, name=f"queries {endpoint}", daemon=True),
            threading.Thread(target=self._feed, name=f"mirror {endpoint}", daemon=True),
        )
        for thread in self._threads:
            thread.start()

    @property
    def alive(self) -> bool:
        """Whether the threads run; they end before ``close`` only by a bug."""
        return self._long.alive and all(thread.is_alive() for thread in self._threads)

    @property
    def asked(self) -> bool:
        """Whether anybody has ever asked about the map."""
        return self._asked_at >= 0

    @property
    def abandoned(self) -> int:
        """Questions that were dropped unanswered, since nobody waited for them any more."""
        return self._long.abandoned + self._parked.abandoned

    def follow(self) -> None:
        """Hand what has changed over to the service; for the thread that changes the map, after each step.

        Costs nothing while nobody asks, and never waits.
        """
        now = time.monotonic()
        if now - self._asked_at > ASKED_LATELY_S or self._delivered or self._given == self._map.version:
            return
        if self._given >= self._awaited and now < self._next_at:
            return
        self._deliver()
        self._next_at = now + max(PERIOD_S, (time.monotonic() - now) / MAX_SHARE)

    def hand_over_all(self, within_s: float) -> bool:
        """Hand all of the map over where somebody has ever asked: before its thread does something that takes long.

        Returns:
            Whether the service has it; False where nobody has asked, or it was not to be done in ``within_s`` seconds.
        """
        if not self.asked:
            self._overdue = True  # whoever asks first from now on is told so at once
            return False
        deadline = time.monotonic() + within_s
        while self._delivered or self._given != self._map.version:
            if time.monotonic() > deadline or not self.alive:
                return False
            if self._delivered:
                time.sleep(_HANDING_OVER_S)
            else:
                self._deliver()
        return True

    def close(self) -> None:
        """End the threads and free the endpoint. Harmless when repeated."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._server.wake()
        self._delivery_came.set()
        for thread in self._threads:
            thread.join()
        self._long.close()
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _deliver(self) -> None:
        changes = self._map.copy_changes(self._given, MAX_BLOCKS)
        self._given = changes.version
        self._delivered.append(changes)
        self._delivery_came.set()

    def _serve(self) -> None:
        _log.info("questions_welcome", endpoint=self.endpoint)
        while not self._closed.is_set():
            self._server.wait(_WAIT_S / 10 if self._parked else _WAIT_S)
            self._send_long_ones()
            self._let_in()
            # One at a time: the socket takes turns between clients, so that many questions of one delay no other.
            while not self._closed.is_set() and (came := self._server.receive()) is not None:
                self._take(*came)
                self._send_long_ones()
        while (asked := self._parked.pop()) is not None:
            self._send(asked.client, encode_error(MapError(_NOT_READY)))

    def _take(self, client: bytes, parts: list[bytes]) -> None:
        """Answer a question, or let it wait: for the mirror, or because it takes long."""
        question = self._answers.read(parts)
        header = question.header
        until = time.monotonic() + header.waits_s + GRACE_S
        asked = Asked(client, header.asker.encode(), until, parts, question)
        if question.about_map:
            self._note_question()
        if self._parked.holds(asked.lane) or (question.about_map and self._mirror_lags()):
            if not self._parked.put(asked):
                self._send(client, encode_error(MapError(_TOO_MANY)))
        else:
            self._pass_on(asked)

    def _let_in(self) -> None:
        """Answer what has waited for the mirror, once it is there or will not come in time."""
        self._parked.drop_late()
        if not self._parked:
            return
        self._asked_at = time.monotonic()  # so that the mirror is fed as long as somebody waits for it
        if self._mirror_lags():
            return
        while (asked := self._parked.pop()) is not None:
            self._parked.done(asked)
            self._pass_on(asked)

    def _pass_on(self, asked: Asked) -> None:
        question = asked.question
        if question.about_map and self._overdue and not self._relay.snapshot().version:
            self._send(asked.client, encode_error(MapError(_NOT_READY)))
        elif not question.takes_long and not self._long.holds(asked.lane):
            self._send(asked.client, self._answer(question))
        elif not self._long.put(asked):
            self._send(asked.client, encode_error(MapError(_TOO_MANY)))

    def _answer(self, question: Question) -> list[bytes]:
        return question.answer()

    def _send(self, client: bytes, parts: list[bytes]) -> None:
        self._server.send(client, parts)
        self.answered += 1

    def _send_long_ones(self) -> None:
        for client, parts in self._long.collect():
            self._send(client, parts)

    def _note_question(self) -> None:
        """After a pause, questions wait until the mirror has come up to the map as it is now."""
        now = time.monotonic()
        if now - self._asked_at > ASKED_LATELY_S:
            self._awaited = self._map.version
            self._patient_until = now + (CATCH_UP_S if self._relay.snapshot().version else FIRST_CATCH_UP_S)
        self._asked_at = now

    def _mirror_lags(self) -> bool:
        version = self._relay.snapshot().version
        if version >= self._awaited:
            return False
        if time.monotonic() > self._patient_until or (self._overdue and not version):
            # The map is at rest or busy: those who ask next need not wait as well.
            self._awaited, self._overdue = 0, True
            return False
        return True

    def _feed(self) -> None:
        while not self._closed.is_set():
            self._delivery_came.wait()
            self._delivery_came.clear()
            self._take_deliveries()
            self._server.wake()

    def _take_deliveries(self) -> None:
        while self._delivered:
            self._relay.apply(self._delivered[0].compact())
            self._delivered.popleft()  # only now may the next one come
