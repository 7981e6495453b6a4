"""Questions whose answers take long: a thread of their own, so that they hold up none but each other."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable

import structlog

MAX_WAITING = 64  # of all clients together
MAX_OF_CLIENT = 8  # of one client; who awaits each answer has one
CLOSE_S = 5.0  # what a question under way may still take at the end

_log = structlog.get_logger(__name__)

Answer = Callable[[], list[bytes]]


class LongQuestions:
    """Answers questions one after another, of each client in the order in which they came; clients take turns.

    One thread asks and collects; it is woken when an answer is there.

    Args:
        name: Of the thread.
        wake: Wakes the thread that collects; not called after ``close``.
    """

    def __init__(self, name: str, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lanes: dict[bytes, deque[Answer]] = {}  # of clients with questions that wait; the first has its turn
        self._finished: deque[tuple[bytes, list[bytes]]] = deque()
        self._pending: Counter[bytes] = Counter()  # not collected yet
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs; it ends before ``close`` only by a bug."""
        return self._thread.is_alive()

    def holds(self, client: bytes) -> bool:
        """Whether an answer for this client is still to be collected; what it asks next must wait its turn here."""
        return client in self._pending

    def put(self, client: bytes, answer: Answer) -> bool:
        """Have a question answered; False where too many wait already.

        Args:
            client: Who asks.
            answer: Gives the answer; must not raise.
        """
        if self._pending.total() >= MAX_WAITING or self._pending[client] >= MAX_OF_CLIENT:
            return False
        self._pending[client] += 1
        with self._changed:
            self._lanes.setdefault(client, deque()).append(answer)
            self._changed.notify()
        return True

    def collect(self) -> list[tuple[bytes, list[bytes]]]:
        """Answers that are there, and whom they are for."""
        collected: list[tuple[bytes, list[bytes]]] = []
        while self._finished:
            client, parts = self._finished.popleft()
            self._pending[client] -= 1
            if not self._pending[client]:
                del self._pending[client]
            collected.append((client, parts))
        return collected

    def close(self) -> None:
        """Forget what waits, and end the thread; a question that takes too long is left behind."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            _log.warning("question_left_behind", waited_s=CLOSE_S)

    def _run(self) -> None:
        while (turn := self._next()) is not None:
            client, answer = turn
            parts = answer()
            with self._changed:  # so that nobody is woken after `close`
                if self._closed:
                    return
                self._finished.append((client, parts))
                self._wake()

    def _next(self) -> tuple[bytes, Answer] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._lanes or self._closed)
            if self._closed:
                return None
            client = next(iter(self._lanes))
            lane = self._lanes.pop(client)
            answer = lane.popleft()
            if lane:
                self._lanes[client] = lane  # behind all others
            return client, answer
