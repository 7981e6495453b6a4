"""Rooms in the order of their seeds: rendered inline, or ahead of time by worker processes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TYPE_CHECKING, Protocol

from research.train.worker import prepare_worker, render
from semantic_mapper.errors import ConfigError, NodeError

if TYPE_CHECKING:
    from research.train.rooms import PackedRoom, RoomPoolConfig

AHEAD = 2  # rooms a worker renders ahead of what is requested


class RoomFeed(Protocol):
    """Where a pool gets its rooms from."""

    waited_s: float

    def next(self) -> PackedRoom | str:
        """The next room, or why it cannot be made."""
        ...

    def close(self) -> None:
        """End what runs for it."""
        ...


# Opens the feed of a pool from seeds, config and number of workers, as ``open_feed`` does.
FeedMaker = Callable[[Iterator[int], "RoomPoolConfig", int], RoomFeed]


def open_feed(seeds: Iterator[int], config: RoomPoolConfig, workers: int) -> RoomFeed:
    """A feed of the rooms of ``seeds``; both kinds give the same rooms in the same order.

    Raises ConfigError: a negative number of workers.
    """
    if workers < 0:
        raise ConfigError(f"the number of workers that render rooms must not be negative, got {workers}")
    return InlineFeed(seeds, config) if workers == 0 else WorkerFeed(seeds, config, workers)


class InlineFeed:
    """Renders a room when it is requested: nothing to wait for where the CPU does the training anyway."""

    def __init__(self, seeds: Iterator[int], config: RoomPoolConfig) -> None:
        self._seeds = seeds
        self._config = config
        self.waited_s = 0.0

    def next(self) -> PackedRoom | str:
        """Render the next room."""
        began = time.monotonic()
        room = render(next(self._seeds), self._config)
        self.waited_s += time.monotonic() - began
        return room

    def close(self) -> None:
        """Nothing runs."""


class WorkerFeed:
    """Processes of one thread each render rooms ahead; they come out in the order of their seeds.

    Processes, not threads: laying out a room and its path is Python, which would hold the lock that training needs.
    """

    def __init__(self, seeds: Iterator[int], config: RoomPoolConfig, workers: int) -> None:
        self._seeds = seeds
        self._config = config
        self._pool = ProcessPoolExecutor(workers, get_context("spawn"), prepare_worker)
        self._ahead: deque[Future[PackedRoom | str]] = deque()
        for _ in range(AHEAD * workers):
            self._ask()
        self.waited_s = 0.0

    def next(self) -> PackedRoom | str:
        """The next room; waits where it is not done yet. Raises NodeError: a worker has died."""
        began = time.monotonic()
        try:
            self._ask()
            room = self._ahead.popleft().result()
        except BrokenProcessPool as error:
            raise NodeError(
                "a process that renders rooms has died, for want of memory perhaps; train with fewer workers "
                "(0 renders inline) and go on with --resume"
            ) from error
        self.waited_s += time.monotonic() - began
        return room

    def close(self) -> None:
        """End the processes; the rooms that they render are lost."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _ask(self) -> None:
        self._ahead.append(self._pool.submit(render, next(self._seeds), self._config))
