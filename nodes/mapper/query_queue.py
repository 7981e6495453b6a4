"""Questions that wait for their answers: who asks, until when, and whose turn is next."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass

from semantic_mapper.nodes.mapper.query_answers import Question

MAX_WAITING = 64  # of all askers together
MAX_OF_ASKER = 8  # of one; who awaits each answer has one


@dataclass(frozen=True, slots=True)
class Asked:
    """One question as it came.

    Args:
        client: Socket that the answer goes to.
        asker: Who asks, through whichever socket, one question at a time; empty = a stranger.
        until: When nobody waits for the answer any more, monotonic seconds.
        parts: Of the question; the same where it is asked again.
        question: What they mean.
    """

    client: bytes
    asker: bytes
    until: float
    parts: list[bytes]
    question: Question

    @property
    def lane(self) -> bytes:
        """What all questions of its asker have in common."""
        return self.asker or self.client

    def repeats(self, other: Asked) -> bool:
        """Whether its asker has asked the other one before, and asks it again."""
        return bool(self.asker) and self.asker == other.asker and self.parts == other.parts


class WaitingQuestions:
    """Questions of each asker in the order in which they came; askers take turns. For one thread at a time.

    Who says its name awaits each answer: what it asked before it waits for no more, and its new question takes that
    one's turn. So one that gives up and asks again is neither answered twice nor put back.
    """

    def __init__(self) -> None:
        self.abandoned = 0  # questions that nobody waited for any more
        self._lanes: dict[bytes, deque[Asked]] = {}  # the first has its turn
        self._pending: Counter[bytes] = Counter()  # put, and neither done nor dropped

    def __bool__(self) -> bool:
        return bool(self._lanes)

    def holds(self, lane: bytes) -> bool:
        """Whether a question of this asker is not done yet."""
        return lane in self._pending

    def put(self, asked: Asked) -> bool:
        """Let a question wait; False where too many do already."""
        lane = self._lanes.get(asked.lane)
        if lane and asked.asker:
            lane[0] = asked
            self.abandoned += 1
            return True
        self.drop_late()
        if self._pending.total() >= MAX_WAITING or self._pending[asked.lane] >= MAX_OF_ASKER:
            return False
        self._pending[asked.lane] += 1
        self._lanes.setdefault(asked.lane, deque()).append(asked)
        return True

    def pop(self) -> Asked | None:
        """The question whose turn it is; pending until ``done``."""
        self.drop_late()
        if not self._lanes:
            return None
        key = next(iter(self._lanes))
        lane = self._lanes.pop(key)
        asked = lane.popleft()
        if lane:
            self._lanes[key] = lane  # behind all others
        return asked

    def done(self, asked: Asked) -> None:
        """A question that was popped is answered."""
        self._pending[asked.lane] -= 1
        if not self._pending[asked.lane]:
            del self._pending[asked.lane]

    def drop_late(self) -> None:
        """Forget questions that nobody waits for any more."""
        now = time.monotonic()
        for lane, waiting in list(self._lanes.items()):
            for asked in [a for a in waiting if a.until < now]:
                waiting.remove(asked)
                self.done(asked)
                self.abandoned += 1
            if not waiting:
                del self._lanes[lane]
