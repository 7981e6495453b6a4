"""Questions whose answers take long: a thread of their own, so that they hold up none but each other."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import structlog

from semantic_mapper.nodes.mapper.query_answers import Question
from semantic_mapper.nodes.mapper.query_queue import Asked, WaitingQuestions

CLOSE_S = 5.0  # what a question under way may still take at the end

_log = structlog.get_logger(__name__)


class LongQuestions:
    """Answers questions one after another, see ``WaitingQuestions``.

    One thread asks and collects; it is woken when an answer is there.

    Args:
        name: Of the thread.
        answer: Gives the answer to a question; must not raise.
        wake: Wakes the thread that collects; not called after ``close``.
    """

    def __init__(self, name: str, answer: Callable[[Question], list[bytes]], wake: Callable[[], None]) -> None:
        self._answer = answer
        self._wake = wake
        self._waiting = WaitingQuestions()
        self._under_way: Asked | None = None
        self._finished: deque[tuple[Asked, list[bytes]]] = deque()
        self._closed = False
        self._changed = threading.Condition()  # guards all of these
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs; it ends before ``close`` only by a bug."""
        return self._thread.is_alive()

    @property
    def abandoned(self) -> int:
        """Questions that were dropped unanswered, since nobody waited for them any more."""
        return self._waiting.abandoned

    def holds(self, lane: bytes) -> bool:
        """Whether an answer for this asker is still to be collected; what it asks next must wait its turn here."""
        with self._changed:
            return self._waiting.holds(lane)

    def put(self, asked: Asked) -> bool:
        """Have a question answered; False where too many wait already. One that is under way is not begun again."""
        with self._changed:
            if self._under_way is not None and asked.repeats(self._under_way):
                self._under_way = asked  # to where the answer is awaited now
                return True
            if not self._waiting.put(asked):
                return False
            self._changed.notify()
            return True

    def collect(self) -> list[tuple[bytes, list[bytes]]]:
        """Answers that are there, and whom they are for."""
        with self._changed:
            collected = [(asked.client, parts) for asked, parts in self._finished]
            for asked, _ in self._finished:
                self._waiting.done(asked)
            self._finished.clear()
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
        while (asked := self._next()) is not None:
            parts = self._answer(asked.question)
            with self._changed:  # so that nobody is woken after `close`
                if self._closed:
                    return
                self._finished.append((self._under_way or asked, parts))
                self._under_way = None
                self._wake()

    def _next(self) -> Asked | None:
        with self._changed:
            while not self._closed:
                if (asked := self._waiting.pop()) is not None:
                    self._under_way = asked
                    return asked
                self._changed.wait()
            return None
