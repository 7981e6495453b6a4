"""Training rooms rendered ahead by Ray actors, on any machine of the cluster."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Iterator
from itertools import cycle
from typing import TYPE_CHECKING, Any

from research.train.room_feed import AHEAD, InlineFeed, RoomFeed
from research.train.worker import render
from semantic_mapper.errors import ConfigError, NodeError

if TYPE_CHECKING:
    from research.train.rooms import PackedRoom, RoomPoolConfig

ROOM_RETRIES = 3  # of a room whose actor died, so that a room that kills its actor does not repeat for ever
# Set before torch is loaded: an actor takes one core.
ONE_THREAD = {"env_vars": {"OMP_NUM_THREADS": "1"}}


def open_actor_feed(seeds: Iterator[int], config: RoomPoolConfig, workers: int) -> RoomFeed:
    """As ``room_feed.open_feed``, with Ray actors in place of processes; same rooms, same order.

    Raises:
        ConfigError: a negative number of workers.
    """
    if workers < 0:
        raise ConfigError(f"the number of workers that render rooms must not be negative, got {workers}")
    return InlineFeed(seeds, config) if workers == 0 else ActorFeed(seeds, config, workers)


class ActorFeed:
    """Actors of one CPU each render rooms ahead; they come out in the order of their seeds.

    Ray restarts a lost actor, on another machine where its own is gone, and renders its rooms again. The actors end
    with the process that made them.

    Args:
        seeds: Of the rooms.
        config: Of the rooms.
        actors: How many; at most ``AHEAD + 1`` rooms an actor are ahead.
    """

    def __init__(self, seeds: Iterator[int], config: RoomPoolConfig, actors: int) -> None:
        import ray

        self._seeds = seeds
        self._config = config
        made: Any = ray.remote(_RoomActor).options(
            num_cpus=1,
            num_gpus=0,
            max_restarts=-1,
            max_task_retries=ROOM_RETRIES,
            scheduling_strategy="SPREAD",  # not where the rank's own placement group lies
            runtime_env=ONE_THREAD,
        )
        self._actors = [made.remote() for _ in range(actors)]
        self._turns = cycle(self._actors)
        self._ahead: deque[Any] = deque()
        for _ in range(AHEAD * actors):
            self._ask()
        self.waited_s = 0.0

    def next(self) -> PackedRoom | str:
        """The next room; waits where it is not done yet.

        Raises:
            NodeError: the actors that rendered it have died, one after the other.
        """
        import ray
        from ray.exceptions import RayActorError

        began = time.monotonic()
        self._ask()
        try:
            room: Any = ray.get(self._ahead.popleft())
        except RayActorError as error:
            raise NodeError(
                f"a Ray actor that renders rooms has died {ROOM_RETRIES + 1} times, for want of memory perhaps; train "
                "with fewer --workers (0 renders in the ranks) and go on with --resume"
            ) from error
        room = copy.deepcopy(room)  # Ray's arrays are read-only, and hold their place in its object store
        self.waited_s += time.monotonic() - began
        return room

    def close(self) -> None:
        """End the actors; the rooms that they render are lost."""
        import ray

        for actor in self._actors:
            ray.kill(actor)

    def _ask(self) -> None:
        self._ahead.append(next(self._turns).render.remote(next(self._seeds), self._config))


class _RoomActor:
    """Renders one room after the other."""

    def render(self, seed: int, config: RoomPoolConfig) -> PackedRoom | str:
        return render(seed, config)
